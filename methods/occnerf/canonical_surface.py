"""The body's surface in the T-pose: where features live, and which of its vertices are near a place, in four sets.

As released (tiangexiang/OccNeRF 1cb1ef3, core/nets/occnerf/network.py:90-129): the vertices of the zero pose in the
person's mean shape, their normals, and three farthest-point subsets of a quarter, a sixteenth and a sixty-fourth of
them. The subsets are drawn once and kept with the avatar; the released code draws others at every start.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.methods.occnerf.nearest_vertices import NearestVertices

Array = NDArray[np.float64]

COARSER = (4, 16, 64)  # times fewer vertices
LEVELS = 1 + len(COARSER)
NEIGHBOURS = 10  # of a level
OF_A_VERTEX = 3  # base vertices that a displaced vertex is projected between
MARGIN = 0.3  # m around the rest joints: the canonical box


class CanonicalSurface(nn.Module):
    """What the body of one person contributes; not learned."""

    vertices: Tensor  # [V, 3] m
    normals: Tensor  # [V, 3] unit, outwards
    low: Tensor  # [3] m, corner of the canonical box
    high: Tensor  # [3] m

    def __init__(self, body: Body, betas: Array, seed: int, cell: float = 0.0):
        """Raises `BadInput` for shape coefficients that the body does not have, `ValueError` for fewer than ten
        vertices."""
        super().__init__()
        self.cell = cell  # m: see `NearestVertices`
        vertices, joints = body.shaped(betas)
        if len(vertices) < NEIGHBOURS:
            raise ValueError(f"body: expected at least {NEIGHBOURS} vertices, got {len(vertices)}")
        for name, value in (
            ("vertices", vertices),
            ("normals", vertex_normals(vertices, body.faces)),
            ("low", joints.min(0) - MARGIN),
            ("high", joints.max(0) + MARGIN),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float32)), persistent=False)
        start = int(np.random.default_rng((seed, 0)).integers(len(vertices)))
        counts = [max(math.ceil(len(vertices) / times), NEIGHBOURS) for times in COARSER]
        order = _order(np.asarray(vertices, np.float64).tobytes(), max(counts), start)
        for level, count in enumerate(counts, 1):  # each subset is the beginning of the next finer one
            self.register_buffer(f"subset_{level}", torch.from_numpy(order[:count].copy()))

    @property
    def bound(self) -> float:
        """m: the largest absolute coordinate of the canonical box; what the hash grid calls 1."""
        return float(torch.stack([self.low, self.high]).abs().max())

    def subset(self, level: int) -> Tensor:
        """[v] int64 numbers of the vertices of a coarser level, 1 to 3."""
        return self.get_buffer(f"subset_{level}")

    def neighbours(
        self,
        places: Tensor,  # [M, 3] m
    ) -> Tensor:
        """[M, 40] int32: the ten nearest vertices of all, then of each coarser subset. Without gradient."""
        subsets = tuple(self.subset(level).cpu().numpy().tobytes() for level in range(1, LEVELS))
        corners = [tuple(each.tolist()) for each in (self.low, self.high)]
        return _search(self._points().tobytes(), subsets, NEIGHBOURS, *corners, self.cell)(places)

    def nearest_three(
        self,
        places: Tensor,  # [M, 3] m
    ) -> Tensor:
        """[M, 3] int32: the nearest vertices of all, exactly."""
        corners = [tuple(each.tolist()) for each in (self.low, self.high)]
        return _search(self._points().tobytes(), (), OF_A_VERTEX, *corners, 0.0)(places)

    def _points(self) -> NDArray[np.float32]:
        return self.vertices.cpu().numpy().astype(np.float32)


@lru_cache(maxsize=4)  # two people's: a table has up to 80 MB, and takes seconds to fill
def _search(
    points: bytes,  # float32 [V, 3]
    subsets: tuple[bytes, ...],  # int64
    count: int,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    cell: float,
) -> NearestVertices:
    """Shared by every avatar that has the same surface."""
    where = np.frombuffer(points, np.float32).reshape(-1, 3)
    sets = [np.arange(len(where)), *(np.frombuffer(each, np.int64) for each in subsets)]
    return NearestVertices(where, sets, count, (np.array(low, np.float32), np.array(high, np.float32)), cell)


@lru_cache(maxsize=8)
def _order(points: bytes, count: int, start: int) -> NDArray[np.int64]:  # float64 [V, 3]
    return farthest_points(np.frombuffer(points).reshape(-1, 3), count, start)


def vertex_normals(
    vertices: Array,  # [V, 3] m
    faces: NDArray[np.int32],  # [F, 3] counter-clockwise seen from outside
) -> Array:
    """[V, 3] unit: the sum of the normals of a vertex's faces, weighted by their areas; 0 where that is 0."""
    corners = vertices[faces]
    of_face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(summed, faces[:, corner], of_face)
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-30)


def farthest_points(
    points: Array,  # [V, 3] m
    count: int,
    start: int,
) -> NDArray[np.int64]:
    """[count] numbers of points, each the farthest from all before it; the first is `start`. Any beginning of them
    is the farthest-point subset of its size."""
    chosen = np.empty(count, np.int64)
    centered = points - points.mean(0)
    square = np.square(centered).sum(1)
    apart = np.full(len(points), np.inf)
    at = start
    for k in range(count):
        chosen[k] = at
        np.minimum(apart, square - 2 * (centered @ centered[at]) + square[at], out=apart)
        at = int(apart.argmax())
    return chosen
