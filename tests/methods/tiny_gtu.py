"""A GTU of few iterations with a tiny diffusion backbone. For tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.gtu.avatar import GtuAvatar
from ihbench.methods.gtu.config import PAPER, SMOKE
from ihbench.methods.gtu.fitting import GtuFit
from ihbench.methods.gtu.guesser import Guesser
from ihbench.scene.contracts import TrainingSet
from tests.bench.fake_capture import WHITE, the_body
from tests.diffusion.tiny_diffusion import CROP, tiny_backbone

# twelve iterations, guesses in the 7th, 9th and 11th; vertices go free after five; the set changes at 6 and 9
TINY = replace(
    SMOKE,
    steps=12,
    photo_steps=6,
    sds_every=2,
    second_stage=2,
    third_stage=3,
    reset_until=6,
    sh_every=5,
    grid=12,
    density=replace(PAPER.density, after=4, before=11, every=3, gradient=1e-9, most=9000),
    prune_until=12,
    identity=replace(SMOKE.identity, steps=4, batch=2),
)
NEVER = DensityConfig(after=0, before=0)


def an_avatar(training: TrainingSet, **changes: Any) -> GtuAvatar:
    return GtuAvatar(
        replace(TINY, **changes), the_body(), np.zeros(10), [view.body_pose.pose for view in training.views]
    )


def cropped(training: TrainingSet) -> list[CropView]:
    return [cut_view(view, k, the_body(), CROP, square=True) for k, view in enumerate(training.views)]


def a_fit(training: TrainingSet, seed: int = 0, ledger: Ledger | None = None, **changes: Any) -> GtuFit:
    """With a guesser where the configuration asks for one."""
    avatar = an_avatar(training, **changes)
    guesser = None
    if avatar.config.guesses:
        guesser = Guesser(tiny_backbone(), [], avatar, cropped(training), WHITE, seed)
    return GtuFit(avatar, training, seed, ledger or Ledger(), guesser)


def fitted(training: TrainingSet, seed: int = 0, ledger: Ledger | None = None, **changes: Any) -> GtuAvatar:
    fit = a_fit(training, seed, ledger, **changes)
    fit.run(Progress.silent())
    return fit.avatar
