"""Stiff training of OccNeRF: what is asked of every such fit (`stress.fit_cases`), both ways to take hidden pixels,
a person in one pixel, an infinite prior, and a kill. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.occnerf.config import SMOKE, OccNerfConfig
from ihbench.methods.occnerf.method import OccNerf
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import STEP, FitCases
from ihbench.stress.six_views import only_a_pixel, training_set, views

TINY = replace(SMOKE, steps=18, decay_steps=18, samples=32, inside=0, levels=3, hash_size=8, hash_finest=32)
RATES = ("lr", "lr_grid", "lr_displacement", "lr_motion")


def fit(config: OccNerfConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return OccNerf(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: OccNerfConfig, training: TrainingSet) -> Any:
    """The avatar that a fit begins with."""
    from ihbench.methods.occnerf.avatar import OccNerfAvatar

    betas = np.mean([view.body_pose.betas for view in training.views], 0)
    return OccNerfAvatar(config, training.body, betas, 0)


def _one_pixel() -> Answer:
    """One pixel of a person per view: patches around it, and everything else is background."""
    shown = [only_a_pixel(k, MaskState.BACKGROUND) for k in range(6)]
    avatar, what = OURS.story(TINY, training_set(shown))
    if avatar is None:
        return Answer(what, "no step rejected")
    rgb, alpha = avatar.render(shown[0].camera, shown[0].body_pose)
    return Answer(f"finite {bool(np.isfinite(rgb).all() and np.isfinite(alpha).all())}: {what}", "finite True")


def _huge_prior() -> Answer:
    """A completeness prior a million times as heavy: gradients are clipped, alpha is still finite."""
    avatar, what = OURS.story(replace(TINY, completeness_weight=1e6))
    if avatar is None:
        return Answer(what, "no step rejected")
    alpha = avatar.render(views()[0].camera, views()[0].body_pose)[1]
    return Answer(f"finite {bool(np.isfinite(alpha).all())}: {what}", "finite True")


def stage(avatar: Any, training: TrainingSet, ledger: Ledger) -> Any:
    """The fit of an avatar that has begun."""
    from ihbench.methods.occnerf.fitting import OccNerfFit

    return OccNerfFit(avatar, training, 0, ledger)


OURS = FitCases("occnerf", TINY, RATES, fit, start)
CASES = [
    *OURS.usual(TINY, TINY, None),
    *OURS.ignoring(),
    OURS.helps("released-prior", "the completeness prior as released",
               lambda: OURS.ratio(replace(TINY, completeness="released"))),
    OURS.case("one-pixel", "one person pixel a view", _one_pixel, "words", STEP),
    OURS.case("huge-prior", "a completeness prior a million times as heavy", _huge_prior, "words", STEP),
    OURS.resumed(stage, config=replace(TINY, inside=8)),
]  # fmt: skip
