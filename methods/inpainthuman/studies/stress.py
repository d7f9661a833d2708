"""Stiff training of InpaintHuman: the smallest avatar, a person of six small frames, and everything that goes wrong.

Named in the spec. A case's note says which steps the guard rejected and where it went back to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ihbench.camera import Camera
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.fit.optimisation import MOST_ROLL_BACKS
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.config import QUICK, InpaintHumanConfig
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.methods.inpainthuman.stages.stage1 import Stage1, loss_of, prepare_target
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.stress.case import Answer, Case, Unit, words_of
from ihbench.stress.drawn_capture import WHITE, the_body
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import (
    SIZE,
    all_unknown,
    only_a_pixel,
    training_set,
    views,
    with_bad_hidden_pixels,
    with_bad_pixel,
    with_other_shapes,
    with_view,
)
from ihbench.stress.training import story_of_fit

STEPS = 16
RATES = ("lr_maps", "lr_decoder", "lr_encoder")
# step sizes and a first scale at which 16 steps show something; at this size the rim is half of the person
TINY = replace(
    QUICK,
    texels=48, levels=(16, 32), channels=8, decoder_width=32, position_map=16, residual_channels=4, steps=STEPS,
    lr_maps=3e-2, lr_decoder=1e-2, background_weight=0.2, scale_initial=0.4,
    inpaint=replace(QUICK.inpaint, on=False),
)  # fmt: skip

HELPS = "the loss over the views after the fit, over the loss before: a fit that does not lower it is worse than none"
STEP = "a step is counted"
REFUSED = "it must be refused, and the line must say this"
EXACT = "not a bit may change"


def mean_loss(avatar: GaussianAvatar, training: TrainingSet) -> float:
    import torch

    with torch.no_grad():
        losses = [loss_of(avatar, prepare_target(avatar, v), training.background).item() for v in training.views]
    return float(np.mean(losses))


def fresh(config: InpaintHumanConfig) -> GaussianAvatar:
    return GaussianAvatar(config, the_body(), np.zeros(10), 0)


def scaled_rates(factor: float) -> InpaintHumanConfig:
    config = replace(TINY)
    for name in RATES:  # past the switches' bounds: the guard of a fit must hold whatever reaches it
        object.__setattr__(config, name, factor * getattr(TINY, name))
    return config


def fitted(
    config: InpaintHumanConfig,
    training: TrainingSet | None = None,
    avatar: GaussianAvatar | None = None,
    prepare: Callable[[Stage1], None] = lambda stage: None,
) -> tuple[GaussianAvatar | None, str]:
    """The avatar after stage 1 (on all views by default), None where it diverged, and what happened on the way."""
    ledger, avatar = Ledger(), avatar or fresh(config)
    stage = Stage1(avatar, training or training_set(), 0, ledger)
    prepare(stage)

    def fit() -> GaussianAvatar:
        stage.run(Progress.silent())
        return avatar

    return story_of_fit(fit, ledger)


def _ratio(
    config: InpaintHumanConfig,
    training: TrainingSet | None = None,
    start: float | None = None,  # of the decoder's scales, see `with_scale`
    prepare: Callable[[Stage1], None] = lambda stage: None,
) -> Answer:
    """Loss after over loss before."""
    training, avatar = training or training_set(), fresh(config)
    if start is not None:
        with_scale(avatar, start)
    before = mean_loss(avatar, training)
    after, story = fitted(config, training, avatar, prepare)
    return Answer(math.nan if after is None else mean_loss(after, training) / before, 1.0, note=story)


def with_scale(avatar: GaussianAvatar, raw: float) -> GaussianAvatar:
    """The avatar, whose decoder asks for a scale factor of e^raw."""
    avatar.decoder.linear[-1].bias.data[3] = raw
    return avatar


# ----------------------------------------------------------------------------------------------------
# Step sizes


def _absurd_rates() -> Answer:
    """1e30 times too large: nothing can be saved, and the record says so."""
    after, story = fitted(scaled_rates(1e30))
    assert after is None
    return Answer(story, "diverged, first bad step 1: loss is nan")


def _last_step() -> Answer:
    """The last step of all spoils the avatar, and no loss follows it: it is looked at nevertheless."""

    def spoil(stage: Stage1) -> None:
        step, calls = stage.optimizer.step, []

        def spoiled(*args: Any) -> Any:
            calls.append(1)
            step(*args)
            if len(calls) == STEPS:
                stage.avatar.features.table.data[:] = math.nan

        stage.optimizer.step = spoiled

    after, story = fitted(TINY, prepare=spoil)
    finite = after is not None and all(bool(p.isfinite().all()) for p in after.parameters())
    return Answer(f"finite {finite}: {story}", f"finite True: step {STEPS} rejected, back to 0")


def _clipped(factor: float) -> Answer:
    """Loss and gradients scaled by a factor: Adam does not see it where clipping sees all of it, or nothing."""

    def scale(stage: Stage1) -> None:
        loss = stage._loss
        stage._loss = lambda k: factor * loss(k)

    return _ratio(replace(TINY, clip_gradient=1e30), prepare=scale)


def _dead_scales(raw: float) -> Answer:
    """The gradient along the scales, where the decoder asks for a factor of e^raw, must not be 0."""
    avatar = with_scale(fresh(replace(TINY, scale_weight=0.0)), raw)
    loss_of(avatar, prepare_target(avatar, views()[0]), WHITE).backward()
    bias: Any = avatar.decoder.linear[-1].bias
    return Answer(float(bias.grad[3].abs() > 0), 1.0)


def _bounded_scales() -> Answer:
    """However large a factor the decoder asks for, no Gaussian is larger than the limit."""
    largest = []
    for activation in ("exp", "softplus"):
        avatar = with_scale(fresh(replace(TINY, scale_activation=activation)), 1e30)
        largest.append(float(avatar.decode(avatar.every_point, None)[1].detach().max()))
    return Answer(largest, TINY.scale_limit, precision=np.float32)


# ----------------------------------------------------------------------------------------------------
# What the views show


def _contradiction() -> Answer:
    """Every view once as it is, and once with person and background exchanged: there is no right answer, so the loss
    cannot fall by much; it must not rise, nor end in NaN."""
    states = np.array([MaskState.PERSON, MaskState.BACKGROUND, MaskState.UNKNOWN], np.uint8)  # of the states in order
    return _ratio(TINY, training_set([*views(), *(replace(view, mask=states[view.mask]) for view in views())]))


def _speck() -> Answer:
    """Such a view costs a hundred times what others do; the guard must not take it for an explosion."""
    _, story = fitted(TINY, training_set([*views()[:4], only_a_pixel(1, MaskState.BACKGROUND)]))
    return Answer(story, "no step rejected")


def _nothing(shown: Sequence[TrainView]) -> Answer:
    def fit() -> Any:
        return InpaintHuman(TINY).fit(
            training_set(shown), device="cpu", seed=0, ledger=Ledger(), progress=Progress.silent()
        )

    return Answer(words_of(BadInput, fit), "nothing to fit")


def _behind() -> Answer:
    camera, about = views()[0].camera, np.diag([-1.0, 1, -1])
    return _ratio(TINY, with_view(1, camera=Camera(camera.K, about @ camera.R, about @ camera.t, SIZE, SIZE)))


def _bad_pixel(bad: float) -> Answer:
    """One pixel of one view is not finite. Its first step is known; smaller steps cannot help, so none is tried."""
    training = with_bad_pixel(2, bad)
    stage = Stage1(fresh(TINY), training, 0, Ledger())
    first = next(step for step in range(6) if stage._view_of(step, 6) == 2)
    after, story = fitted(TINY, training)
    assert after is None
    return Answer(story, f"diverged, first bad step {first}: loss is ")


def _hidden_bad_pixel() -> Answer:
    """A NaN behind the occluder is nobody's business: 0 × NaN must not enter the loss."""
    return _ratio(TINY, with_bad_hidden_pixels(1, math.nan))


