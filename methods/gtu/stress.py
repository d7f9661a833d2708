"""Stiff training of GTU: what is asked of every such fit (`stress.fit_cases`), Gaussians that are all too faint, and
a kill among its guesses. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.gtu.config import SMOKE, GtuConfig
from ihbench.methods.gtu.method import Gtu
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import PRUNED, STEP, FitCases
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import training_set

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


def fit(config: GtuConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return Gtu(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: GtuConfig, training: TrainingSet) -> Any:
    """The avatar before the fit."""
    from ihbench.methods.gtu.avatar import GtuAvatar

    return GtuAvatar(config, training.body, np.zeros(10), [view.body_pose.pose for view in training.views])


def _all_pruned() -> Answer:
    """Every Gaussian is too faint: density control says what it would do. With the vertices of the body spared it
    would prune none, so they all stay, faint."""
    after, what = OURS.story(replace(TINY, density=replace(TINY.density, faint=1.0)))
    if after is None:
        return Answer(what, "diverged, first bad step")
    return Answer(f"{len(after) - len(after.body.v_template)} more than vertices: {what}", "0 more than vertices")


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

    whole = start(config, training)
    stage(whole, Ledger()).run(Progress.silent())
    return Answer(changed_by_a_kill(lambda: start(config, training), stage, whole), 0)


OURS = FitCases("gtu", TINY, RATES, fit, start)
CASES = [
    *OURS.usual(TINY, TINY, None),
    OURS.case("all-pruned", PRUNED, _all_pruned, "words", STEP),
    OURS.case("resumed", "killed among guesses and gone on with", _resumed, "absolute", "not a bit may change"),
]
