"""Images as they would be read back from PNG files."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BLOCK = 2**16  # values worked on at a time: they stay in the cache


def rounded(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
) -> NDArray:
    """The nearest 8-bit image; values outside [0, 1] are clipped.

    A pixel that is not finite has no 8-bit value: then the image stays float, in steps of 1/255, and the pixel
    becomes NaN. uint8 images are returned as they are.
    """
    return _to_8bit(image.astype(np.float32) if image.dtype == np.float16 else image, np.rint)


def displayed(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
) -> NDArray[np.uint8]:
    """The nearest 8-bit image, what is not a number in black."""
    return image if image.dtype == np.uint8 else rounded(np.nan_to_num(image, posinf=1.0))


def truncated(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
) -> NDArray:
    """The 8-bit image that a cast makes, as HumanNeRF's `to_8b_image` does, in the image's own precision.

    In float32 a few of the 256 values k/255 fall one below k: a quirk of the released code that this keeps.
    Otherwise as `rounded`.
    """
    return _to_8bit(image, np.floor)


def _to_8bit(image: NDArray, whole: np.ufunc) -> NDArray:
    if image.dtype == np.uint8:
        return image
    if not np.isfinite(image.sum(dtype=np.float64)):  # a sum is NaN or infinite if one pixel is, or none is (HDR)
        bad = ~np.isfinite(image)
        if bad.any():
            return np.where(bad, np.nan, whole(np.clip(image, 0, 1) * image.dtype.type(255))).astype(np.float64) / 255
    out = np.empty(image.shape, np.uint8)
    step = max(1, BLOCK // max(1, image[:1].size))
    for top in range(0, len(image), step):
        scaled = np.clip(image[top : top + step], 0, 1)
        scaled *= 255
        whole(scaled, out=scaled)
        out[top : top + step] = scaled
    return out


def same_type(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
) -> tuple[NDArray, NDArray]:
    """Two prepared images, both uint8 or both float with peak 1."""
    if (pred.dtype == np.uint8) == (truth.dtype == np.uint8):
        return pred, truth
    return as_float(pred), as_float(truth)


def as_float(
    image: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
) -> NDArray:
    """The image with peak 1; uint8 becomes float64."""
    return image / 255.0 if image.dtype == np.uint8 else image
