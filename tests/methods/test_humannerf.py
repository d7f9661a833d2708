"""HumanNeRF's fit: its loss, its guard, its failure under a strip, resume, and bad input."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.fit.rays.patch_loss import patch_distance
from ihbench.methods.humannerf.avatar import HumanNerfAvatar
from ihbench.methods.humannerf.config import EARLY, PAPER, PROFILES, QUICK, SMOKE, leave_out
from ihbench.methods.humannerf.fitting import MOST_RESTARTS, HumanNerfFit, ShowsNothing, restarted
from ihbench.methods.humannerf.method import HumanNerfMethod
from ihbench.methods.humannerf.stress import CASES, TINY
from ihbench.scene.contracts import MaskState
from ihbench.scene.method_spec import method_spec
from ihbench.stress.run import run_cases
from tests.bench.fake_capture import a_camera, a_pose, the_body, train_view

from .tiny_fit import SIZE, STRIP, equal_bits, everything, training_set, training_views
from .tiny_gaussians import SavesAt, events, killed_after

BODY = the_body()
SMALL = replace(TINY, steps=6, kick_in=2, full_band=5, patch_px=24, guard=(), squared_first=0)


def a_fit(training, seed=0, ledger=None, **changes):
    avatar = HumanNerfAvatar(replace(SMALL, **changes), BODY, np.zeros(10), seed)
    return HumanNerfFit(avatar, training, seed, ledger or Ledger())


def fitted(training, seed=0, ledger=None, **changes):
    fit = a_fit(training, seed, ledger, **changes)
    fit.run(Progress.silent())
    return fit.avatar


@cache
def whole():
    return everything(fitted(training_set(training_views())))


# ------------------------------------------------------------------------------------------------------- the loss


def distance_of(fit):
    config = fit.avatar.config
    return patch_distance(config.lpips_net, config.without_lpips, fit.avatar.device, fit.ledger)


def test_the_loss_is_squared_error_and_a_distance_of_patches(views):
    training = training_set(views)
    values = {}
    for name, changes in {
        "mse": {"mse": 0.2, "lpips": 0.0},
        "distance": {"mse": 0.0, "lpips": 0.7},
        "both": {"mse": 0.2, "lpips": 0.7},
    }.items():
        fit = a_fit(training, patches=2, **changes)
        fit._perceptual = distance_of(fit) if changes["lpips"] else None
        with torch.no_grad():
            values[name] = fit._loss(1).item()
    assert all(value > 0 for value in values.values())
    assert values["both"] == pytest.approx(values["mse"] + values["distance"], rel=1e-5)


def test_without_weights_another_distance_stands_for_lpips_and_the_record_says_so(views, monkeypatch):
    monkeypatch.setattr("ihbench.fit.rays.patch_loss.perceptual", lambda net, device, least: f"no weights of {net}")
    for instead, words in (("pyramid", "pyramid stands for it"), ("none", "nothing stands for it")):
        ledger = Ledger()
        fitted(training_set(views), ledger=ledger, lpips=1.0, without_lpips=instead, steps=1)
        assert events(ledger, "left_out") == [{"what": "lpips term", "reason": f"no weights of vgg; {words}"}]
    monkeypatch.setattr(
        "ihbench.fit.rays.patch_loss.perceptual", lambda net, device, least: lambda rgb, image: rgb.mean() * 0 + 5
    )
    fit = a_fit(training_set(views), lpips=2.0, mse=0.0, patches=3)
    fit._perceptual = distance_of(fit)
    assert fit._loss(0).item() == 10.0


def relabelled(views, old, new):
    return [replace(view, mask=np.where(view.mask == old, new, view.mask).astype(np.uint8)) for view in views]


def test_an_unknown_pixel_is_background(views):
    """To the bit; with `unknown=ignore` it is not, and what stands there is nobody's business."""
    known = training_set(relabelled(views, MaskState.UNKNOWN, MaskState.BACKGROUND))
    assert equal_bits(everything(fitted(known)), whole())
    some = {"steps": 2, "unknown": "ignore"}
    spoiled = []
    for view in views:
        image = view.image.copy()
        image[view.mask != MaskState.PERSON] = 77
        spoiled.append(replace(view, image=image))
    fits = [everything(fitted(training_set(shown), **some)) for shown in (views, spoiled)]
    assert equal_bits(*fits)
    assert not equal_bits(fits[0], everything(fitted(known, **some)))


# ---------------------------------------------------------------------------------------------------------- resume


