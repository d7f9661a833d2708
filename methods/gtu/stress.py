"""Stiff training of GTU: few iterations, a person of six small frames, and everything that goes wrong."""

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
from ihbench.methods.gtu.config import SMOKE, GtuConfig
from ihbench.methods.gtu.method import Gtu
from ihbench.scene.contracts import TrainingSet, TrainView
from ihbench.stress.case import Answer, Case, words_of
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import (
    all_unknown,
    error_of_alpha,
    training_set,
    views,
    with_bad_hidden_pixels,
    with_bad_pixel,
)
from ihbench.stress.training import story_of_fit

# photos alone, but for the case that is killed; the vertices are let go after six of 18 iterations
TINY = replace(
    SMOKE,
    steps=18,
    photo_steps=9,
    sds=False,
    reset_until=6,
    density=replace(SMOKE.density, after=9, before=17, every=3),
    grid=16,
    lr_position=4e-3,
)
RATES = ("lr_position", "lr_scale", "lr_rotation", "lr_opacity", "lr_colour", "lr_pose")

HELPS = "the error of alpha over the views after the fit, over that before: a fit that does not lower it is none"
STEP = "a step is counted"
REFUSED = "it must be refused, and the line must say this"
EXACT = "not a bit may change"


def fit(config: GtuConfig, training: TrainingSet | None = None, ledger: Ledger | None = None) -> Any:
    return Gtu(config).fit(
        training or training_set(), device="cpu", seed=0, ledger=ledger or Ledger(), progress=Progress.silent()
    )


def fresh(config: GtuConfig, training: TrainingSet) -> Any:
    """The avatar before the fit."""
    from ihbench.methods.gtu.avatar import GtuAvatar

    return GtuAvatar(config, training.body, np.zeros(10), [view.body_pose.pose for view in training.views])


def story(config: GtuConfig, training: TrainingSet | None = None) -> tuple[Any, str]:
    """The avatar, None where it diverged, and what happened on the way."""
    ledger = Ledger()
    return story_of_fit(lambda: fit(config, training, ledger), ledger)


def _ratio(config: GtuConfig, training: TrainingSet | None = None) -> Answer:
    """Error after over error before."""
    training = training or training_set()
    after, what = story(config, training)
    before = error_of_alpha(fresh(config, training), training)
    return Answer(math.nan if after is None else error_of_alpha(after, training) / before, 1.0, note=what)


def scaled_rates(factor: float) -> GtuConfig:
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


def _empty_mask() -> Answer:
    """Views in which the person is wholly hidden, among others."""
    return _ratio(TINY, training_set([views()[0], *all_unknown()[1:3], *views()[3:]]))


def _nothing(shown: Sequence[TrainView]) -> Answer:
    return Answer(words_of(BadInput, lambda: fit(TINY, training_set(shown))), "nothing to fit")


def _all_pruned() -> Answer:
    """Every Gaussian is too faint: density control says what it would do. With the vertices of the body spared it
    would prune none, so they all stay, faint."""
    after, what = story(replace(TINY, density=replace(TINY.density, faint=1.0)))
    if after is None:
        return Answer(what, "diverged, first bad step")
    return Answer(f"{len(after) - len(after.body.v_template)} more than vertices: {what}", "0 more than vertices")


def _bad_pixel(bad: float) -> Answer:
    """One pixel of one view is not finite; smaller steps cannot help, so none is tried."""
    after, what = story(TINY, with_bad_pixel(2, bad))
    assert after is None
    return Answer(what, "loss is ")


def _resumed() -> Answer:
    """Killed among guesses, and gone on with from the state of step 11: the same bits as without."""
    from ihbench.diffusion.crops.crop_view import cut_view
    from ihbench.diffusion.mini.weights import load_mini
    from ihbench.methods.gtu.fitting import GtuFit
    from ihbench.methods.gtu.guesser import Guesser

    config, training, backbone = replace(TINY, sds=True, sds_every=3), training_set(), load_mini()
    frames = [cut_view(view, k, training.body, 64, square=True) for k, view in enumerate(training.views)]
    backbone.size = 64  # a quarter of the pixels will do

    def stage(avatar: Any, ledger: Ledger) -> GtuFit:
        guesser = Guesser(backbone, [], avatar, frames, training.background, 0)
        return GtuFit(avatar, training, 0, ledger, guesser)

    whole = fresh(config, training)
    stage(whole, Ledger()).run(Progress.silent())
    return Answer(changed_by_a_kill(lambda: fresh(config, training), stage, whole), 0)


def _training(name: str, what: str, function: Callable[[], Answer], unit: Any, why: str) -> Case:
    return Case(f"gtu-{name}", what, function, unit, 0, why, "training")


_helps = partial(_training, unit="at most", why=HELPS)
_step = partial(_training, unit="words", why=STEP)
_refused = partial(_training, unit="words", why=REFUSED)

CASES = [
    _helps("rate-1", "step sizes as they are", lambda: _ratio(TINY)),
    *(
        _step(f"rate-{factor:g}", f"step sizes × {factor:g}", partial(_survives, factor))
        for factor in (100.0, 1e4, 1e30)
    ),
    _helps("one-frame", "one training frame", lambda: _ratio(TINY, training_set(views()[:1]))),
    _helps("empty-mask", "two frames without a visible pixel", _empty_mask),
    _refused("no-view", "no training view", partial(_nothing, [])),
    _refused("all-hidden", "views without a visible pixel", lambda: _nothing(all_unknown())),
    _step("all-pruned", "an opacity of 1 is asked of every Gaussian", _all_pruned),
    _step("nan-pixel", "a NaN among the person's pixels", partial(_bad_pixel, math.nan)),
    _step("inf-pixel", "an infinite person pixel", partial(_bad_pixel, math.inf)),
    _helps("nan-hidden", "NaN behind the occluder",
           lambda: _ratio(TINY, with_bad_hidden_pixels(1, math.nan))),
    _training("resumed", "killed among guesses and gone on with", _resumed, "absolute", EXACT),
]  # fmt: skip
