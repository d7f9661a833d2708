"""Stiff training of 3DGS-Avatar: what is asked of every such fit (`stress.fit_cases`), both ways to take hidden
pixels, a single Gaussian, shapes that differ by frame, and a kill. Named in the spec."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.three_dgs_avatar.config import SMOKE, ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.method import ThreeDgsAvatarMethod
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import STEP, FitCases
from ihbench.stress.resuming import changed_by_a_kill
from ihbench.stress.six_views import training_set, views, with_bad_hidden_pixels

# all of the schedule in 18 steps, but for a reset, which so few do not outlive
TINY = replace(
    SMOKE,
    steps=18,
    points=800,
    surface_samples=128,
    warm_up=60,
    hash_size=8,
    hash_finest=32,
    gaussians_from=2,
    non_rigid_from=6,
    poses_from=10,
    neighbours_every=6,
    density=replace(SMOKE.density, after=8, before=17, every=6, resets=()),
    lr_opacity=0.4,
)
RATES = ("lr_position", "lr_feature", "lr_opacity", "lr_scale", "lr_rotation",
         "lr_skinning", "lr_non_rigid", "lr_colour", "lr_poses")  # fmt: skip


def fit(config: ThreeDgsAvatarConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return ThreeDgsAvatarMethod(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: ThreeDgsAvatarConfig, training: TrainingSet) -> Any:
    """The avatar that a fit begins with."""
    from ihbench.fit.training_poses import TrainingPoses
    from ihbench.methods.three_dgs_avatar.avatar import ThreeDgsAvatar

    betas = training.views[0].body_pose.betas
    return ThreeDgsAvatar(config, training.body, betas, TrainingPoses.of(training.views), 0)


def _one_gaussian() -> Answer:
    """A single Gaussian has no neighbour to keep its distance from."""
    config = replace(TINY, points=1, density=replace(TINY.density, faint=None))
    avatar, what = OURS.story(config)
    return Answer(f"{0 if avatar is None else len(avatar)} left: {what}", "no step rejected")


def _other_shapes() -> Answer:
    """Shape coefficients that differ by frame: one avatar, with their mean."""
    shown = [
        replace(view, body_pose=replace(view.body_pose, betas=np.array([0.5 * (-1) ** k, 0.0])))
        for k, view in enumerate(views())
    ]
    return OURS.ratio(TINY, training_set(shown))


def _resumed() -> Answer:
    """Killed after a change of the set and with all parts on, and gone on with: the same bits as without."""
    from ihbench.methods.three_dgs_avatar.fitting import ThreeDgsAvatarFit

    training = training_set()
    whole, _ = OURS.story(TINY, training)
    assert whole is not None
    changed = changed_by_a_kill(
        lambda: start(TINY, training), lambda avatar, ledger: ThreeDgsAvatarFit(avatar, training, 0, ledger), whole
    )
    return Answer(changed, 0)


OURS = FitCases("three-dgs-avatar", TINY, RATES, fit, start)
IGNORING = replace(TINY, unknown="ignore")
CASES = [
    *OURS.usual(TINY, TINY, replace(TINY, density=replace(TINY.density, faint=1.0))),
    OURS.helps("empty-mask-ignored", "two frames without a visible pixel, hidden pixels are ignored",
               lambda: OURS.empty_masks(IGNORING)),
    OURS.helps("nan-hidden-ignored", "NaN behind the occluder, hidden pixels are ignored",
               lambda: OURS.ratio(IGNORING, with_bad_hidden_pixels(1, math.nan))),
    OURS.helps("other-shapes", "shape coefficients that differ by frame", _other_shapes),
    OURS.case("one-gaussian", "a single Gaussian", _one_gaussian, "words", STEP),
    OURS.case("resumed", "killed and gone on with", _resumed, "absolute", "what continues is the same fit"),
]  # fmt: skip
