"""From a posed frame back to the T-pose, bone by bone, in axes fixed to the person's root (HumanNeRF, OccNeRF)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body.pose import BodyPose
from ihbench.body.skinning import transforms_of_rotations
from ihbench.body.skinning_numpy import axis_angle_to_matrix

Array = NDArray[np.float64]


def root_frame(
    body_pose: BodyPose,
    joints: Array,  # [24, 3] m, rest joints of this pose's shape
) -> tuple[Array, Array]:
    """R [3, 3], t [3] m: a point p of the world is R p + t where the root is unturned and at its rest joint."""
    R = axis_angle_to_matrix(body_pose.pose[0]).T
    return R, joints[0] - R @ (joints[0] + body_pose.transl)


def bone_maps(
    rotations: Tensor,  # [23, 3, 3] of the joints other than the root against their parents
    joints: Tensor,  # [24, 3] m, rest joints of the frame's shape
    canonical: Tensor,  # [24, 3] m, joints of the canonical T-pose
    parents: Sequence[int],  # [24]
) -> Tensor:
    """[24, 3, 4] rigid maps F_i = C_i G_i⁻¹: x_i = F_i [x, 1] takes a point of the root's frame to where it would be
    in the canonical T-pose if it belonged to bone i (HumanNeRF, core/utils/network_util.py:125-157).

    Differentiable. Rotations are inverted as such: by their transpose.
    """
    root = torch.eye(3, dtype=rotations.dtype, device=rotations.device)[None]
    posed = transforms_of_rotations(torch.cat([root, rotations]), joints, parents)
    back = posed[:, :3, :3].mT
    shift = canonical - joints - (back @ posed[:, :3, 3:])[..., 0]
    return torch.cat([back, shift[..., None]], 2)