@pytest.mark.parametrize(("saved", "killed"), [(1, 2), (3, 5)])
def test_a_resumed_fit_equals_an_uninterrupted_one_to_the_bit(views, saved, killed):
    """Saved before and after the non-rigid network begins."""
    training, ledger = training_set(views), SavesAt(saved)
    killed_after(a_fit(training, ledger=ledger), killed)
    resumed = fitted(training, ledger=ledger)
    assert equal_bits(whole(), everything(resumed))
    assert resumed.step == SMALL.steps
    assert [event["step"] for event in events(ledger, "resumed")] == [saved]


def test_the_same_seed_gives_the_same_bits_and_another_another(views):
    assert equal_bits(everything(fitted(training_set(views))), whole())
    assert not equal_bits(everything(fitted(training_set(views), seed=1)), whole())


def test_the_method_reports_its_stages_and_offers_its_avatar(views):
    offered = []
    ledger = Ledger(on_checkpoint=lambda step, seconds, avatar: offered.append((step, avatar)))
    avatar = HumanNerfMethod(SMALL).fit(
        training_set(views), device="cpu", seed=0, ledger=ledger, progress=Progress.silent()
    )
    assert {"fit", "fit/prepare", "fit/field"} <= {row["stage"] for row in ledger.table()}
    assert offered[-1] == (SMALL.steps, avatar)
    assert equal_bits(everything(avatar), whole())


# ------------------------------------------------------------------------------------------------------- the start


def test_a_short_fit_begins_with_a_person_of_fog():
    """Whatever its seed, with density wherever the person may be; as released about half of the seeds have none
    anywhere, and ReLU lets no gradient through to change that."""
    places = torch.from_numpy(np.array(BODY.shaped(np.zeros(10))[0])).float()

    def least(config):
        with torch.no_grad():
            starts = [HumanNerfAvatar(config, BODY, np.zeros(10), seed).canonical(places)[1] for seed in range(6)]
        return [raw.min().item() for raw in starts]

    assert min(least(QUICK)) > 2.5
    assert min(least(SMOKE)) > 2.5
    assert min(least(replace(QUICK, first_density=0.0))) < -0.5


def test_a_short_fit_begins_with_squared_error_and_small_steps(views):
    """The perceptual distance comes in over as many steps as it was out for; step sizes rise in a straight line."""
    fit = a_fit(training_set(views), mse=0.5, lpips=2.0, squared_first=10, warm_up=4, decay_steps=10_000)
    fit._perceptual = lambda rgb, image: rgb.mean() * 0 + 1
    extra = []
    for fit.step in (0, 10, 15, 20, 200):
        both = fit._loss(0).item()
        fit._perceptual, distance = None, fit._perceptual
        extra.append(both - fit._loss(0).item())
        fit._perceptual = distance
    assert extra == pytest.approx([0, 0, 1, 2, 2], abs=1e-5)
    rates = []
    for fit.step in (0, 1, 3, 100):
        rates.append(fit._rate_share())
    assert rates == pytest.approx([0.25, 0.5, 1, 1], rel=0.03)
    assert (PAPER.first_density, PAPER.warm_up, PAPER.squared_first) == (0, 0, 0)


# ------------------------------------------------------------------------------------------------------- the guard


def emptied(fit, until):
    """The fit, whose network sees nothing anywhere until it has started so many times."""
    before = fit._before_step

    def spoiled():
        if int(fit.avatar.restarts) < until:
            with torch.no_grad():
                fit.avatar.canonical.last.bias[3] = -1e6
        before()

    fit._before_step = spoiled
    return fit


def test_an_empty_picture_starts_the_fit_again(views):
    """From other first weights, all the steps; to the bit the same where it was killed in between."""
    ledger = Ledger()
    fit = emptied(a_fit(training_set(views), ledger=ledger, guard=(2,)), 1)
    fit.run(Progress.silent())
    assert int(fit.avatar.restarts) == 1
    (warning,) = events(ledger, "warning")
    assert "started again 1 times" in warning["what"]
    assert restarted(0, 0) == 0
    assert restarted(0, 1) != restarted(0, 2)
    ledger = SavesAt(4)
    killed_after(emptied(a_fit(training_set(views), ledger=ledger, guard=(2,)), 1), 5)
    resumed = a_fit(training_set(views), ledger=ledger, guard=(2,))
    resumed.run(Progress.silent())
    assert equal_bits(everything(fit.avatar), everything(resumed.avatar))


def test_a_new_start_has_the_step_sizes_of_the_first(views):
    fit = a_fit(training_set(views))
    fit.rolled_back = 1
    fit._roll_back(ShowsNothing(3, "the picture of frame 0 shows nothing"))
    fit._one_step(0)
    assert [group["lr"] for group in fit.optimizer.param_groups] == fit.rates


