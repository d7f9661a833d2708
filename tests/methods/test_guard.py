"""The guard of an optimisation: rejected steps, the way back, and that a sound fit never sees it."""

import math
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.optimisation import GOOD_EVERY, MOST_ROLL_BACKS, SMALLER
from ihbench.methods.inpainthuman.stages.stage1 import Stage1, loss_of, prepare_target
from ihbench.scene.contracts import MaskState

from .tiny_fit import an_avatar, equal_bits, fitted, parameters_of, training_set, training_views

STEPS = GOOD_EVERY + 12
BAD = GOOD_EVERY + 5
SMALL = {"texels": 32, "levels": (16,), "pose_residual": False, "steps": STEPS}


@pytest.fixture(scope="module")
def training():
    return training_set(training_views()[:3])


def a_stage(training, ledger=None, spoiled_calls=(), **changes):
    """Stage 1 whose loss is NaN at some calls, counted from 0; and the rates of every step, by step."""
    stage = Stage1(an_avatar(**{**SMALL, **changes}), training, 0, ledger or Ledger())
    loss, step, calls, rates = stage._loss, stage.optimizer.step, [], []

    def counted(k):
        calls.append(k)
        return loss(k) * (math.nan if len(calls) - 1 in spoiled_calls else 1)

    stage._loss = counted
    stage.optimizer.step = lambda: rates.append((stage.step, stage.optimizer.param_groups[0]["lr"])) or step()
    return stage, rates


def events(ledger, kind="rolled_back"):
    return [event.data for event in ledger.events if event.kind == kind]


def test_a_fit_in_which_nothing_is_wrong_is_the_fit_without_a_guard(training, monkeypatch):
    """To the bit, and without an event."""
    ledger = Ledger()
    guarded = parameters_of(fitted(training, ledger=ledger, **SMALL))
    assert events(ledger) == []
    for name in ("_check_loss", "_check_end"):
        monkeypatch.setattr(Stage1, name, lambda self, *_: None)
    monkeypatch.setattr("ihbench.fit.optimisation.GOOD_EVERY", 10**9)
    assert equal_bits(guarded, parameters_of(fitted(training, **SMALL)))


def test_a_rejected_step_goes_back_to_the_last_good_state_with_smaller_steps(training):
    ledger = Ledger()
    stage, rates = a_stage(training, ledger, {BAD})
    stage.run(Progress.silent())
    (event,) = events(ledger)
    assert (event["stage"], event["step"], event["bad_step"]) == ("stage1", GOOD_EVERY, BAD)
    assert event["what"].startswith(f"loss is nan at step {BAD}; went back to step {GOOD_EVERY}, step sizes × 0.1")
    steps = [step for step, _ in rates]
    assert steps == [*range(BAD), *range(GOOD_EVERY, STEPS)], "a step between was lost or done twice"
    usual = dict(a_stage_rates(training))
    assert all(rate == pytest.approx(usual[step]) for step, rate in rates[:BAD])
    assert all(rate == pytest.approx(SMALLER * usual[step]) for step, rate in rates[BAD:])


def a_stage_rates(training):
    stage, rates = a_stage(training)
    stage.run(Progress.silent())
    return rates


def test_going_back_restores_parameters_and_moments_to_the_bit(training):
    stage, _ = a_stage(training)
    for _ in range(GOOD_EVERY + 3):
        if stage.step == GOOD_EVERY:
            before = {name: value.clone() for name, value in stage._tensors().items()}
        stage._one_step(stage._view_of(stage.step, stage.views))
        stage.step += 1
    assert not equal_bits(before, stage._tensors())
    stage._roll_back(Diverged(stage.step, "for the test"))
    assert stage.step == GOOD_EVERY
    assert equal_bits(before, stage._tensors())


def test_the_number_of_ways_back_is_bounded_and_the_first_bad_step_is_named(training):
    ledger = Ledger()
    stage, _ = a_stage(training, ledger)
    one_step, loss = stage._one_step, stage._loss

    def step(k):
        stage._loss = lambda k: loss(k) * (math.nan if stage.step >= BAD else 1)
        try:
            one_step(k)
        finally:
            stage._loss = loss

    stage._one_step = step
    with pytest.raises(Diverged, match=r"loss is nan; 3 times back with smaller step sizes did not help") as caught:
        stage.run(Progress.silent())
    assert caught.value.step == BAD
    assert [event["bad_step"] for event in events(ledger)] == [BAD] * MOST_ROLL_BACKS


