"""ZJU-MoCap's root (Rh, Th) and SMPL's own root, converted both ways.

SMPL turns the body about joint 0 and then moves it: v = R(theta_0) (v0 - J0) + J0 + t. ZJU-MoCap poses the body with
a zero root and then moves it about the model's origin: v = R(Rh) v0 + Th. Hence Rh = theta_0 and Th = t + J0 - R J0.
Source: zju3dv/neuralbody zju_smpl/smplmodel/body_model.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import pose_hint
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.body.model import Body

Array = NDArray[np.float64]


def zju_root(body_pose: BodyPose, body: Body) -> tuple[Array, Array]:
    """(Rh [3] rad, Th [3] m) of a pose in the standard SMPL root convention."""
    pelvis = body.shaped(body_pose.betas)[1][0]
    Rh = body_pose.pose[0].copy()
    return Rh, body_pose.transl + pelvis - axis_angle_to_matrix(Rh) @ pelvis


def from_zju_root(
    pose: Array,  # 72 numbers with a zero root, or 69 without a root, in any shape; rad
    betas: Array,  # [B] or [1, B]
    Rh: Array,  # [3] or [1, 3] rad
    Th: Array,  # [3] or [1, 3] m
    body: Body,
) -> BodyPose:
    """The pose in the standard SMPL root convention that puts every vertex where ZJU-MoCap puts it.

    Raises `BadInput` when `pose` has another number of entries, or turns the root as well (then Rh is not all of it).
    """
    shape = np.shape(pose)
    pose = np.asarray(pose, np.float64).reshape(-1)
    if pose.size == 69:
        pose = np.concatenate([np.zeros(3), pose])
    if pose.size != 72:
        raise BadInput(
            f"ZJU body pose: expected 72 numbers (or 69 without the root), got {pose.size}{pose_hint(shape)}"
        )
    if pose[:3].any():
        raise BadInput("ZJU body pose: expected zeros in its first three numbers, because Rh holds the root rotation")
    pose = pose.reshape(24, 3).copy()
    pose[0] = np.asarray(Rh, np.float64).reshape(3)
    betas = np.asarray(betas, np.float64).reshape(-1)
    pelvis = body.shaped(betas)[1][0]
    transl = np.asarray(Th, np.float64).reshape(3) - pelvis + axis_angle_to_matrix(pose[0]) @ pelvis
    return BodyPose(pose, betas, transl)
