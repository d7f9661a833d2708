"""Colours of a body's surface as images show them, and drawn into a crop.

Colours live in a grid over the body's UV chart, and in one of twice its cells' size for what a fine cell has no pixel
of.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.render.zbuffer import Raster

SIDE = 128  # cells along a side of the chart: about a centimetre, a pixel of a crop
NOWHERE = SIDE * SIDE  # the cell of pixels off the body
NEVER = 1 << 40  # frames away
RIM = np.ones((3, 3), np.uint8)  # of a silhouette, where the background shines through

Cells = NDArray[np.uint16]


def uv_cells(raster: Raster, body: Body) -> Cells:
    """[H, W] the chart's cell that each pixel of a drawn body shows; `NOWHERE` off it."""
    out = np.full(raster.face.shape, NOWHERE, np.uint16)
    uv = raster.interpolate(body.uv, body.uv_faces)[raster.mask]
    column, row = np.clip((uv * SIDE).astype(np.int64), 0, SIDE - 1).T
    out[raster.mask] = row * SIDE + column
    return out


def _coarser() -> NDArray[np.int64]:
    """[NOWHERE + 1] for each cell, where the coarse cell that holds it stands behind the fine ones; `NOWHERE` for
    itself."""
    row, column = np.divmod(np.arange(NOWHERE), SIDE)
    return np.append(NOWHERE + 1 + row // 2 * (SIDE // 2) + column // 2, NOWHERE)


COARSER = _coarser()


class SurfaceColours:
    """Colours of the chart's cells as seen so far, the fine ones, `NOWHERE`, the coarse ones."""

    def __init__(self) -> None:
        count = NOWHERE + 1 + NOWHERE // 4
        self.colour = np.zeros((count, 3), np.uint8)
        self.frame = np.full(count, -NEVER)  # that showed the cell last

    def show(self, cells: Cells, image: NDArray[np.uint8], person: NDArray[np.bool_], frame: int = 0) -> None:
        """Take what an image [H, W, 3] shows of the person [H, W], without the rim of the silhouette."""
        inner = cv2.erode(person.astype(np.uint8), RIM).astype(bool) & (cells != NOWHERE)
        for cell in (cells[inner], COARSER[cells[inner]]):
            self.colour[cell] = image[inner]
            self.frame[cell] = frame

    def drawn(self, cells: Cells) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
        """[H, W, 4] RGB and 255 where the pixel's cell has been seen, else 0; and the frame [H, W] that showed it, or
        `-NEVER`."""
        used = np.where(self.frame[cells] > -NEVER, cells, COARSER[cells])
        frame = self.frame[used]
        seen = (frame > -NEVER)[..., None]
        return np.concatenate([self.colour[used] * seen, 255 * seen.astype(np.uint8)], -1), frame