# ----------------------------------------------------------------------------------------------------
# What happens on the way


def _spoiled_once(how: str, at: int) -> Answer:
    """A loss, or a gradient, is NaN once: the step is rejected, and the fit ends as well as any."""

    def spoil(stage: Stage1) -> None:
        loss, calls = stage._loss, []

        def spoiled(k: int) -> Any:
            calls.append(k)
            value = loss(k)
            if len(calls) - 1 != at:
                return value
            if how == "loss":
                return value * math.nan
            # sqrt(0) adds nothing to the loss, and 0 × inf = NaN to its gradient
            return value + (value * 0).sqrt()

        stage._loss = spoiled

    answer = _ratio(TINY, prepare=spoil)
    if f"step {at} rejected, back to 0" not in answer.note:
        raise AssertionError(f"expected step {at} rejected, got {answer.note!r}")
    return answer


def _spoiled_for_good(at: int) -> Answer:
    """From some step on every loss is NaN: a bounded number of ways back, then a divergence at that first step."""

    def spoil(stage: Stage1) -> None:
        loss, one_step = stage._loss, stage._one_step

        def step(k: int) -> None:
            stage._loss = lambda k: loss(k) * (math.nan if stage.step >= at else 1)
            try:
                one_step(k)
            finally:
                stage._loss = loss

        stage._one_step = step

    after, story = fitted(TINY, prepare=spoil)
    assert after is None
    back = f"step {at} rejected, back to 0; " * MOST_ROLL_BACKS
    return Answer(story, f"{back}diverged, first bad step {at}: loss is nan")


def _bad_start() -> Answer:
    start = fresh(TINY)
    start.features.table.data[start.features.index[100]] = math.nan
    return Answer(fitted(TINY, avatar=start)[1], "diverged, first bad step 0")


def _resumed() -> Answer:
    """Killed after a step was rejected, and gone on with from the state of step 11: the same bits as without."""
    config = scaled_rates(1000.0)
    whole, _ = fitted(config)
    assert whole is not None
    training = training_set()
    return Answer(
        changed_by_a_kill(lambda: fresh(config), lambda avatar, ledger: Stage1(avatar, training, 0, ledger), whole), 0
    )


