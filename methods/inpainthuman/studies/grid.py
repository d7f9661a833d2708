"""A picture of what was painted: input, mask, part map, result, side by side, to be looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.part_map import part_colours
from ihbench.scene.spread import spread

GAP = 4  # px
HIDDEN = np.array([255, 0, 200], np.uint8)  # a colour that nobody wears


def painted_grid(
    views: list[CropView],
    painted: list[NDArray[np.uint8]],
    silhouettes: list[NDArray[np.bool_]],
    truths: list[NDArray[np.uint8]] | None = None,
    most: int = 12,
) -> NDArray[np.uint8]:
    """[H, W, 3] one row per view: input, what is asked (magenta), part map, painted, silhouette, truth where known.
    At most `most` views, evenly spread."""
    rows = []
    for k in spread(len(views), most):
        view = views[k]
        asked = np.where(view.unknown[..., None], HIDDEN, view.image)
        outline = np.where(silhouettes[k][..., None], painted[k], 40).astype(np.uint8)
        cells = [view.image, asked, part_colours(view.parts), painted[k], outline]
        if truths is not None:
            cells.append(truths[k])
        side = view.image.shape[0]
        rows.append(np.concatenate([_framed(cell, side) for cell in cells], 1))
    return np.concatenate(rows, 0)


def _framed(cell: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    out = np.full((side + GAP, side + GAP, 3), 90, np.uint8)
    left = (side - cell.shape[1]) // 2
    out[: cell.shape[0], left : left + cell.shape[1]] = cell
    return out
