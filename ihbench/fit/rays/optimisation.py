"""The step by step fit of a radiance field.

What is drawn at random (patches, samples on rays, backgrounds) depends on seed and step alone, so that a killed fit
goes on to the same bits.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.fit.optimisation import Module, Optimisation, ParameterGroup
from ihbench.fit.rays.ray_target import RayTarget, Unknown, ray_target
from ihbench.nets.motion_weights import MARGIN
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 128  # prepared views in memory, 1 MB each at 256 px
PIXELS, DEPTHS, BACKGROUND = range(1, 4)  # what random numbers are drawn for; a method's own begin at 10
TENTH = 0.1  # of the first step sizes, after `decay_steps`


class FieldOptimisation(Optimisation[Module]):
    """One view a step. Step sizes fall exponentially, to a tenth after `decay_steps`, as HumanNeRF's and OccNeRF's.

    Gradients are clipped by group to `clip_gradient`; infinity for not at all.
    """

    def __init__(
        self,
        avatar: Module,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        groups: Sequence[ParameterGroup],
        *,
        steps: int,
        decay_steps: int,
        clip_gradient: float = float("inf"),
        unknown: Unknown = "background",
        margin: float = MARGIN,  # m around the posed joints, of the boxes
    ):
        views = len(training.views)
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups,
            steps=steps,
            views=views,
            lr_final=1.0,
            clip_gradient=clip_gradient,
        )
        self.decay_steps = decay_steps
        self.targets: LazyViews[RayTarget] = LazyViews(
            lambda k: ray_target(training.views[k], k, training.body, unknown, margin), views, held=TARGETS_HELD
        )

    @abstractmethod
    def _loss(self, k: int) -> Tensor: ...

    def _rate_share(self) -> float:
        return TENTH ** (self.step / self.decay_steps)

    def rng(self, what: int) -> np.random.Generator:
        """For one purpose in this step."""
        return np.random.default_rng((self.seed, self.step, what))

    def random_background(self) -> Tensor:
        """[3] this step's colour behind the person, evenly drawn."""
        parameter = next(self.avatar.parameters())
        return torch.from_numpy(self.rng(BACKGROUND).random(3)).to(parameter)
