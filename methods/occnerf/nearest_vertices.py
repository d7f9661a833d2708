"""The nearest of fixed points, exactly and fast: each cell of a lattice lists what can be among the nearest there.

For a place in a cell with centre c and half diagonal h the k nearest points all lie within d(c) + 2 h of c, where
d(c) is the distance of c's own k-th nearest. A query looks through its cell's list alone. Places whose cell lies
farther than `REACH` from all points have no list and look through all points.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

CELL = 0.02  # m
REACH = 0.12  # m
CHUNK = 8192  # places compared with all points at a time, where there are no compiled loops


class NearestVertices:
    """Of points [V, 3] m; lists are made at the first query."""

    def __init__(self, points: NDArray[np.float64], count: int):
        """The `count` nearest will be given, all of them where there are fewer."""
        self.points = np.ascontiguousarray(points, np.float32)
        self.count = min(count, len(points))
        self._lists: _CellLists | None = None

    def __call__(
        self,
        places: Tensor,  # [M, 3] m
    ) -> Tensor:
        """[M, k] int64 numbers of the points, nearest first; without gradient. Of two that are equally near the one
        with the smaller number comes first. NaN is near to nothing: any k points."""
        if places.device.type != "cpu":
            return nearest_by_torch(places, torch.from_numpy(self.points).to(places), self.count)
        if self._lists is None:
            self._lists = _CellLists(self.points, self.count)
        lists = self._lists
        out = np.empty((len(places), self.count), np.int64)
        at = places.detach().float().contiguous().numpy()
        _search(
            at,
            self.points,
            lists.low,
            lists.shape,
            lists.cell_rows,
            lists.starts,
            lists.numbers,
            lists.distances,
            out,
        )
        return torch.from_numpy(out)


def nearest_by_torch(
    places: Tensor,  # [M, 3] m
    points: Tensor,  # [V, 3] m
    count: int,
) -> Tensor:
    """[M, k] int64: what the lists give, by comparing each place with all points."""
    parts = []
    for some in places.detach().split(CHUNK):
        squared = (some[:, None, :] - points[None]).square().sum(-1)
        parts.append(squared.topk(count, largest=False, sorted=True).indices)
    return torch.cat(parts) if parts else torch.empty(0, count, dtype=torch.int64, device=places.device)


class _CellLists:
    """For each cell of a lattice around the points its candidates, one list after the other, nearest to the centre
    first."""

    def __init__(self, points: NDArray[np.float32], count: int):
        from scipy.spatial import KDTree

        self.low = points.min(0) - np.float32(REACH)
        self.shape = np.ceil((points.max(0) + REACH - self.low) / CELL).astype(np.int64)
        axes = [self.low[a] + CELL * (np.arange(self.shape[a]) + 0.5) for a in range(3)]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        tree, half = KDTree(points), CELL * np.sqrt(3) / 2
        near = np.flatnonzero(np.isfinite(tree.query(centers, distance_upper_bound=REACH + half)[0]))
        centers = centers[near]
        kth = np.asarray(tree.query(centers, count)[0]).reshape(len(centers), count)[:, -1]
        self.cell_rows = np.full(int(self.shape.prod()), -1, np.int64)
        self.cell_rows[near] = np.arange(len(near))
        reach = kth + 2 * half
        order = np.argsort(points[:, 1], kind="stable")
        height = points[order, 1].astype(np.float64)
        first = np.searchsorted(height, centers[:, 1] - reach)
        last = np.searchsorted(height, centers[:, 1] + reach, side="right")
        centers, reach = centers.astype(np.float32), (reach * (1 + 1e-5) + 1e-6).astype(np.float32)
        starts, places, self.distances = _lists(centers, points[order], reach, first, last)
        self.starts, self.numbers = starts, order[places].astype(np.int32)


@njit(cache=True, nogil=True)
def _lists(centers, points, reach, first, last):
    """The points within reach of each centre, among those from `first` to `last`: where its list starts [C + 1],
    numbers and distances from the centre."""
    starts = np.zeros(len(centers) + 1, np.int64)
    room = 16 * len(centers)
    numbers, distances = np.empty(room, np.int32), np.empty(room, np.float32)
    own, apart = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
    for c in range(len(centers)):
        found = 0
        x, y, z, most = centers[c, 0], centers[c, 1], centers[c, 2], reach[c] * reach[c]
        for v in range(np.uint64(first[c]), np.uint64(last[c])):
            dx, dy, dz = points[v, 0] - x, points[v, 1] - y, points[v, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d <= most:
                own[found], apart[found] = v, np.sqrt(d)
                found += 1
        start, end = starts[c], starts[c] + found
        starts[c + 1] = end
        if end > room:
            room = 2 * end
            more_numbers, more_distances = np.empty(room, np.int32), np.empty(room, np.float32)
            more_numbers[:start], more_distances[:start] = numbers[:start], distances[:start]
            numbers, distances = more_numbers, more_distances
        sequence = np.argsort(apart[:found])
        numbers[start:end], distances[start:end] = own[:found][sequence], apart[:found][sequence]
    return starts, numbers[: starts[-1]].copy(), distances[: starts[-1]].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _search(places, points, low, shape, cell_rows, starts, numbers, distances, out) -> None:
    count, last = out.shape[1], out.shape[1] - 1
    best = np.empty(count, np.float32)
    for m in range(len(places)):
        x, y, z = places[m, 0], places[m, 1], places[m, 2]
        i, j, k = (x - low[0]) / CELL, (y - low[1]) / CELL, (z - low[2]) / CELL
        row, off = -1, 0.0  # off: how far the place is from the centre of its cell
        if 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
            row = cell_rows[(int(i) * shape[1] + int(j)) * shape[2] + int(k)]
            di, dj, dk = i - int(i) - 0.5, j - int(j) - 0.5, k - int(k) - 0.5
            off = CELL * np.sqrt(di * di + dj * dj + dk * dk) * 1.00001 + 1e-7
        start, end = (starts[row], starts[row + 1]) if row >= 0 else (0, len(points))
        best[:] = np.inf
        out[m] = 0
        for c in range(start, end):
            v = c
            if row >= 0:
                v = int(numbers[c])
                if distances[c] > off and (distances[c] - off) ** 2 > best[last]:
                    break  # and so are all that follow
            dx, dy, dz = points[v, 0] - x, points[v, 1] - y, points[v, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < best[last] or (d == best[last] and v < out[m, last]):
                at = last
                while at > 0 and (d < best[at - 1] or (d == best[at - 1] and v < out[m, at - 1])):
                    best[at] = best[at - 1]
                    out[m, at] = out[m, at - 1]
                    at -= 1
                best[at] = d
                out[m, at] = v