# ----------------------------------------------------------------------------------------------------
# Half precision


def _half_precision(name: str) -> Answer:
    import torch

    with torch.autocast("cpu", getattr(torch, name), cache_enabled=False):  # or the first weights would stay
        return _ratio(TINY)


def _half_colours() -> Answer:
    """An avatar's pictures from parameters rounded to half precision: a grey level off at most, on average."""
    import torch

    avatar, _ = fitted(TINY)
    assert avatar is not None
    view = views()[0]
    exact = avatar.render(view.camera, view.body_pose)[0]
    with torch.no_grad():
        for p in avatar.parameters():
            p.copy_(p.half().float())
    return Answer(float(np.abs(avatar.render(view.camera, view.body_pose)[0] - exact).mean()), 0.0)


def _training(
    name: str, what: str, function: Callable[[], Answer], unit: Unit, tolerance: float, why: str, known: str = ""
) -> Case:
    return Case(f"inpainthuman-{name}", what, function, unit, tolerance, why, "training", known)


_helps = partial(_training, unit="at most", tolerance=0, why=HELPS)
_step = partial(_training, unit="words", tolerance=0, why=STEP)
_refused = partial(_training, unit="words", tolerance=0, why=REFUSED)
_exact = partial(_training, unit="absolute", tolerance=0, why=EXACT)


OUT_OF_REACH = (
    "the scale factor is cut at e^±5 and the scale at its limit, and a cut has no gradient: such a Gaussian comes "
    "back only through what its decoder shares with others; a fit does not get there by itself"
)

CASES = [
    *(
        _helps(f"rate-{factor:g}", f"step sizes × {factor:g}", lambda factor=factor: _ratio(scaled_rates(factor)))
        for factor in (0.1, 1.0, 10.0, 100.0, 1000.0)
    ),
    _training("rate-1e30", "step sizes × 1e30", _absurd_rates, "words", 0, "the first step after the first update"),
    _step("last-step", "the last step of all gives NaN", _last_step),
    *(
        _helps(f"loss-{factor:g}", f"loss × {factor:g}, no clipping", partial(_clipped, factor))
        for factor in (1e-6, 1e12)
    ),
    _helps("scale-collapse", "a fit from Gaussians e^-4 as large", partial(_ratio, TINY, start=-4.0)),
    _helps("scale-explosion", "a fit from Gaussians at the limit of their scale", partial(_ratio, TINY, start=4.0)),
    _exact("scale-collapse-gradient", "a scale factor of e^-4.9 has a gradient", partial(_dead_scales, -4.9)),
    _exact("scale-cut-gradient", "a scale factor of e^-6 has a gradient", partial(_dead_scales, -6.0),
           known=OUT_OF_REACH),
    _exact("scale-limit-gradient", "a scale beyond its limit has a gradient", partial(_dead_scales, 6.0),
           known=OUT_OF_REACH),
    _training("scale-limit", "the largest scale a decoder can ask for", _bounded_scales, "ulp", 1,
              "the limit in float32"),
    _helps("contradiction", "every view with its mask and with the opposite", _contradiction),
    _helps("wrong-pose", "one frame has another's pose",
           lambda: _ratio(TINY, with_view(2, body_pose=views()[5].body_pose))),
    _helps("one-frame", "one training frame", lambda: _ratio(TINY, training_set(views()[:1]))),
    _helps("two-frames", "two training frames", lambda: _ratio(TINY, training_set(views()[:2]))),
    _helps("other-shapes", "shape coefficients that differ by frame", lambda: _ratio(TINY, with_other_shapes())),
    _helps("one-pixel", "one visible pixel in all",
           lambda: _ratio(TINY, training_set([only_a_pixel(0, MaskState.UNKNOWN)]))),
    _step("speck", "a view of one person pixel on known background", _speck),
    _refused("no-view", "no training view", partial(_nothing, [])),
    _refused("all-hidden", "views without a visible pixel",
             lambda: _nothing(all_unknown())),
    _helps("behind-camera", "a view with the body behind the camera", _behind),
    _step("nan-pixel", "a NaN among the person's pixels", partial(_bad_pixel, math.nan)),
    _step("inf-pixel", "an infinite person pixel", partial(_bad_pixel, math.inf)),
    _helps("nan-hidden", "NaN behind the occluder", _hidden_bad_pixel),
    _helps("nan-loss-once", "the loss of step 9 is NaN", partial(_spoiled_once, "loss", 9)),
    _helps("nan-gradient-once", "a gradient of step 9 is NaN", partial(_spoiled_once, "gradient", 9)),
    _step("nan-loss-for-good", "every loss from step 9 on is NaN", partial(_spoiled_for_good, 9)),
    _step("nan-start", "a feature is NaN before the first step", _bad_start),
    _exact("resumed-after-rejection", "killed after a rejected step, and gone on with", _resumed),
    _helps("bfloat16", "matrix products in bfloat16", partial(_half_precision, "bfloat16")),
    _training("float16-avatar", "pictures from parameters in float16", _half_colours, "absolute", 1 / 255,
              "a grey level: 11 bits of a feature, through four layers"),
]  # fmt: skip
