"""Whether poses fit their pictures: the share of a body's vertices that project into the silhouette."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


def share_inside(points: NDArray[np.float64], region: NDArray[np.bool_]) -> float:
    """The share of projected points [V, 3] (x px, y px, depth m) that fall on the region [H, W]."""
    height, width = region.shape
    column, row = np.floor(points[:, 0]), np.floor(points[:, 1])
    seen = (points[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hits = region[row[seen].astype(int), column[seen].astype(int)].sum()
    return float(hits) / len(points)


NEAREST, FARTHEST = 0.05, 100.0  # m; nobody films a person from there


@dataclass(frozen=True)
class Overlap:
    """The shares of a body's vertices that project into a silhouette and into what a mistake would make of it."""

    inside: float  # the silhouette, grown by 1 % of the image's width
    outside: float  # its complement in the image
    mirrored: float  # the silhouette flipped left to right, grown as well
    border: float  # the share of the image's border that the silhouette covers
    depth: float  # m, median of the vertices


def overlap_of(points: NDArray[np.float64], silhouette: NDArray[np.bool_]) -> Overlap:
    """How projected points [V, 3] (x px, y px, depth m) lie in a silhouette [H, W]."""
    from scipy.ndimage import binary_dilation

    grown = np.asarray(binary_dilation(silhouette, iterations=max(1, silhouette.shape[1] // 100)), bool)
    border = np.concatenate([silhouette[0], silhouette[-1], silhouette[:, 0], silhouette[:, -1]])
    return Overlap(
        share_inside(points, grown),
        share_inside(points, ~silhouette),
        share_inside(points, grown[:, ::-1]),
        float(border.mean()),
        float(np.median(points[:, 2])),
    )


def unit_problem(depth: float) -> str:
    """What a body's median depth says of the units; empty where nothing. Directions alone cannot tell: a body a
    thousand times as far away and as far to the side is seen in the same place."""
    if depth > FARTHEST:
        return f"bodies are {depth:.3g} m away: camera or body translations look like millimetres; expected metres"
    if 0 <= depth < NEAREST:
        return f"bodies are {depth:.3g} m away: translations look like metres where millimetres are meant, or scaled"
    return ""


def overlap_problems(overlaps: Sequence[Overlap]) -> list[str]:
    """What is wrong when too few vertices fall into the silhouettes; empty when nothing is."""
    if not overlaps:
        return []
    inside, outside, mirrored, border, depth = (
        float(np.mean([getattr(overlap, name) for overlap in overlaps]))
        for name in ("inside", "outside", "mirrored", "border", "depth")
    )
    wrong_unit = unit_problem(depth)
    if wrong_unit:
        return [wrong_unit]
    if outside > 0.8 and border > 0.5:
        return [
            f"the masks look inverted: {outside:.0%} of the body's vertices project outside the silhouettes, which "
            f"cover {border:.0%} of the images' borders; expected person = 1, background = 0"
        ]
    if mirrored > inside + 0.1 and mirrored > 0.8:
        return [
            f"images and poses look mirrored: {inside:.0%} of the body's vertices project into the silhouettes, "
            f"{mirrored:.0%} when these are flipped left to right; expected pictures as the camera saw them"
        ]
    if inside < 0.95:
        return [f"only {inside:.0%} of the body's vertices project into the silhouettes; expected over 95 %"]
    return []
