"""What a crop shows of the body's surface, and which surface a pixel shows: the ground of texture fills and drift."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.uv import Texels, nearest_on_chart, texel_at, texel_table
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.render.zbuffer import rasterize
from ihbench.scene.visibility import FacedTexels


def counted_colours(
    faced: FacedTexels,
    image: NDArray[np.uint8],  # [S, W, 3]
    counted: NDArray[np.bool_],  # [S, W]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Texels [m] whose pixel counts, ascending, and their RGB [m, 3] in 0..255: bilinear over counted pixels."""
    keep = counted[faced.pixel]
    return faced.texel[keep], _bilinear(image, counted, faced.xy[keep])


def pixel_texels(view: CropView, body: Body, texels: Texels) -> NDArray[np.int32]:
    """[S, W] number of the texel nearest to what each pixel of the posed body shows; -1 off the body."""
    height, width = view.unknown.shape
    raster = rasterize(view.camera.project(body.pose(view.body_pose)), body.faces, height, width)
    on = raster.mask
    uv = raster.interpolate(body.uv, body.uv_faces)[on].astype(np.float64)
    out = np.full(on.shape, -1, np.int32)
    out[on] = _number_map(body, texels.resolution)[texel_at(uv, texels.resolution, even=True)]
    return out


def off_the_rim(view: CropView) -> NDArray[np.bool_]:
    """[S, W] pixels of the person, visible or supposed, none of whose neighbours shows the background: those at the
    rim are mixed with it."""
    solid = view.person | (view.unknown & view.body)
    return cv2.erode(solid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


@lru_cache(maxsize=8)
def _number_map(body: Body, resolution: int) -> NDArray[np.int32]:
    """[R, R] number of each texel in the texel table; off the charts that of the nearest one on a chart."""
    texels = texel_table(body, resolution)
    out = np.zeros(resolution**2, np.int32)
    out[texels.index] = np.arange(len(texels.index))
    return out[nearest_on_chart(texels.mask)]


def _bilinear(
    image: NDArray[np.uint8],  # [S, W, 3]
    counted: NDArray[np.bool_],  # [S, W]
    xy: NDArray[np.float64],  # [n, 2] px inside counted pixels
) -> NDArray[np.float32]:
    """[n, 3] bilinear samples. Pixels that do not count have no weight; the pixel itself has a quarter or more."""
    height, width = counted.shape
    low = np.floor(xy - 0.5)
    share = xy - 0.5 - low
    total, weight = np.zeros((len(xy), 3)), np.zeros((len(xy), 1))
    for dy in (0, 1):
        for dx in (0, 1):
            column, row = low[:, 0].astype(np.int64) + dx, low[:, 1].astype(np.int64) + dy
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            column, row = np.where(inside, column, 0), np.where(inside, row, 0)
            w = np.abs(1 - dx - share[:, 0]) * np.abs(1 - dy - share[:, 1]) * (inside & counted[row, column])
            total += w[:, None] * image[row, column]
            weight += w[:, None]
    return (total / np.maximum(weight, 1e-12)).astype(np.float32)
