"""The pixels that a posed body's bounding box covers: where GauHuman and OccFusion compare pictures.

As released (skhu101/GauHuman, scene/dataset_readers.py:677-683, 1007-1045): the box along the world's axes around
the posed vertices, grown on all sides, its corners projected and rounded to pixels, the figure between them filled.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera

GROWN = 0.05  # m on every side
FARTHEST = 1e6  # px; what fits into OpenCV's integers


@dataclass(frozen=True)
class BodyBox:
    """A window of the image and the pixels of the box in it."""

    rows: slice
    columns: slice
    inside: NDArray[np.bool_]  # [h, w] of the window

    @property
    def window(self) -> tuple[int, int, int, int]:
        """x0, y0, width, height in px."""
        y, x = self.rows, self.columns
        return x.start, y.start, x.stop - x.start, y.stop - y.start


def body_box(
    camera: Camera,
    vertices: NDArray[np.float64],  # [V, 3] m, world
    grown: float = GROWN,
) -> BodyBox:
    """The box around a posed body in an image, and the smallest window around it. The whole image, all of it inside,
    where the box is not wholly in front of the camera or not on the image."""
    import cv2

    low, high = vertices.min(0) - grown, vertices.max(0) + grown
    corners = camera.project(np.array(list(product(*zip(low, high, strict=True)))))
    if not (corners[:, 2] > 0).all():
        return _whole(camera)
    # the number of a pixel, whose centre lies at + 0.5
    pixels = np.round(np.clip(corners[:, :2] - 0.5, -FARTHEST, FARTHEST)).astype(np.int32)
    filled = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(filled, cv2.convexHull(pixels), 1)
    y, x = np.flatnonzero(filled.max(axis=1)), np.flatnonzero(filled.max(axis=0))
    if not len(y):
        return _whole(camera)
    rows, columns = slice(int(y[0]), int(y[-1]) + 1), slice(int(x[0]), int(x[-1]) + 1)
    return BodyBox(rows, columns, filled[rows, columns] > 0)


def _whole(camera: Camera) -> BodyBox:
    shape = camera.height, camera.width
    return BodyBox(slice(0, shape[0]), slice(0, shape[1]), np.ones(shape, bool))
