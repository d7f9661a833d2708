"""Crops of a person drawn in known colours, with a strip in front of some. For tests of inpainting."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.scene.contracts import MaskState, TrainView
from tests.bench.fake_capture import WHITE, a_camera, a_pose, rasterized, the_body, train_view, vertex_colors

SIZE = 96  # px of the crops
STRIP = slice(58, 78)  # columns of the photograph, 128 px: over the trunk


def photographed(
    k: int,
    colours: NDArray[np.floating],  # [V, 3] in [0, 1] per vertex
    yaw: float = 0.0,
    hidden: slice | None = None,
) -> TrainView:
    """View k of the person in these colours on white; the columns `hidden` are unknown and white."""
    camera, pose = a_camera(0.0, 128), a_pose(yaw, 0.2)
    view = train_view(camera, pose, hidden, frame=k)
    raster = rasterized(camera, pose)
    image = np.full_like(view.image, 255)
    image[raster.mask] = np.round(255 * raster.interpolate(colours, the_body().faces)[raster.mask])
    image[view.mask == MaskState.UNKNOWN] = 255
    return replace(view, image=image)


def crop(
    k: int, colours: NDArray[np.floating], yaw: float = 0.0, hidden: slice | None = None, size: int = SIZE
) -> CropView:
    return cut_view(photographed(k, colours, yaw, hidden), k, the_body(), size)


def truth(view: CropView, colours: NDArray[np.floating], yaw: float = 0.0) -> NDArray[np.uint8]:
    """[S, W, 3] the crop's image with nothing hidden."""
    return view.crop.cut(photographed(view.index, colours, yaw).image, 255)


def all_unknown(view: CropView) -> CropView:
    nothing = np.zeros_like(view.person)
    return replace(view, person=nothing, unknown=~nothing, image=np.full_like(view.image, 255))


def nothing_unknown(view: CropView) -> CropView:
    """The same view, whose unknown pixels are now known background."""
    return replace(view, unknown=np.zeros_like(view.unknown))


@cache
def pattern() -> NDArray[np.float64]:
    """[V, 3] smooth over the body, different on all its sides."""
    return vertex_colors()


@cache
def symmetric_pattern() -> NDArray[np.float64]:
    """[V, 3] smooth, and the same on left and right."""
    x, y, z = the_body().v_template.T
    return 0.5 + 0.4 * np.sin(np.stack([5 * y + 1, 9 * np.abs(x) + 4 * y, 3 * y + 9 * z], 1))


def plain(rgb: tuple[float, float, float]) -> NDArray[np.float64]:
    return np.tile(np.array(rgb), (len(the_body().v_template), 1))


def two_sided(left: tuple[float, float, float], right: tuple[float, float, float]) -> NDArray[np.float64]:
    """[V, 3] one colour where x > 0, the person's left, and one where x < 0."""
    side = the_body().v_template[:, :1] > 0
    return np.where(side, np.array(left), np.array(right))


__all__ = ["SIZE", "STRIP", "WHITE", "all_unknown", "crop", "nothing_unknown", "pattern", "photographed", "plain",
           "symmetric_pattern", "truth", "two_sided"]  # fmt: skip
