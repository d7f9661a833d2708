"""A smoothness prior over a surface: points that few training views show take after their neighbours.

Nothing else in a fit links surface that nobody saw to surface that somebody did. Between neighbouring points i and j
it costs w_ij |v_i - v_j|² for whatever is learned of a point (colour, offset, scale), with

    w_ij = (1 + views min(e_i, e_j))^-power,        e = the share of the training views that show the point,

so that where many views look the data decide, and elsewhere the surroundings go on. By share, not by number: what one
of eight views shows is known as well as what five of forty show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

NEIGHBOURS = 4


@dataclass(frozen=True)
class SurfacePrior:
    """Links between neighbouring points of a surface, each once, and how much each weighs."""

    pairs: Tensor  # [E, 2] int32 point numbers
    weight: Tensor  # [E] float32 in (0, 1]

    @classmethod
    def of(
        cls,
        points: NDArray[np.floating],  # [N, 3] m, canonical
        normals: NDArray[np.floating],  # [N, 3] of any length
        shown: NDArray[np.floating],  # [N] share of the training views that show the point, 0..1
        views: float,
        power: float,
    ) -> SurfacePrior:
        """Raises `ValueError` for arrays of different lengths."""
        if not len(points) == len(normals) == len(shown):
            raise ValueError(
                f"surface prior: expected arrays of one length, got {len(points)}, {len(normals)}, {len(shown)}"
            )
        pairs = neighbour_pairs(points, normals)
        least = np.minimum(shown[pairs[:, 0]], shown[pairs[:, 1]])
        weight = (1 + views * least) ** -power
        return cls(torch.from_numpy(pairs.astype(np.int32)), torch.from_numpy(weight.astype(np.float32)))

    def to(self, device: torch.device) -> SurfacePrior:
        return SurfacePrior(self.pairs.to(device), self.weight.to(device))

    def among(self, points: Tensor, count: int) -> SurfacePrior:
        """Of some of all `count` points [n] the links between them, numbered by their places among them."""
        place = torch.full((count,), -1, dtype=torch.int32, device=points.device)
        place[points] = torch.arange(len(points), dtype=torch.int32, device=points.device)
        pairs = place[self.pairs.long()]
        both = (pairs >= 0).all(1)
        return SurfacePrior(pairs[both], self.weight[both])

    def roughness(self, values: Tensor) -> Tensor:  # [n, D], one row a point
        """The sum over links of w |v_i - v_j|², divided by the number of points."""
        first, second = self.pairs.unbind(1)
        difference = values.index_select(0, first) - values.index_select(0, second)
        return (self.weight * difference.square().sum(1)).sum() / max(len(values), 1)


def neighbour_pairs(
    points: NDArray[np.floating],  # [N, 3]
    normals: NDArray[np.floating],  # [N, 3]
) -> NDArray[np.int64]:
    """[E, 2] first < second, ascending: each point with its nearest neighbours whose normals do not oppose its own,
    and with its nearest of all whichever way that looks. In space, not in UV: so links cross the seams of a chart."""
    from scipy.spatial import KDTree

    if len(points) < 2:
        return np.empty((0, 2), np.int64)
    near = np.asarray(KDTree(points).query(points, min(NEIGHBOURS + 1, len(points)))[1], np.int64)
    first = np.repeat(np.arange(len(points)), near.shape[1] - 1)
    # coincident points may stand before a point itself among its neighbours
    second = np.where(near[:, :1] == np.arange(len(points))[:, None], near[:, 1:], near[:, :-1]).ravel()
    agree = (normals[first] * normals[second]).sum(1) > 0
    agree[:: near.shape[1] - 1] = True
    pairs = np.sort(np.stack([first, second], 1)[agree & (first != second)], 1)
    return np.unique(pairs, axis=0)
