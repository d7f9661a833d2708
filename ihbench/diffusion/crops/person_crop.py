"""The window that the diffusion model sees: the padded box of the projected body, brought to the model's size."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera

PADDING = 0.06  # of the body's longer side, on every side: hair, garments and soles stand off the body
WIDTHS = (0.5, 0.625, 0.75, 1.0)  # crop widths as shares of the height; a standing person needs no square


@dataclass(frozen=True)
class PersonCrop:
    """A window of an image, which may reach beyond it, and the size in px to which it is resampled."""

    x0: int
    y0: int
    window_width: int
    window_height: int
    width: int
    height: int

    def camera(self, camera: Camera) -> Camera:
        """The camera that sees exactly the crop."""
        window = camera.cropped(self.x0, self.y0, self.window_width, self.window_height)
        return window.scaled(self.width, self.height)

    def cut(self, image: NDArray, fill: float = 0) -> NDArray:
        """[H, W] or [H, W, C] of the whole image -> [height, width(, C)] of the crop: area means when it shrinks,
        bilinear when it grows. Outside the image `fill` holds. 8-bit stays 8-bit, anything else becomes float32."""
        image = image if image.dtype == np.uint8 else image.astype(np.float32)
        window = np.full((self.window_height, self.window_width, *image.shape[2:]), fill, image.dtype)
        whole, own = self._overlap(*image.shape[:2])
        window[own] = image[whole]
        how = cv2.INTER_AREA if self.height < self.window_height else cv2.INTER_LINEAR
        return cv2.resize(window, (self.width, self.height), interpolation=how)

    def paste(self, crop: NDArray[np.float32], image: NDArray[np.float32]) -> NDArray[np.float32]:
        """A copy of `image` [H, W(, C)] whose window shows `crop` [height, width(, C)], brought back to its size."""
        how = cv2.INTER_CUBIC if self.window_height > self.height else cv2.INTER_AREA
        back = cv2.resize(np.asarray(crop, np.float32), (self.window_width, self.window_height), interpolation=how)
        out = image.copy()
        whole, own = self._overlap(*image.shape[:2])
        out[whole] = back[own]
        return out

    def _overlap(self, height: int, width: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
        """The rows and columns of the image that the window covers, and the same in the window."""
        rows, cols = _overlap(self.y0, self.window_height, height), _overlap(self.x0, self.window_width, width)
        own = slice(rows.start - self.y0, rows.stop - self.y0), slice(cols.start - self.x0, cols.stop - self.x0)
        return (rows, cols), own


def _overlap(start: int, length: int, limit: int) -> slice:
    low = min(max(start, 0), limit)
    return slice(low, max(low, min(start + length, limit)))


def person_crop(
    camera: Camera,
    vertices: NDArray[np.float64],  # [V, 3] m world
    size: int,
    *,
    square: bool = False,
    padding: float = PADDING,
) -> PersonCrop:
    """The window around a body, `size` px tall and as wide as it needs (`square`: always `size`).

    A body that is not wholly in front of the camera gets the whole image.
    """
    p = camera.project(vertices)
    if (p[:, 2] > 0).all():
        low, high = p[:, :2].min(0), p[:, :2].max(0)
    else:
        low, high = np.zeros(2), np.array([camera.width, camera.height], np.float64)
    pad = padding * (high - low).max()
    box_width, box_height = high - low + 2 * pad
    long = max(box_width, box_height, 8.0)
    share = 1.0 if square else next(w for w in WIDTHS if w == WIDTHS[-1] or box_width <= w * long)
    window_height = int(np.ceil(long))
    window_width = max(round(share * window_height), 1)
    x0, y0 = np.round((low + high) / 2 - np.array([window_width, window_height]) / 2).astype(int)
    return PersonCrop(int(x0), int(y0), window_width, window_height, round(share * size), size)
