"""Linear blend skinning in torch: differentiable, any leading batch dimensions, in the caller's dtype and device.

Same functions as `skinning_numpy.py`, compared with it forward and by gradcheck in the tests.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# Below this squared angle the series is exact to double precision (the first term left out is theta^6 / 5040).
SERIES_BELOW = 1e-4


def axis_angle_to_matrix(
    rotation: Tensor,  # [..., 3] rad
) -> Tensor:
    """Rodrigues' formula, [..., 3] axis-angle -> [..., 3, 3] rotation matrices.

    The gradient is finite and right everywhere, the zero vector included: near zero a series in the squared angle
    takes over, and the branch that is not taken is fed an angle of 1 so that its gradient is 0 and not NaN.
    """
    squared = (rotation * rotation).sum(-1)
    small = squared < SERIES_BELOW
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    half_sine = torch.sin(angle / 2) / angle
    first = torch.where(small, 1 - squared / 6 * (1 - squared / 20), torch.sin(angle) / angle)
    second = torch.where(small, 0.5 - squared / 24 * (1 - squared / 30), 2 * half_sine * half_sine)
    x, y, z = rotation.unbind(-1)
    zero = torch.zeros_like(x)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    identity = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return identity + first[..., None, None] * K + second[..., None, None] * (K @ K)


def joint_transforms(
    pose: Tensor,  # [..., 24, 3] rad, axis-angle, root first
    joints: Tensor,  # [..., 24, 3] m, joints of the shaped rest pose
    parents: Sequence[int],  # [24] -1 for the root, parents before children
    transl: Tensor | None = None,  # [..., 3] m
) -> Tensor:
    """[..., 24, 4, 4] transforms that take points of the rest pose to the posed world, one per joint.

    The root turns about joint 0, then everything moves by `transl`.
    """
    return transforms_of_rotations(axis_angle_to_matrix(pose), joints, parents, transl)


def transforms_of_rotations(
    local: Tensor,  # [..., 24, 3, 3] of each joint against its parent, root first
    joints: Tensor,  # [..., 24, 3] m, joints of the shaped rest pose
    parents: Sequence[int],  # [24] -1 for the root, parents before children
    transl: Tensor | None = None,  # [..., 3] m
) -> Tensor:
    """`joint_transforms` of rotation matrices."""
    joints = joints.expand(*torch.broadcast_shapes(local.shape[:-1], joints.shape))
    rotations: list[Tensor] = []  # [..., 3, 3] of each joint in the world
    origins: list[Tensor] = []  # [..., 3] of each joint in the world
    for k, parent in enumerate(int(p) for p in parents):
        joint = joints[..., k, :]
        if parent < 0:
            rotations.append(local[..., k, :, :])
            origins.append(joint)
        else:
            bone = (joint - joints[..., parent, :])[..., None]
            rotations.append(rotations[parent] @ local[..., k, :, :])
            origins.append(origins[parent] + (rotations[parent] @ bone)[..., 0])
    rotation = torch.stack(rotations, -3)
    shift = torch.stack(origins, -2) - (rotation @ joints[..., None])[..., 0]
    if transl is not None:
        shift = shift + transl[..., None, :]
        rotation = rotation.expand(*shift.shape[:-1], 3, 3)
    top = torch.cat([rotation, shift[..., None]], -1)
    bottom = torch.tensor([0, 0, 0, 1], dtype=top.dtype, device=top.device).expand(*top.shape[:-2], 1, 4)
    return torch.cat([top, bottom], -2)


def lbs(
    points: Tensor,  # [..., N, 3] m, rest pose
    weights: Tensor,  # [N, 24], rows sum to 1
    transforms: Tensor,  # [..., 24, 4, 4]
) -> Tensor:
    """[..., N, 3] m: every point moved by its own weighted mean of the joint transforms."""
    blended = (weights @ transforms[..., :3, :].flatten(-2)).unflatten(-1, (3, 4))
    return (blended[..., :3] @ points[..., None])[..., 0] + blended[..., 3]


def pose_blend_offsets(
    pose: Tensor,  # [..., 24, 3] rad
    posedirs: Tensor,  # [V, 3, 207]
) -> Tensor:
    """[..., V, 3] m: SMPL's pose-dependent correctives, linear in the entries of R_1 .. R_23 minus the identity."""
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
    feature = (axis_angle_to_matrix(pose[..., 1:, :]) - identity).flatten(-3)
    return (feature @ posedirs.flatten(0, 1).mT).unflatten(-1, (-1, 3))
