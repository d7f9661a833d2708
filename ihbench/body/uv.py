"""The body's surface as an image: texels, position maps, chart padding, sampling.

Texture coordinates follow OBJ files (u right, v up, origin bottom left); maps have row 0 at the top. Texel (row i,
column j) of an R x R map has its centre at u = (j + 0.5) / R, v = 1 - (i + 0.5) / R.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.render.zbuffer import rasterize

if TYPE_CHECKING:
    from ihbench.body.model import Body

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Texels:
    """The N texels of an R x R map whose centres lie on the surface, in row-major order."""

    resolution: int  # R
    index: NDArray[np.int64]  # [N] row * R + column
    face: NDArray[np.int32]  # [N] the face each centre lies in
    bary: Array  # [N, 3] where in it
    uv: Array  # [N, 2] texel centres

    @property
    def mask(self) -> NDArray[np.bool_]:
        """[R, R] True at the texels in this table."""
        out = np.zeros(self.resolution**2, bool)
        out[self.index] = True
        return out.reshape(self.resolution, self.resolution)

    def interpolate(
        self,
        per_vertex: NDArray,  # [V, C]
        faces: NDArray[np.integer],  # [F, 3] Body.faces
    ) -> NDArray[np.float64]:
        """[N, C] values at the texels from values at the vertices."""
        return np.einsum("nk,nkc->nc", self.bary, per_vertex[faces[self.face]])


@lru_cache(maxsize=32)
def texel_table(body: Body, resolution: int) -> Texels:
    """The texels of a body's texture map; cached for each body object and resolution. Raises `ValueError`."""
    if isinstance(resolution, bool) or not isinstance(resolution, int | np.integer) or resolution < 1:
        raise ValueError(f"texture: expected a whole number of texels a side, got {resolution!r}")
    corners = map_coordinates(body.uv, resolution) + 0.5
    flat = np.column_stack([corners, np.ones(len(corners))])
    raster = rasterize(flat, body.uv_faces, resolution, resolution)
    index = np.flatnonzero(raster.face.ravel() >= 0)
    face = raster.face.ravel()[index]
    row, column = np.divmod(index, resolution)
    uv = np.column_stack([(column + 0.5) / resolution, 1 - (row + 0.5) / resolution])
    texels = Texels(resolution, index, face, _barycentric(uv, body.uv[body.uv_faces[face]]), uv)
    for array in (texels.index, texels.face, texels.bary, texels.uv):
        array.setflags(write=False)
    return texels


def nearest_texels(
    texels: Texels,
    uv: Array,  # [N, 2], v up
) -> NDArray[np.int64]:
    """[N] numbers of the texels that lie nearest on the map, of those inside a chart."""
    inside = texels.mask
    column, row = np.clip(np.rint(map_coordinates(uv, texels.resolution)), 0, texels.resolution - 1).astype(int).T
    number = np.cumsum(inside.ravel()) - 1
    return number[nearest_on_chart(inside)[row, column]]


def _barycentric(points: Array, triangles: Array) -> Array:
    """[N, 3] of points [N, 2] in triangles [N, 3, 2]: in double precision, where the z-buffer keeps single."""
    a = triangles[:, 0]
    e1, e2, p = triangles[:, 1] - a, triangles[:, 2] - a, points - a
    area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    w1 = (p[:, 0] * e2[:, 1] - p[:, 1] * e2[:, 0]) / area
    w2 = (e1[:, 0] * p[:, 1] - e1[:, 1] * p[:, 0]) / area
    return np.column_stack([1 - w1 - w2, w1, w2])


def map_coordinates(
    uv: Array,  # [..., 2]
    resolution: int,
) -> Array:
    """[..., 2] column and row of a map, counted so that integers are texel centres."""
    column = uv[..., 0] * resolution - 0.5
    row = (1 - uv[..., 1]) * resolution - 0.5
    return np.stack([column, row], -1)


def texel_at(
    uv: NDArray[np.floating],  # [N, 2]
    resolution: int,
    even: bool = False,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row [N] and column [N] of the texel that uv lies in. On the border of two it is the lower or right one, or with
    `even` the one of an even number."""
    if even:
        column, row = np.round(map_coordinates(np.asarray(uv, np.float64), resolution)).T
    else:
        column, row = uv[:, 0] * resolution, (1 - uv[:, 1]) * resolution
    row, column = (np.clip(place.astype(np.int64), 0, resolution - 1) for place in (row, column))
    return row, column


def sample_uv(
    values: NDArray,  # [R, R, C]
    uv: Array,  # [N, 2]
) -> NDArray[np.float64]:
    """[N, C] bilinear samples of a map; outside the outermost texel centres the edge value holds. Raises `ValueError`
    for a map that is not square with channels last, and for uv that are not pairs."""
    resolution = values.shape[0]
    if values.ndim != 3 or values.shape[1] != resolution or np.ndim(uv) != 2 or np.shape(uv)[1] != 2:
        raise ValueError(
            f"texture: expected a map [R, R, C], channels last, and uv [N, 2], got {values.shape}, {np.shape(uv)}"
        )
    position = np.clip(map_coordinates(np.asarray(uv, np.float64), resolution), 0, resolution - 1)
    low = np.minimum(position.astype(np.int64), max(resolution - 2, 0))
    high = np.minimum(low + 1, resolution - 1)
    (x, y), (x0, y0), (x1, y1) = (position - low).T[..., None], low.T, high.T
    top = values[y0, x0] * (1 - x) + values[y0, x1] * x
    bottom = values[y1, x0] * (1 - x) + values[y1, x1] * x
    return top * (1 - y) + bottom * y


def position_map(
    vertices: Array,  # [V, 3] m
    body: Body,
    resolution: int,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Where each texel of the surface is: [R, R, 3] m, 0 off the charts, and the mask [R, R] of texels on them."""
    if np.shape(vertices) != body.v_template.shape:
        raise ValueError(
            f"position map: expected vertices {body.v_template.shape} of this body, got {np.shape(vertices)}"
        )
    texels = texel_table(body, resolution)
    out = np.zeros((resolution**2, 3), np.float32)
    out[texels.index] = texels.interpolate(vertices, body.faces)
    return out.reshape(resolution, resolution, 3), texels.mask


def chart_padding(
    mask: NDArray[np.bool_],  # [R, R] texels on a chart
    texels: int,
) -> NDArray[np.int64]:
    """[R, R] for every texel the flat index of the texel to copy from: itself on a chart, the nearest chart texel
    within `texels` rows and columns of one, -1 farther out.

    `padded = np.where(index[..., None] >= 0, flat[index], fill)` widens the charts, so that bilinear samples at their
    borders do not mix with the background.
    """
    from scipy.ndimage import distance_transform_cdt

    if not mask.any():
        return np.full(mask.shape, -1, np.int64)
    near = np.asarray(distance_transform_cdt(~mask, metric="chessboard")) <= texels
    return np.where(near, nearest_on_chart(mask), -1)


def nearest_on_chart(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """[R, R] for every texel the flat index of the nearest one on a chart (mask [R, R]): its own on one."""
    from scipy.ndimage import distance_transform_edt

    row, column = np.asarray(distance_transform_edt(~mask, return_distances=False, return_indices=True))
    return (row * mask.shape[1] + column).astype(np.int64)
