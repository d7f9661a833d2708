"""As isometric as possible: a deformation should keep the distances between neighbouring Gaussians, and between their
covariances (3DGS-Avatar, utils/loss_utils.py:69-103)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

NEIGHBOURS = 4  # released: the five nearest, the Gaussian itself among them
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def stretching(
    before: Tensor,  # [N, D]
    after: Tensor,  # [N, D]
    neighbours: Tensor,  # [N, k] int64
) -> Tensor:
    """Mean over Gaussians and neighbours of | |a_i - a_j| - |b_i - b_j| |; 0 without a neighbour. Both sides have
    gradients; where two coincide a distance has none."""
    if not neighbours.numel():
        return before.new_zeros(())
    lengths = [
        torch.linalg.vector_norm(values[:, None, :] - values[neighbours], dim=-1) for values in (before, after)
    ]
    return (lengths[0] - lengths[1]).abs().mean()


def six_entries(
    covariances: Tensor,  # [N, 3, 3]
    how: str = "released",
) -> Tensor:
    """[N, 6] xx, xy, xz, yy, yz, zz. Their distance is not that of the matrices, and changes when both are turned;
    how="invariant" weighs entries off the diagonal by √2, so that it is."""
    rows, columns = zip(*ENTRIES, strict=True)
    entries = covariances[:, list(rows), list(columns)]
    if how == "invariant":
        weights = [1.0 if row == column else math.sqrt(2) for row, column in ENTRIES]
        entries = entries * entries.new_tensor(weights)
    return entries
