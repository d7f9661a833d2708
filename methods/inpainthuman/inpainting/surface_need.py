"""Which hidden pixels need a painter: those whose surface no training view shows (design section 6).

Hidden pixels whose surface another frame shows need none: stage 1 has learned their colour from that frame. Surface
that all training views would see at a glancing angle only may be left to stage 1 too: a few painted pixels on the rim
decide the colour of what is wide from elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, median_filter

from ihbench.body import Body
from ihbench.body.uv import Texels, nearest_on_chart, texel_at
from ihbench.camera import Camera
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.sightings import COARSE

BAND = 0.05  # of the body's height in the image: garments and hair reach no farther off the body
ENOUGH = 3  # views that should paint a texel


@dataclass(frozen=True)
class SeenSurface:
    """What the training views show of the body's surface."""

    texels: Texels
    views: NDArray[np.int32]  # [N] training views that show the texel un-occluded
    faced: tuple[NDArray[np.int64], ...]  # per training view: texels that face it well, but are hidden there

    @property
    def unseen(self) -> NDArray[np.bool_]:
        """[N] shown by no training view."""
        return self.views == 0

    @property
    def needed(self) -> NDArray[np.bool_]:
        """[N] shown by no training view, though one would face it well: what can be painted in training views."""
        out = np.zeros(len(self.views), bool)
        for texels in self.faced:
            out[texels] = True
        return out & self.unseen

    def map_of(self, texels: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """[R, R] a property of the texels [N] as an image; off the charts the nearest texel's value."""
        flat = np.zeros(self.texels.resolution**2, bool)
        flat[self.texels.index] = texels
        return flat[nearest_on_chart(self.texels.mask)]


def seen_surface(training: TrainingSet, facing: float = 0.0) -> SeenSurface:
    """Of all training views. A texel faces a view well if the cosine between its normal and the direction to the
    camera is at least `facing`."""
    seen = training.sightings[COARSE]
    faced = (texel[cosine >= facing] for texel, cosine in seen.hidden)
    return SeenSurface(seen.texels, seen.visibility.seen, tuple(faced))


def pixels_of(
    wanted: NDArray[np.bool_],  # [R, R] texels, also off the charts
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
) -> NDArray[np.bool_]:
    """[H, W] pixels on or beside the body whose nearest surface is wanted."""
    raster = rasterize(camera.project(vertices), body.faces, camera.height, camera.width)
    on = raster.face >= 0
    out = np.zeros(on.shape, bool)
    if not on.any():
        return out
    corners = body.uv[body.uv_faces[raster.face[on]]]
    uv = np.einsum("nk,nkd->nd", raster.bary[on], corners)
    out[on] = wanted[texel_at(uv, len(wanted))]
    out = median_filter(out, size=3) & on  # a lone texel is not worth a painter
    nearest = distance_transform_edt(~on, return_distances=False, return_indices=True)
    distance = distance_transform_edt(~on)
    rows = np.flatnonzero(on.any(1))
    band = BAND * (rows[-1] - rows[0] + 1)
    return np.where(on, out, out[tuple(np.asarray(nearest))] & (np.asarray(distance) <= band))


def key_views(faced: Sequence[NDArray[np.int64]], needed: NDArray[np.bool_], most: int) -> list[int]:
    """Numbers of the views to paint, at most `most` (0: all that face a needed texel), chosen greedily so that every
    needed texel [N] is painted in `ENOUGH` views as far as there are so many."""
    own = [texels[needed[texels]] for texels in faced]
    useful = [k for k, texels in enumerate(own) if len(texels)]
    if most == 0 or len(useful) <= most:
        return useful
    missing = np.where(needed, float(ENOUGH), 0.0)
    chosen: list[int] = []
    while len(chosen) < most:
        # a texel still wanted counts fully, one painted often enough a little: all frames left are of some use
        gains = [-1.0 if k in chosen else (np.minimum(missing[own[k]], 1) + 0.01).sum() for k in useful]
        best = useful[int(np.argmax(gains))]
        chosen.append(best)
        missing[own[best]] = np.maximum(missing[own[best]] - 1, 0)
        if not missing.any():
            break
    return sorted(chosen)