def test_a_frame_beside_which_the_person_stands_need_not_show_anybody(views):
    away = replace(views[0], body_pose=a_pose(transl=(5, 0, 0)), mask=np.zeros_like(views[0].mask))
    fit = a_fit(training_set([away, *views[1:]]), guard=(2,))
    fit.run(Progress.silent())
    assert int(fit.avatar.restarts) == 0


def test_a_fit_that_is_empty_after_every_start_is_a_divergence(views):
    fit = emptied(a_fit(training_set(views), guard=(0,)), 99)
    with pytest.raises(Diverged, match=f"shows nothing, after {MOST_RESTARTS} new starts"):
        fit.run(Progress.silent())


# --------------------------------------------------------------------------------------------------- the signature


@cache
def longer(hidden):
    """A fit to a turning person, without the strip or with it in every frame but the first."""
    strips = [STRIP if hidden and k else None for k in range(6)]
    views = [train_view(a_camera(0.0, SIZE), a_pose(0.3 * k), strip, frame=k) for k, strip in enumerate(strips)]
    some = {"steps": 120, "decay_steps": 120, "kick_in": 10, "full_band": 40, "patches": 2, "patch_px": 16}
    return fitted(training_set(views), width=64, samples=24, lr=8e-3, lr_motion=1e-2, **some), views


def test_the_strip_makes_the_person_transparent():
    """Alpha behind a strip that hides five of six frames, beside it, and without the strip."""
    truth = train_view(a_camera(0.0, SIZE), a_pose(0.75))
    columns = np.arange(SIZE)
    person, behind = truth.mask == MaskState.PERSON, (columns >= STRIP.start + 1) & (columns < STRIP.stop - 1)
    strip, clear = (longer(hidden)[0].render(truth.camera, truth.body_pose)[1] for hidden in (True, False))
    assert clear[person & behind].mean() > 0.6
    assert clear[~person].mean() < 0.1
    assert strip[person & behind].mean() < 0.35  # of 1 - 5/6 = .17
    assert strip[person & ~behind].mean() > strip[person & behind].mean() + 0.08


def test_a_short_fit_looks_like_the_person():
    avatar, views = longer(False)
    for view in views[::2]:
        person = view.mask == MaskState.PERSON
        rgb, alpha = avatar.render(view.camera, view.body_pose)
        error = np.square(rgb - view.image / 255)[person].mean()
        mean_color = (view.image / 255)[person].mean(0)
        assert error < 0.8 * np.square(view.image / 255 - mean_color)[person].mean()
        assert ((alpha > 0.5) & person).sum() / ((alpha > 0.5) | person).sum() > 0.7


def test_an_avatar_on_disk_draws_the_same(tmp_path):
    avatar, views = longer(False)
    avatar.save(tmp_path)
    again = HumanNerfMethod(SMALL).load(tmp_path, BODY)
    assert again.step == avatar.step
    for one, other in zip(
        *(a.render(views[1].camera, views[1].body_pose, (0.1, 0.2, 0.3)) for a in (avatar, again)), strict=True
    ):
        assert np.array_equal(one, other)
    (tmp_path / "avatar.json").write_text("{}")
    with pytest.raises(BadInput, match="expected 'humannerf'"):
        HumanNerfMethod(SMALL).load(tmp_path, BODY)


def test_profiles_and_what_a_scene_does_not_need():
    from types import SimpleNamespace
    from typing import Any, cast

    spec = method_spec("humannerf")
    assert list(PROFILES) == ["smoke", "quick", "paper"]
    for name in PROFILES:
        assert spec.profile(name) == PROFILES[name]
    for name in ("kick_in", "full_band"):  # at the released shares of the steps in which rates fall to a tenth
        share, released = (getattr(each, name) / each.decay_steps for each in (QUICK, PAPER))
        assert share == pytest.approx(released, abs=1e-3)
    assert min(QUICK.guard) == EARLY
    assert QUICK.patch_px >= 32
    still, moving = (cast(Any, SimpleNamespace(motion_deg=deg)) for deg in (1.0, 30.0))
    (omission,) = leave_out(QUICK, still)
    assert (omission.field, omission.value) == ("non_rigid", False)
    assert leave_out(QUICK, moving) == []
    assert leave_out(replace(SMOKE, non_rigid=False), still) == []


def test_stress_cases():
    """Those that take least; `ihbench stress` has all."""
    some = {"humannerf-one-frame", "humannerf-no-view", "humannerf-all-hidden", "humannerf-nan-pixel"}
    outcomes = run_cases([case for case in CASES if case.name in some])
    assert {outcome.case.name for outcome in outcomes} == some
    for outcome in outcomes:
        assert outcome.verdict == "passed", (outcome.case.name, outcome.reason, outcome.value)
