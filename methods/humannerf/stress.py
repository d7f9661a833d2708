"""Stiff training of HumanNeRF: what is asked of every such fit (`stress.fit_cases`), both ways to take hidden pixels,
fits that stay empty, and a kill. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.humannerf.config import SMOKE, HumanNerfConfig, in_steps
from ihbench.methods.humannerf.method import HumanNerfMethod
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import STEP, FitCases
from ihbench.stress.six_views import training_set, views

# whole pictures, so that a bad pixel is met; every part is on before the end; no fog and whole steps from the first
# on, since 18 steps do not undo a fog of 5/m
TINY = replace(
    in_steps(SMOKE, 18),
    depth=4,
    width=32,
    bands=5,
    samples=32,
    patches=1,
    patch_px=48,
    lpips=0.0,
    mse=1.0,
    kick_in=5,
    full_band=12,
    first_density=0.0,
    warm_up=0,
)
RATES = ("lr", "lr_motion", "lr_non_rigid", "lr_poses")


def fit(config: HumanNerfConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return HumanNerfMethod(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: HumanNerfConfig, training: TrainingSet) -> Any:
    """The avatar that a fit begins with."""
    from ihbench.methods.humannerf.avatar import HumanNerfAvatar

    return HumanNerfAvatar(config, training.body, training.views[0].body_pose.betas, 0)


def _empty() -> Answer:
    """Nobody is on the person's pixels and nobody may be: the fit starts again, and ends as a divergence."""
    config = replace(TINY, on_person=0.0, lr=0.3, guard=(6,))
    shown = [replace(view, mask=np.where(np.arange(view.mask.size).reshape(view.mask.shape) == view.mask.argmax(),
             view.mask, 0).astype(np.uint8)) for view in views()]  # fmt: skip
    return Answer(OURS.story(config, training_set(shown))[1], "new starts")


def stage(avatar: Any, training: TrainingSet, ledger: Ledger) -> Any:
    """The fit of an avatar that has begun."""
    from ihbench.methods.humannerf.fitting import HumanNerfFit

    return HumanNerfFit(avatar, training, 0, ledger)


OURS = FitCases("humannerf", TINY, RATES, fit, start)
CASES = [
    *OURS.usual(TINY, TINY, None),
    *OURS.ignoring(),
    OURS.case("empty", "everything is background", _empty, "words", STEP),
    OURS.resumed(stage),
]  # fmt: skip
