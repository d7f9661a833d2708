"""Stiff training of Wild2Avatar: what is asked of every such fit (`stress.fit_cases`), rays that see nothing, a
person whose surface has vanished, and a kill. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.wild2avatar.config import SMOKE, Wild2AvatarConfig
from ihbench.methods.wild2avatar.method import Wild2Avatar
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import FitCases
from ihbench.stress.six_views import training_set, views

# every part in 18 steps, three looks at the surface among them
TINY = replace(
    SMOKE,
    steps=18,
    scene="constant",
    rays=64,
    sdf_width=32,
    sdf_depth=2,
    colour_width=16,
    body_fit=80,
    even_samples=12,
    samples_by_weight=5,
    samples_extra=2,
    scene_width=16,
    scene_depth=2,
    scene_samples=4,
    eikonal_points=32,
    refresh_epochs=1,
    lr_sdf=2e-3,
)
RATES = ("lr", "lr_sdf", "lr_beta")


def fit(config: Wild2AvatarConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return Wild2Avatar(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: Wild2AvatarConfig, training: TrainingSet) -> Any:
    """The avatar that a fit begins with: the body, in no colour."""
    from ihbench.fit.training_poses import TrainingPoses
    from ihbench.methods.wild2avatar.avatar import Wild2AvatarAvatar

    betas = training.views[0].body_pose.betas
    return Wild2AvatarAvatar(config, training.body, betas, TrainingPoses.of(training.views), 0)


def begun(config: Wild2AvatarConfig, training: TrainingSet) -> Any:
    avatar = start(config, training)
    avatar.fit_to_body()
    return avatar


def _vanished() -> Answer:
    """A distance field that is positive everywhere: nothing is drawn, and no gradient is NaN."""
    import torch

    from ihbench.methods.wild2avatar.fitting import Wild2AvatarFit

    avatar, training = begun(TINY, training_set()), training_set()
    with torch.no_grad():
        avatar.field.sdf.last.bias[0] += 10.0
    Wild2AvatarFit(avatar, training, 0, Ledger())._one_step(0)
    view = views()[0]
    rgb, alpha = avatar.render(view.camera, view.body_pose)
    finite = all(p.isfinite().all() for p in avatar.parameters()) and bool(np.isfinite(rgb).all())
    return Answer(f"finite {finite}, alpha {alpha.max():.0f}", "finite True, alpha 0")


def stage(avatar: Any, training: TrainingSet, ledger: Ledger) -> Any:
    """The fit of an avatar that has begun."""
    from ihbench.methods.wild2avatar.fitting import Wild2AvatarFit

    return Wild2AvatarFit(avatar, training, 0, ledger)


OURS = FitCases("wild2avatar", TINY, RATES, fit, begun)
CASES = [
    *OURS.usual(TINY, replace(TINY, steps=45), None),
    OURS.case("vanished", "a surface that is nowhere", _vanished, "words", "an empty picture is a picture"),
    OURS.resumed(stage, fresh=start),
]
