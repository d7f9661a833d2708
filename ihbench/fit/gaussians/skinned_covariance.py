"""Covariances of Gaussians from scales and quaternions, and what the linear part of skinning makes of them.

Linear blend skinning moves a point x to B x + t; a Gaussian's covariance then becomes Σ_w = B Σ Bᵀ. B is a blend of
rotations, so near joints it shears and shrinks, and is kept as it is (GauHuman, scene/gaussian_model.py; 3DGS-Avatar,
models/deformer/rigid.py; GTU, gtu/smpl_deformer/deformer.py). Quaternions are (w, x, y, z) of any length.
"""

from __future__ import annotations

import torch
from torch import Tensor


def quaternion_to_matrix(
    quaternions: Tensor,  # [..., 4] w first, of any length
) -> Tensor:
    """[..., 3, 3] rotation matrices. The zero quaternion, which has no direction, counts as no rotation."""
    length = quaternions.norm(dim=-1, keepdim=True)
    w, x, y, z = (quaternions / torch.where(length > 0, length, torch.ones_like(length))).unbind(-1)
    rows = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def skinned_covariance(
    scales: Tensor,  # [..., 3] m, standard deviations along the Gaussian's own axes
    quaternions: Tensor,  # [..., 4] w first
    linear: Tensor | None = None,  # [..., 3, 3] B
) -> Tensor:
    """[..., 3, 3] m²: B R diag(s²) Rᵀ Bᵀ, or without B the covariance at rest.

    As M Mᵀ with M = B R diag(s): symmetric to the bit, and no eigenvalue is negative beyond rounding, whatever B is.
    """
    factor = quaternion_to_matrix(quaternions) * scales[..., None, :]
    if linear is not None:
        factor = linear @ factor
    covariance = factor @ factor.mT
    return (covariance + covariance.mT) / 2  # a matrix product may round (i, j) and (j, i) apart


def blended_linear(
    weights: Tensor,  # [N, J] skinning weights, rows sum to 1
    transforms: Tensor,  # [..., J, 4, 4]
) -> Tensor:
    """[..., N, 3, 3] the linear part of every Gaussian's own blend of the joints' transforms."""
    return (weights @ transforms[..., :3, :3].flatten(-2)).unflatten(-1, (3, 3))
