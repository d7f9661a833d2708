"""Nearest neighbours among points by a k-d tree, deterministic, and the spacing that Gaussians start with."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

SMALLEST_SPACING = 1e-7**0.5  # m; coincident points would start as Gaussians of no size


def nearest(
    points: Tensor,  # [N, D] finite
    count: int,
) -> tuple[Tensor, Tensor]:
    """Distances [N, k] float64 and numbers [N, k] int64 of each point's nearest others, nearest first, with
    k = min(count, N - 1). A point is not its own neighbour, even where others coincide with it."""
    from scipy.spatial import KDTree

    where = points.detach().to("cpu", torch.float64).numpy()
    k = max(min(count, len(where) - 1), 0)
    if k == 0:
        none = torch.empty(len(where), 0, device=points.device)
        return none.double(), none.long()
    distance, number = (np.asarray(each) for each in KDTree(where).query(where, k + 1))
    own = number == np.arange(len(where))[:, None]
    # among many coincident points the point itself may be missing: then the farthest is one too many
    drop = np.where(own.any(1), own.argmax(1), k)
    keep = np.arange(k + 1) != drop[:, None]
    return (
        torch.from_numpy(distance[keep].reshape(-1, k)).to(points.device),
        torch.from_numpy(number[keep].reshape(-1, k).astype(np.int64)).to(points.device),
    )


def spacing(
    points: Tensor,  # [N, 3] m
) -> Tensor:
    """[N] m: root of the mean squared distance to the three nearest others, the standard deviation that Gaussians
    start with (simple-knn's distCUDA2, in GauHuman, 3DGS-Avatar and OccFusion), at least `SMALLEST_SPACING`."""
    distance, _ = nearest(points, 3)
    if not distance.shape[1]:
        return points.new_full((len(points),), SMALLEST_SPACING)
    return distance.square().mean(1).sqrt().clamp(min=SMALLEST_SPACING).to(points.dtype)


def distance_to(
    points: Tensor,  # [N, 3] m
    others: Tensor,  # [V, 3] m, at least one
) -> tuple[Tensor, Tensor]:
    """Distance [N] float64 m to, and number [N] int64 of, the nearest of some other points."""
    from scipy.spatial import KDTree

    tree = KDTree(others.detach().to("cpu", torch.float64).numpy())
    distance, number = tree.query(points.detach().to("cpu", torch.float64).numpy())
    device = points.device
    return torch.from_numpy(distance).to(device), torch.from_numpy(np.asarray(number, np.int64)).to(device)
