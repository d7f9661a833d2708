"""Stiff training of 3DGS-Avatar: what is asked of every such fit (`stress.fit_cases`), both ways to take hidden
pixels, a single Gaussian, and a kill. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.three_dgs_avatar.config import SMOKE, ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.method import ThreeDgsAvatarMethod
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import STEP, FitCases

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


def stage(avatar: Any, training: TrainingSet, ledger: Ledger) -> Any:
    """The fit of an avatar that has begun."""
    from ihbench.methods.three_dgs_avatar.fitting import ThreeDgsAvatarFit

    return ThreeDgsAvatarFit(avatar, training, 0, ledger)


OURS = FitCases("three-dgs-avatar", TINY, RATES, fit, start)
CASES = [
    *OURS.usual(TINY, TINY, replace(TINY, density=replace(TINY.density, faint=1.0))),
    *OURS.ignoring(),
    OURS.case("one-gaussian", "a single Gaussian", _one_gaussian, "words", STEP),
    OURS.resumed(stage),
]  # fmt: skip
