"""Stiff training of OccFusion: few steps, a person of six small frames, and everything that goes wrong.

Named in the spec. A case's note says which steps the guard rejected and where it went back to. All but one case leave
the diffusion model out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.occfusion.config import SMOKE, InpaintConfig, OccFusionConfig, ScoreConfig
from ihbench.methods.occfusion.method import OccFusion
from ihbench.scene.contracts import TrainingSet, TrainView
from ihbench.stress.case import Answer, Case, words_of
from ihbench.stress.six_views import all_unknown, training_set, views, with_bad_hidden_pixels, with_bad_pixel
from ihbench.stress.training import error_of_alpha, story_of_fit

# changes of the set after 12 and 15 of 16 steps; without the network of the weights, which takes most of the time
TINY = replace(
    SMOKE,
    steps=8,
    refine=replace(SMOKE.refine, steps=8),
    density=DensityConfig(after=9, before=16, every=3),
    inpaint=InpaintConfig(on=False),
    lr_opacity=0.4,
    lr_colour=0.08,
    weight_network=False,
)
PAINTS = {"inpaint": InpaintConfig(key_frames=2, mask_steps=1, steps=1), "score": ScoreConfig(every=4)}
RATES = ("lr_position", "lr_scale", "lr_rotation", "lr_opacity", "lr_colour", "lr_networks")

HELPS = "the error of alpha over the views after the fit, over that before: a fit that does not lower it is none"
STEP = "a step is counted"
REFUSED = "it must be refused, and the line must say this"


def fit(config: OccFusionConfig, training: TrainingSet | None = None, ledger: Ledger | None = None) -> Any:
    return OccFusion(config).fit(
        training or training_set(), device="cpu", seed=0, ledger=ledger or Ledger(), progress=Progress.silent()
    )


def story(config: OccFusionConfig, training: TrainingSet | None = None) -> tuple[Any, str]:
    """The avatar, None where it diverged, and what happened on the way."""
    ledger = Ledger()
    return story_of_fit(lambda: fit(config, training, ledger), ledger)


def _ratio(config: OccFusionConfig, training: TrainingSet | None = None) -> Answer:
    """Error after over error before."""
    from ihbench.methods.occfusion.avatar import OccFusionAvatar

    training = training or training_set()
    after, what = story(config, training)
    before = error_of_alpha(OccFusionAvatar(config, training.body, 0), training)
    return Answer(math.nan if after is None else error_of_alpha(after, training) / before, 1.0, note=what)


def scaled_rates(factor: float) -> OccFusionConfig:
    config = replace(TINY)
    for name in RATES:  # past the switches' bounds: the guard of a fit must hold whatever reaches it
        object.__setattr__(config, name, factor * getattr(TINY, name))
    return config


def _survives(factor: float) -> Answer:
    """Either the fit ends with a finite avatar, or it is a divergence with its first bad step: never a crash, never
    NaN in a picture."""
    after, what = story(scaled_rates(factor))
    if after is None:
        return Answer(what, "diverged, first bad step")
    rgb, alpha = after.render(views()[0].camera, views()[0].body_pose)
    return Answer(f"finite {bool(np.isfinite(rgb).all() and np.isfinite(alpha).all())}: {what}", "finite True")


def _nothing(shown: Sequence[TrainView]) -> Answer:
    return Answer(words_of(BadInput, lambda: fit(TINY, training_set(shown))), "nothing to fit")


def _all_pruned() -> Answer:
    return Answer(story(replace(TINY, density=replace(TINY.density, faint=1.0)))[1], "would prune all of")


def _bad_pixel(bad: float) -> Answer:
    """One pixel of one view is not finite; smaller steps cannot help, so none is tried."""
    after, what = story(TINY, with_bad_pixel(2, bad))
    assert after is None
    return Answer(what, "loss is ")


def _training(name: str, what: str, function: Callable[[], Answer], unit: Any, why: str) -> Case:
    return Case(f"occfusion-{name}", what, function, unit, 0, why, "training")


_helps = partial(_training, unit="at most", why=HELPS)
_step = partial(_training, unit="words", why=STEP)
_refused = partial(_training, unit="words", why=REFUSED)

CASES = [
    _helps("rate-1", "step sizes as they are, with painting and distillation",
           lambda: _ratio(replace(TINY, **PAINTS))),
    *(
        _step(f"rate-{factor:g}", f"step sizes × {factor:g}", partial(_survives, factor))
        for factor in (100.0, 1e4, 1e30)
    ),
    _helps("one-frame", "one training frame", lambda: _ratio(TINY, training_set(views()[1:2]))),
    _helps("empty-mask", "two frames without a visible pixel",
           lambda: _ratio(TINY, training_set([views()[0], *all_unknown()[1:3], *views()[3:]]))),
    _refused("no-view", "no training view", partial(_nothing, [])),
    _refused("all-hidden", "views without a visible pixel", lambda: _nothing(all_unknown())),
    _step("all-pruned", "an opacity of 1 is asked of every Gaussian", _all_pruned),
    _step("nan-pixel", "a NaN among the person's pixels", partial(_bad_pixel, math.nan)),
    _step("inf-pixel", "an infinite person pixel", partial(_bad_pixel, math.inf)),
    _helps("nan-hidden", "NaN behind the occluder", lambda: _ratio(TINY, with_bad_hidden_pixels(1, math.nan))),
]  # fmt: skip
