"""The surface that other frames show, drawn into a view's crop: what a painter need not make up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.seen_surface import NEVER, SurfaceColours


def with_elsewhere(views: list[CropView], frames: list[CropView]) -> list[CropView]:
    """The views, each with what the other frames show of its surface."""
    drawn = seen_elsewhere(views, frames)
    return [replace(view, elsewhere=seen) for view, seen in zip(views, drawn, strict=True)]


def seen_elsewhere(views: Sequence[CropView], frames: Iterable[CropView]) -> list[NDArray[np.uint8]]:
    """[S, W, 4] for each view: its surface as another frame shows it, the nearest in index and the earlier of two as
    near; RGB and 255 where one does, else 0."""
    frames = sorted(frames, key=lambda frame: frame.index)
    best = [np.zeros((*view.cells.shape, 4), np.uint8) for view in views]
    away = [np.full(view.cells.shape, NEVER) for view in views]
    for direction in (1, -1):
        known, rest = SurfaceColours(), list(frames[::-direction])  # the next one last
        for k in sorted(range(len(views)), key=lambda k: direction * views[k].index):
            view = views[k]
            while rest and direction * rest[-1].index < direction * view.index:
                frame = rest.pop()
                known.show(frame.cells, frame.image, frame.person, frame.index)
            drawn, frame = known.drawn(view.cells)
            distance = np.abs(frame - view.index)
            nearer = distance < np.minimum(away[k], NEVER // 2)
            best[k][nearer] = drawn[nearer]
            away[k][nearer] = distance[nearer]
    return best
