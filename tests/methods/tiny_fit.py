"""The smallest InpaintHuman that still does everything, and a person of six frames to fit it to. For tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ihbench.body.pose import BodyPose
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.config import QUICK
from ihbench.methods.inpainthuman.stages.stage1 import Stage1
from ihbench.scene.contracts import TrainingSet, TrainView
from tests.bench.fake_capture import WHITE, a_camera, a_pose, the_body, train_view

SIZE = 64  # px
STRIP = slice(28, 35)  # columns hidden in half of the views
TINY = replace(
    QUICK,
    texels=64,
    levels=(16, 32, 64),
    channels=8,
    decoder_width=32,
    position_map=32,
    residual_channels=8,
    steps=10,
    precision="float32",  # what a measurement says may change from one run to the next
    inpaint=replace(QUICK.inpaint, on=False),
)


def an_avatar(seed: int = 0, betas: Any = None, **changes: Any) -> GaussianAvatar:
    return GaussianAvatar(replace(TINY, **changes), the_body(), np.zeros(10) if betas is None else betas, seed)


def shaken(avatar: GaussianAvatar, by: float = 0.3, seed: int = 1) -> GaussianAvatar:
    """The avatar with noise on all its parameters: nothing is zero, grey or on the surface any more."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter += by * torch.randn(parameter.shape, generator=generator)
    return avatar


def training_views() -> list[TrainView]:
    """Six sides of a person who bends; every other view has the strip."""
    return [
        train_view(a_camera(0.0, SIZE), a_pose(1.05 * k, 0.3 * np.sin(k)), STRIP if k % 2 else None, frame=k)
        for k in range(6)
    ]


def training_set(views: list[TrainView] | None = None, background: tuple[float, float, float] = WHITE) -> TrainingSet:
    return TrainingSet(training_views() if views is None else views, the_body(), background, "tiny")


def fitted(
    training: TrainingSet,
    seed: int = 0,
    ledger: Ledger | None = None,
    progress: Progress | None = None,
    **changes: Any,
) -> GaussianAvatar:
    """An avatar after stage 1."""
    avatar = an_avatar(seed, **changes)
    Stage1(avatar, training, seed, ledger or Ledger()).run(progress or Progress.silent())
    return avatar


def random_pose(seed: int, spread: float = 0.3, betas: Any = None) -> BodyPose:
    rng = np.random.default_rng(seed)
    return BodyPose(rng.normal(0, spread, (24, 3)), np.zeros(10) if betas is None else betas, rng.normal(0, 0.5, 3))


def parameters_of(avatar: GaussianAvatar) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in avatar.named_parameters()}


def everything(avatar: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Its parameters and buffers, copied."""
    return {name: value.detach().clone() for name, value in avatar.state_dict().items()}


def equal_bits(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)
