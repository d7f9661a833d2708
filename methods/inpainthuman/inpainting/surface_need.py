"""Which hidden pixels need a painter: those whose surface no training view shows (design section 6).

Hidden pixels whose surface another frame shows need none: stage 1 has learned their colour from that frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, median_filter

from ihbench.body import Body
from ihbench.body.uv import Texels, texel_table
from ihbench.camera import Camera
from ihbench.render.zbuffer import rasterize
from ihbench.scene import MaskState, TrainingSet
from ihbench.visibility import surface_texels

BAND = 0.05  # of the body's height in the image: garments and hair reach no farther off the body
ENOUGH = 3  # views that should paint a texel


@dataclass(frozen=True)
class SeenSurface:
    """What the training views show of the body's surface."""

    texels: Texels
    views: NDArray[np.int32]  # [N] training views that show the texel un-occluded
    faced: tuple[NDArray[np.int64], ...]  # per training view: texels that are the nearest surface but hidden there
    map: NDArray[np.bool_]  # [R, R] seen; off the charts the nearest texel's value

    @property
    def unseen(self) -> NDArray[np.bool_]:
        return self.views == 0


def seen_surface(training: TrainingSet, resolution: int) -> SeenSurface:
    """Look through all training views."""
    body = training.body
    texels = texel_table(body, resolution)
    count = np.zeros(len(texels.face), np.int32)
    faced = []
    for view in training.views:
        nearest, row, column = surface_texels(body.pose(view.body_pose), body, texels, view)
        state = view.mask[row, column]
        count += nearest & (state == MaskState.PERSON)
        faced.append(np.flatnonzero(nearest & (state == MaskState.UNKNOWN)))
    flat = np.zeros(resolution**2, bool)
    flat[texels.index] = count > 0
    seen = flat.reshape(resolution, resolution)
    nearest_chart = distance_transform_edt(~texels.mask, return_distances=False, return_indices=True)
    return SeenSurface(texels, count, tuple(faced), seen[tuple(np.asarray(nearest_chart))])


def unseen_pixels(
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
    surface: SeenSurface,
) -> NDArray[np.bool_]:
    """[H, W] pixels on or beside the body whose nearest surface no training view shows."""
    raster = rasterize(camera.project(vertices), body.faces, camera.height, camera.width)
    on = raster.face >= 0
    out = np.zeros(on.shape, bool)
    if not on.any():
        return out
    corners = body.uv[body.uv_faces[raster.face[on]]]
    uv = np.einsum("nk,nkd->nd", raster.bary[on], corners)
    size = len(surface.map)
    column = np.clip((uv[:, 0] * size).astype(int), 0, size - 1)
    row = np.clip(((1 - uv[:, 1]) * size).astype(int), 0, size - 1)
    out[on] = ~surface.map[row, column]
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
    wanted = np.where(needed, float(ENOUGH), 0.0)
    chosen: list[int] = []
    while len(chosen) < most:
        # a texel still wanted counts fully, one painted often enough a little: all frames left are of some use
        gains = [-1.0 if k in chosen else (np.minimum(wanted[own[k]], 1) + 0.01).sum() for k in useful]
        best = useful[int(np.argmax(gains))]
        chosen.append(best)
        wanted[own[best]] = np.maximum(wanted[own[best]] - 1, 0)
        if not wanted.any():
            break
    return sorted(chosen)
