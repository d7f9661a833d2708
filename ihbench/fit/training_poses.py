"""What is learned for single training frames: a pose, a translation and a latent code each, and one shape for all.

As in 3DGS-Avatar, models/pose_correction/pose_correction.py:164-219 and models/texture/texture.py, and Vid2Avatar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body.pose import BodyPose
from ihbench.body.skinning import axis_angle_to_matrix
from ihbench.scene.contracts import TrainView

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrainingPoses:
    """The frames that were trained on, each once, in their order, and their poses as given."""

    frames: tuple[int, ...]
    poses: Array  # [F, 24, 3] rad
    transl: Array  # [F, 3] m

    @classmethod
    def of(cls, views: Sequence[TrainView]) -> TrainingPoses:
        known: dict[int, BodyPose] = {}
        for view in views:
            known.setdefault(view.frame, view.body_pose)
        given = list(known.values())
        return cls(tuple(known), np.stack([p.pose for p in given]), np.stack([p.transl for p in given]))

    def row(self, frame: int | None) -> int | None:
        """Of the tables; None for a frame that was not trained on."""
        return self.frames.index(frame) if frame in self.frames else None


@dataclass(frozen=True)
class PosesRefined:
    """How far the fit has moved the training frames' poses."""

    kind: ClassVar[str] = "poses_refined"
    frames: int
    mean_deg: float  # of the joints' rotations, root included
    largest_deg: float
    mean_mm: float  # of the translations
    shape: float  # largest change of a shape coefficient


class PoseTables(nn.Module):
    """Start as given. A frame that is never drawn keeps its row."""

    def __init__(self, training: TrainingPoses, betas: Array):
        super().__init__()
        self.poses = nn.Parameter(torch.from_numpy(training.poses.astype(np.float32)))
        self.transl = nn.Parameter(torch.from_numpy(training.transl.astype(np.float32)))
        self.betas = nn.Parameter(torch.from_numpy(betas.astype(np.float32)))

    @torch.no_grad()
    def moved(self, training: TrainingPoses, betas: Array) -> PosesRefined:
        """How far they are from what they were given."""
        given, now = (
            axis_angle_to_matrix(poses.double().cpu()) for poses in (torch.from_numpy(training.poses), self.poses)
        )
        trace = (given.mT @ now).diagonal(dim1=-2, dim2=-1).sum(-1)
        degrees = torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())
        shift = torch.from_numpy(training.transl) - self.transl.double().cpu()
        shape = np.abs(self.betas.double().cpu().numpy() - betas).max(initial=0.0)
        return PosesRefined(
            len(training.frames),
            round(float(degrees.mean()), 4),
            round(float(degrees.max()), 4),
            round(1000 * float(shift.norm(dim=1).mean()), 3),
            round(float(shape), 5),
        )


def latent_codes(frames: int, width: int, generator: torch.Generator) -> Tensor:
    """[F, width] from N(0, 1)."""
    return torch.randn(frames, width, generator=generator)
