"""Which vertices are near a place: looked up once for each cell of a lattice, or for each place by itself.

The base points never move, so the places of a cell may share what is nearest to its centre. Distances and projections
are computed from the place itself all the same (`projection`). A cell is filled when a place first falls into it;
what it holds depends on nothing but the cell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

CHUNK = 4096  # places compared with all points at a time on a GPU
MOST_CELLS = 50_000_000


class NearestVertices:
    """Numbers of the `count` nearest points of each of several sets."""

    def __init__(
        self,
        points: NDArray[np.float32],  # [V, 3] m
        sets: Sequence[NDArray[np.int64]],  # numbers of points, at least `count` each
        count: int,
        box: tuple[NDArray[np.float32], NDArray[np.float32]],  # m, corners of the lattice
        cell: float,  # m, a cell's side; 0: each place has its own
    ):
        from scipy.spatial import KDTree

        self.points, self.sets, self.count, self.cell = points, sets, count, cell
        self._trees = [KDTree(points[each]) for each in sets]
        self._moved: dict[torch.device, list[Tensor]] = {}
        if cell > 0:
            low, high = box
            self._low = low
            self._shape = np.maximum(np.ceil((high - low) / cell), 1).astype(np.int64)
            if self._shape.prod() > MOST_CELLS:
                raise ValueError(f"neighbours: {self._shape.prod()} cells of {cell} m; expected up to {MOST_CELLS}")
            self._row = torch.full((int(self._shape.prod()),), -1, dtype=torch.int32)
            self._table = torch.empty(0, len(sets) * count, dtype=torch.int32)
            self._filled = 0

    def __call__(
        self,
        places: Tensor,  # [M, 3] m, finite or not
    ) -> Tensor:
        """[M, sets · count] int32: of each set in turn, nearest first. Without gradient."""
        places = places.detach()
        if self.cell == 0:
            return self._of_each(places)
        low, shape = (torch.from_numpy(each).to(places.device) for each in (self._low, self._shape))
        at = ((places - low) / self.cell).nan_to_num(nan=0.0).clamp(min=0).long().minimum(shape - 1)
        cell = (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2]
        if self._row.device != places.device:
            self._row, self._table = self._row.to(places.device), self._table.to(places.device)
        row = self._row[cell]
        new = cell[row < 0].unique()
        if len(new):
            self._fill(new)
            row = self._row[cell]
        return self._table[row.long()]

    def _fill(self, new: Tensor) -> None:  # [C] int64 cells
        number = new.cpu().numpy()
        index = np.stack(np.unravel_index(number, tuple(self._shape)), 1)
        centers = self._low + self.cell * (index + 0.5)
        end = self._filled + len(number)
        if end > len(self._table):
            grown = self._table.new_empty(2 * end, self._table.shape[1])
            grown[: self._filled] = self._table[: self._filled]
            self._table = grown
        near = self._by_trees(torch.from_numpy(centers.astype(np.float32)))
        self._table[self._filled : end] = near.to(self._table.device)
        self._row[new] = torch.arange(self._filled, end, dtype=torch.int32, device=self._row.device)
        self._filled = end

    def _of_each(self, places: Tensor) -> Tensor:
        if places.device.type == "cpu":
            return self._by_trees(places)
        if places.device not in self._moved:
            self._moved[places.device] = [torch.from_numpy(each).to(places.device) for each in self.sets]
        points = torch.from_numpy(self.points).to(places)
        return nearest_by_torch(places, points, self._moved[places.device], self.count)

    def _by_trees(self, places: Tensor) -> Tensor:
        where = np.nan_to_num(places.double().numpy(), nan=0.0, posinf=0.0, neginf=0.0)
        parts = []
        for tree, numbers in zip(self._trees, self.sets, strict=True):
            near = np.asarray(tree.query(where, self.count)[1]).reshape(len(where), self.count)
            parts.append(numbers[near].astype(np.int32))
        return torch.from_numpy(np.concatenate(parts, 1))


def nearest_by_torch(
    places: Tensor,  # [M, 3] m
    points: Tensor,  # [V, 3] m
    sets: Sequence[Tensor],  # int64 numbers of points
    count: int,
) -> Tensor:
    """[M, sets · count] int32: each place compared with all points."""
    if not len(places):
        return torch.empty(0, len(sets) * count, dtype=torch.int32, device=places.device)
    parts = []
    for some in places.split(CHUNK):
        squared = (some[:, None, :] - points[None]).square().sum(-1)
        parts.append(torch.cat([each[squared[:, each].topk(count, largest=False).indices] for each in sets], 1))
    return torch.cat(parts).int()
