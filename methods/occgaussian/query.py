"""The occlusion feature query: which seen vertices a hidden one asks, and with what weights.

    neighbours of i   the nearest candidates in the big pose, of the same body part or of one beside it
    u_ij              ∝ exp(-d_ij² / 2σ²) ln(1 + c_j)        c_j views that show j

Distances are those of the canonical vertices, which do not move: a hand is never near a hip. What lies near each
vertex is listed once per body; a query takes the first candidates of the list.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.fit.big_pose.deformation import CANONICAL

LISTED = 256  # vertices in each one's list; where candidates are farther away they are looked for among all


@dataclass(frozen=True)
class Query:
    """The answers to the vertices `rows`, as weighted sums over k neighbours each."""

    rows: Tensor  # [Q] int64 vertices that ask
    index: Tensor  # [Q, k] int64 vertices that are asked; 0 beyond a row's own number of them
    weights: Tensor  # [Q, k] sum to 1, 0 beyond them; all 0 where there is nobody to ask
    distance: Tensor  # [Q] m, mean over those asked

    def of(
        self,
        values: Tensor,  # [V, C] per vertex
    ) -> Tensor:
        """[Q, C]."""
        return (self.weights[..., None] * values[self.index]).sum(1)


class Neighbourhood:
    """Lists of near vertices by rising distance."""

    def __init__(self, points: NDArray[np.float64], parts: NDArray[np.int32], beside: NDArray[np.bool_]):
        """`points` [V, 3] m, `parts` [V], `beside` [P, P]: which parts may be asked from which."""
        self.points, self.parts, self.beside = points.astype(np.float32), parts, beside
        self.lists = np.full((len(points), LISTED), -1, np.int32)
        for part in np.unique(parts):
            rows, allowed = np.flatnonzero(parts == part), np.flatnonzero(beside[part][parts])
            count = min(LISTED, len(allowed))
            for some in np.array_split(rows, max(len(rows) * len(allowed) // 4_000_000, 1)):
                squared = self._squared(some, allowed)
                near = np.argpartition(squared, count - 1, axis=1)[:, :count]
                order = np.take_along_axis(squared, near, 1).argsort(1, kind="stable")
                self.lists[some, :count] = allowed[np.take_along_axis(near, order, 1)]

    def nearest(
        self, rows: NDArray[np.int64], candidates: NDArray[np.bool_], count: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """[Q, count] the nearest candidates of each row, itself excepted, and their distances in m; -1 and inf where
        there are fewer. Where no part that may be asked has one, the nearest anywhere."""
        index, found = _first(self.lists, rows.astype(np.int64), candidates, count)
        short = np.flatnonzero(found < count)
        for part in np.unique(self.parts[rows[short]]):
            some = short[self.parts[rows[short]] == part]
            index[some] = self._whole(rows[some], part, candidates, count)
        distance = np.linalg.norm(self.points[rows][:, None] - self.points[index], axis=-1)
        return index, np.where(index >= 0, distance, np.inf).astype(np.float32)

    def _whole(
        self, rows: NDArray[np.int64], part: int, candidates: NDArray[np.bool_], count: int
    ) -> NDArray[np.int64]:
        """`nearest` for rows of one part, from all candidates and not from the lists."""
        inside = np.flatnonzero(candidates & self.beside[part][self.parts])
        index = self._of(rows, inside, count)
        alone = index[:, 0] < 0
        index[alone] = self._of(rows[alone], np.flatnonzero(candidates), count)
        return index

    def _of(self, rows: NDArray[np.int64], others: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        squared = np.where(rows[:, None] == others, np.inf, self._squared(rows, others))
        order = squared.argsort(1, kind="stable")[:, :count]
        index = np.full((len(rows), count), -1)
        found = np.isfinite(np.take_along_axis(squared, order, 1))
        index[:, : order.shape[1]] = np.where(found, others[order] if len(others) else -1, -1)
        return index

    def _squared(self, rows: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float32]:
        a, b = self.points[rows], self.points[others]
        squared = sum((a[:, None, axis] - b[None, :, axis]) ** 2 for axis in range(3))
        return np.asarray(squared)


@lru_cache(maxsize=8)
def neighbourhood(body: Body, same_part: bool = True) -> Neighbourhood:
    """Of a body in the big pose, kept. Parts beside each other are a joint and its parent."""
    points = body.pose(BodyPose(canonical_pose(CANONICAL), np.zeros(1), np.zeros(3)))
    beside = np.eye(24, dtype=bool)
    for joint, parent in enumerate(body.parents):
        if parent >= 0:
            beside[joint, parent] = beside[parent, joint] = True
    return Neighbourhood(points, body.parts, beside if same_part else np.ones_like(beside))


def make_query(
    near: Neighbourhood,
    rows: NDArray[np.int64],  # [Q] vertices that ask
    candidates: NDArray[np.bool_],  # [V] that may be asked
    seen: NDArray[np.int64],  # [V] views that show each
    *,
    neighbours: int,
    sigma: float,
    device: torch.device,
) -> Query:
    """The neighbours and weights of some vertices."""
    index, distance = near.nearest(rows, candidates, neighbours)
    asked = index >= 0
    index = np.where(asked, index, 0)
    with np.errstate(divide="ignore"):
        logits = np.where(asked, -(distance.astype(np.float64) ** 2) / (2 * sigma**2), -np.inf)
        logits = logits + np.where(asked, np.log(np.log1p(seen[index])), 0)
    best = logits.max(1, initial=-np.inf, keepdims=True)
    raw = np.exp(logits - np.where(np.isfinite(best), best, 0))
    weights = raw / np.maximum(raw.sum(1, keepdims=True), 1e-30)
    far = np.where(asked, distance, 0).sum(1) / np.maximum(asked.sum(1), 1)

    def tensor(values: NDArray[Any], kind: torch.dtype) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(device, kind)

    return Query(
        tensor(rows, torch.int64),
        tensor(index, torch.int64),
        tensor(weights, torch.float32),
        tensor(far, torch.float32),
    )


@njit(cache=True, nogil=True)
def _first(lists, rows, candidates, count):
    """The first `count` candidates in the list of each row, and how many there are."""
    index = np.full((len(rows), count), -1, np.int64)
    found = np.zeros(len(rows), np.int64)
    for q in range(len(rows)):
        for m in range(lists.shape[1]):
            j = lists[rows[q], m]
            if j < 0 or found[q] == count:
                break
            if candidates[j] and j != rows[q]:
                index[q, found[q]] = j
                found[q] += 1
    return index, found
