"""Linear blend skinning in numpy float64: the slow and obvious twin of `skinning.py`, and what `Body.pose` uses.

Source of the formula: SMPL (Loper et al. 2015, equations 2-6) without its implementation tricks.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def axis_angle_to_matrix(
    rotation: Array,  # [..., 3] rad
) -> Array:
    """Rodrigues' formula, [..., 3] axis-angle -> [..., 3, 3] rotation matrices. The zero vector is the identity."""
    rotation = np.asarray(rotation, np.float64)
    angle = np.linalg.norm(rotation, axis=-1)
    x, y, z = np.moveaxis(rotation / np.where(angle == 0, 1, angle)[..., None], -1, 0)
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*angle.shape, 3, 3)
    sine = np.sin(angle)[..., None, None]
    one_minus_cosine = 2 * np.sin(angle / 2)[..., None, None] ** 2  # 1 - cos loses every digit at small angles
    return np.eye(3) + sine * K + one_minus_cosine * (K @ K)


def joint_transforms(
    pose: Array,  # [24, 3] rad, axis-angle, root first
    joints: Array,  # [24, 3] m, joints of the shaped rest pose
    parents: Sequence[int] | NDArray[np.integer],  # [24] -1 for the root, parents before children
    transl: Array | None = None,  # [3] m
) -> Array:
    """[24, 4, 4] transforms that take points of the rest pose to the posed world, one per joint.

    The root turns about joint 0, then everything moves by `transl`.
    """
    rotations = axis_angle_to_matrix(pose)
    world = np.zeros((len(joints), 4, 4))  # joint frame -> world
    for k, parent in enumerate(parents):
        local = np.eye(4)
        local[:3, :3] = rotations[k]
        local[:3, 3] = joints[k] if parent < 0 else joints[k] - joints[parent]
        world[k] = local if parent < 0 else world[parent] @ local
    out = world.copy()
    out[:, :3, 3] -= np.einsum("kab,kb->ka", world[:, :3, :3], joints)
    if transl is not None:
        out[:, :3, 3] += transl
    return out


def lbs(
    points: Array,  # [N, 3] m, rest pose
    weights: Array,  # [N, 24], rows sum to 1
    transforms: Array,  # [24, 4, 4]
) -> Array:
    """[N, 3] m: every point moved by its own weighted mean of the joint transforms."""
    blended = np.tensordot(weights, transforms[:, :3], 1)  # [N, 3, 4]
    return np.einsum("nab,nb->na", blended[:, :, :3], points) + blended[:, :, 3]


def pose_blend_offsets(
    pose: Array,  # [24, 3] rad
    posedirs: Array,  # [V, 3, 207]
) -> Array:
    """[V, 3] m: SMPL's pose-dependent correctives, linear in the entries of R_1 .. R_23 minus the identity."""
    feature = axis_angle_to_matrix(pose[1:]) - np.eye(3)
    return posedirs @ feature.reshape(-1)
