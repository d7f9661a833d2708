"""Whether poses fit masks of visible pixels: the share of the mask that lies on the projected body.

Furniture may hide most of the body, so the share of the body inside the mask says nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.datasets.overlap import unit_problem
from ihbench.render.zbuffer import rasterize
from ihbench.scene import BodyPose

SIDE = 480  # px; longer side at which bodies are drawn
CLOTHES = 0.03  # share of the projected body's height by which garments and hair may stand off it


@dataclass(frozen=True)
class VisibleOverlap:
    """Shares of mask pixels that lie on the projected body, as the mask is and as a mistake would make it."""

    inside: float
    mirrored: float  # the mask flipped left to right
    complement: float  # share of the projected body that the mask leaves out
    border: float  # the share of the image's border that the mask covers
    depth: float  # m, median of the body's vertices


def visible_overlap(body: Body, body_pose: BodyPose, camera: Camera, mask: NDArray[np.bool_]) -> VisibleOverlap:
    """How a mask [H, W] of visible person pixels lies on the body."""
    from scipy.ndimage import binary_dilation

    step = max(1, max(mask.shape) // SIDE)
    small = mask[step // 2 :: step, step // 2 :: step]
    view = camera.scaled(small.shape[1], small.shape[0])
    points = view.project(body.pose(body_pose))
    drawn = rasterize(points, body.faces, view.height, view.width).mask
    rows = np.flatnonzero(drawn.any(1))
    margin = max(1, round(CLOTHES * (np.ptp(rows) + 1))) if len(rows) else 1
    grown = np.asarray(binary_dilation(drawn, iterations=margin), bool)
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return VisibleOverlap(
        _share(small, grown),
        _share(small[:, ::-1], grown),
        1 - _share(drawn, small),
        float(border.mean()),
        float(np.median(points[:, 2])),
    )


def _share(part: NDArray[np.bool_], region: NDArray[np.bool_]) -> float:
    """The share of a region's pixels that another holds; 1 for none at all."""
    return float((part & region).sum() / part.sum()) if part.any() else 1.0


def visible_problems(overlaps: Sequence[VisibleOverlap]) -> list[str]:
    """What is wrong when too much of the masks lies off the bodies; empty when nothing is."""
    if not overlaps:
        return []
    names = ("inside", "mirrored", "complement", "border")
    inside, mirrored, complement, border = (float(np.mean([getattr(o, name) for o in overlaps])) for name in names)
    wrong_unit = unit_problem(float(np.mean([o.depth for o in overlaps])))
    if wrong_unit:
        return [wrong_unit]
    if border > 0.5 and inside < 0.9:
        return [
            f"the masks look inverted: they cover {border:.0%} of the images' borders and leave out {complement:.0%} "
            f"of the projected body; expected visible person = non-zero"
        ]
    if mirrored > inside + 0.1 and mirrored > 0.8:
        return [
            f"images and poses look mirrored: {inside:.0%} of the masks lie on the projected body, {mirrored:.0%} "
            f"when flipped left to right; expected pictures as the camera saw them"
        ]
    if inside < 0.9:
        return [f"only {inside:.0%} of the masks' pixels lie on the projected body; expected over 90 %"]
    return []
