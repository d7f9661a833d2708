"""Which hidden pixels need a painter: those whose surface no training view shows (design section 6).

Hidden pixels whose surface another frame shows need none: stage 1 has learned their colour from that frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, median_filter
from scipy.spatial import KDTree

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
    distance: NDArray[np.float32]  # [R, R] m to seen surface in the rest pose, 0 where seen, inf if none is; likewise

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
    seen = count > 0
    points = texels.interpolate(body.v_template, body.faces)
    distance = np.full(len(points), np.inf, np.float32)
    if seen.any():
        distance[:] = KDTree(points[seen]).query(points)[0]
    return SeenSurface(texels, count, tuple(faced), _beyond_charts(texels, seen), _beyond_charts(texels, distance))


def _beyond_charts(texels: Texels, values: NDArray) -> NDArray:
    """[N] values of texels -> [R, R], off the charts the nearest texel's value."""
    size = len(texels.mask)
    flat = np.zeros(size**2, values.dtype)
    flat[texels.index] = values
    nearest = distance_transform_edt(~texels.mask, return_distances=False, return_indices=True)
    return flat.reshape(size, size)[tuple(np.asarray(nearest))]


def unseen_pixels(
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
    surface: SeenSurface,
) -> NDArray[np.bool_]:
    """[H, W] pixels on or beside the body whose nearest surface no training view shows."""
    seen, on = _on_pixels(surface.map, vertices, body, camera)
    if not on.any():
        return on
    out = median_filter(on & ~seen, size=3) & on  # a lone texel is not worth a painter
    rows = np.flatnonzero(on.any(1))
    band = BAND * (rows[-1] - rows[0] + 1)
    return np.where(on, out, _beside(out, on) & (np.asarray(distance_transform_edt(~on)) <= band))


def distance_to_seen(
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
    surface: SeenSurface,
) -> NDArray[np.float32]:
    """[H, W] m, on the body at rest, from a pixel's nearest surface to the nearest that some view shows; inf where
    the body is nowhere in the image."""
    distance, on = _on_pixels(surface.distance, vertices, body, camera)
    return _beside(distance, on) if on.any() else np.full(on.shape, np.inf, np.float32)


def _on_pixels(
    values: NDArray, vertices: NDArray[np.float64], body: Body, camera: Camera
) -> tuple[NDArray, NDArray[np.bool_]]:
    """[H, W] of a map [R, R] over the surface, as the camera sees it, 0 off the body; and where the body is."""
    raster = rasterize(camera.project(vertices), body.faces, camera.height, camera.width)
    on = raster.face >= 0
    corners = body.uv[body.uv_faces[raster.face[on]]]
    uv = np.einsum("nk,nkd->nd", raster.bary[on], corners)
    size = len(values)
    column = np.clip((uv[:, 0] * size).astype(int), 0, size - 1)
    row = np.clip(((1 - uv[:, 1]) * size).astype(int), 0, size - 1)
    out = np.zeros(on.shape, values.dtype)
    out[on] = values[row, column]
    return out, on


def _beside(values: NDArray, on: NDArray[np.bool_]) -> NDArray:
    """Off `on` the value of the nearest pixel on it."""
    nearest = distance_transform_edt(~on, return_distances=False, return_indices=True)
    return values[tuple(np.asarray(nearest))]


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
