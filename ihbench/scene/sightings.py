"""What the training views show of the body's surface, on every grid that is asked for, from one look at each view.

Regions and calibration rows take the fine grid, what needs an inpainter the coarse one. All of it follows from the
training views: a method may know it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ihbench.body.uv import Texels, texel_table
from ihbench.scene.mask_state import MaskState
from ihbench.scene.visibility import MaskedView, PosedSurface, Visibility

if TYPE_CHECKING:
    from ihbench.body import Body

FINE = 256  # side of the UV grid on which "seen in training" is decided
COARSE = 128  # side of the UV grid on which the need of inpainting is measured


class ColourView(MaskedView, Protocol):
    """The part of a training view that is looked at; `TrainView` is one."""

    @property
    def image(self) -> NDArray[np.uint8]: ...


@dataclass(frozen=True)
class Sightings:
    """What the training views show of the N texels of one grid."""

    texels: Texels
    visibility: Visibility
    colour: NDArray[np.float64]  # [N, 3] RGB 0..255, summed over the `visibility.seen` views that show the texel
    # per training view: the texels [n] that face it but are UNKNOWN there, ascending, and their cosines [n]
    hidden: tuple[tuple[NDArray[np.int64], NDArray[np.float64]], ...]


def look_through(
    views: Sequence[ColourView], body: Body, sides: tuple[int, ...] = (FINE, COARSE)
) -> dict[int, Sightings]:
    """Side of a UV grid -> what the views show on it. Each view is read, posed and rasterised once."""
    grids = [texel_table(body, side) for side in sides]
    counts = [Visibility.none(len(texels.face)) for texels in grids]
    colours = [np.zeros((len(texels.face), 3)) for texels in grids]
    hidden: list[list[tuple[NDArray[np.int64], NDArray[np.float64]]]] = [[] for _ in grids]
    for view in views:
        surface = PosedSurface(body, view.camera, view.body_pose)
        for texels, visibility, colour, unknown in zip(grids, counts, colours, hidden, strict=True):
            faced = surface.faced(texels)
            state = visibility.count(faced, view.mask)
            shown, behind = state == MaskState.PERSON, state == MaskState.UNKNOWN
            row, column = faced.pixel
            colour[faced.texel[shown]] += view.image[row[shown], column[shown]]
            unknown.append((faced.texel[behind], faced.cosine[behind]))
    made = map(Sightings, grids, counts, colours, map(tuple, hidden))
    return {seen.texels.resolution: seen for seen in made}