def test_a_bad_view_is_no_matter_of_step_sizes(training):
    """It is met again with the last good parameters, so nothing is tried a second time."""
    bad = Stage1(an_avatar(**SMALL), training, 0, Ledger())._view_of(1, 3)
    views = list(training.views)
    image = views[bad].image.astype(np.float32)
    image[views[bad].mask == MaskState.PERSON] = np.nan
    views[bad] = replace(views[bad], image=image)
    ledger = Ledger()
    stage, _ = a_stage(training_set(views), ledger)
    with pytest.raises(Diverged, match="with the parameters of step 0 as well"):
        stage.run(Progress.silent())
    assert events(ledger) == []


def test_an_explosion_is_rejected_and_a_view_that_always_costs_much_is_not(training):
    ledger = Ledger()
    wild = fitted(training, ledger=ledger, **SMALL, lr_maps=10.0, lr_decoder=5.0)
    assert events(ledger)
    with torch.no_grad():
        after = [loss_of(wild, prepare_target(wild, view), training.background).item() for view in training.views]
    start = an_avatar(**SMALL)
    with torch.no_grad():
        before = [loss_of(start, prepare_target(start, view), training.background).item() for view in training.views]
    assert sum(after) < sum(before)

    mask = np.full_like(training.views[2].mask, MaskState.BACKGROUND)
    mask[tuple(np.argwhere(training.views[2].mask == MaskState.PERSON)[50])] = MaskState.PERSON
    ledger = Ledger()
    fitted(training_set([*training.views[:2], replace(training.views[2], mask=mask)]), ledger=ledger, **SMALL)
    assert events(ledger) == []


class Killed(Exception):
    pass


@pytest.mark.parametrize(("saved", "killed"), [(GOOD_EVERY + 2, BAD - 1), (GOOD_EVERY + 8, STEPS - 1)])
def test_a_fit_killed_before_or_after_a_rejection_ends_with_the_same_bits(training, saved, killed):
    """Saved and killed before the bad step, and after the way back. The state to go back to is saved too."""

    class SavesOnce(Ledger):
        def due_to_save(self):
            return stage.step == saved and (killed < BAD or stage.rolled_back > 0)

    def bad_once(stage):
        """The loss of step BAD is NaN until the stage has gone back."""
        one_step, loss = stage._one_step, stage._loss

        def step(k):
            bad = stage.step == BAD and stage.rolled_back == 0
            stage._loss = (lambda k: loss(k) * math.nan) if bad else loss
            try:
                one_step(k)
            finally:
                stage._loss = loss

        stage._one_step = step
        return stage

    whole = bad_once(a_stage(training)[0])
    whole.run(Progress.silent())
    ledger = SavesOnce()
    stage = bad_once(a_stage(training, ledger)[0])
    one_step = stage._one_step

    def until_killed(k):
        if stage.step == killed and (killed < BAD or stage.rolled_back > 0):
            raise Killed
        one_step(k)

    stage._one_step = until_killed
    with suppress(Killed):
        stage.run(Progress.silent())
    assert stage.step == killed
    again = bad_once(a_stage(training, ledger)[0])
    again.run(Progress.silent())
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]
    assert equal_bits(parameters_of(whole.avatar), parameters_of(again.avatar))
    assert again.rolled_back == 1


def test_a_last_step_that_spoils_the_avatar_is_rejected(training):
    ledger = Ledger()
    stage, _ = a_stage(training, ledger)
    step = stage.optimizer.step

    def spoiling():
        step()
        if stage.step == STEPS - 1 and stage.rolled_back == 0:
            stage.avatar.features.table.data[:] = math.nan

    stage.optimizer.step = spoiling
    stage.run(Progress.silent())
    assert [event["bad_step"] for event in events(ledger)] == [STEPS]
    assert all(p.isfinite().all() for p in stage.avatar.parameters())
