"""What counts as an image here, and the checks every metric begins with.

An image is [H, W] or [H, W, C], uint8 with peak 255 or floating point with peak 1, numpy or torch, contiguous or not.
Every channel counts the same and none is taken for alpha: composite RGBA before measuring.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Color = tuple[float, float, float]
Mask = NDArray[np.bool_]  # [H, W]


def as_image(image: Any, name: str = "image") -> NDArray:
    """The image as a numpy array: uint8, float16, float32 or float64.

    Tensors of any device are copied to the CPU without their gradient. bfloat16, which numpy lacks, becomes float32
    without loss. Raises `ValueError`, naming what was given, for anything else.
    """
    if hasattr(image, "detach"):  # a torch tensor; torch itself is not imported for this
        image = image.detach().cpu()
        if "bfloat16" in str(image.dtype):
            image = image.float()
        image = image.numpy()
    if isinstance(image, np.ndarray) and image.dtype.name == "bfloat16":  # of the ml_dtypes package
        image = image.astype(np.float32)
    if not isinstance(image, np.ndarray):
        raise ValueError(f"{name}: expected a numpy array or a torch tensor, got {type(image).__name__}")
    if image.dtype != np.uint8 and image.dtype.name not in ("float16", "float32", "float64"):
        raise ValueError(f"{name}: expected uint8, or floats with peak 1, got {image.dtype}")
    return image


def as_mask(mask: Any) -> Mask | None:
    """A mask as a numpy array; tensors are copied to the CPU."""
    return mask.detach().cpu().numpy() if hasattr(mask, "detach") else mask


def check_images(pred: NDArray, truth: NDArray, mask: NDArray | None = None) -> None:
    """Raise `ValueError`, naming both sides, unless two images and a mask can be compared."""
    if pred.shape != truth.shape or pred.ndim not in (2, 3):
        raise ValueError(
            f"images: expected two of the same shape [H, W] or [H, W, C], got pred {pred.shape}, truth {truth.shape}"
        )
    if (pred.dtype == np.uint8) != (truth.dtype == np.uint8):
        raise ValueError(f"images: expected both uint8 or both float, got pred {pred.dtype}, truth {truth.dtype}")
    if mask is not None and (mask.shape != pred.shape[:2] or mask.dtype != np.bool_):
        raise ValueError(f"mask: expected bool {pred.shape[:2]} like the images, got {mask.dtype} {mask.shape}")


def checked(pred: Any, truth: Any, mask: Any = None) -> tuple[NDArray, NDArray, Mask | None]:
    """Two images and a mask as numpy arrays that can be compared. Raises `ValueError` otherwise."""
    pred, truth, mask = as_image(pred, "pred"), as_image(truth, "truth"), as_mask(mask)
    check_images(pred, truth, mask)
    return pred, truth, mask


def peak_of(dtype: np.dtype) -> float:
    """The largest value of an image of this dtype: 255 for uint8, 1 for floats."""
    return 255.0 if dtype == np.uint8 else 1.0


def differing_pixels(pred: NDArray, truth: NDArray) -> Mask:
    """[H, W] True where the images differ in any channel, or hold something that is not finite."""
    values = pred != truth
    if pred.dtype != np.uint8:
        values |= ~np.isfinite(pred)
    if values.ndim == 2:
        return values
    out = np.zeros(values.shape[:2], np.bool_)
    for channel in range(values.shape[2]):  # ten times faster than any(axis=-1) over an axis of three
        out |= values[..., channel]
    return out


def bounds(mask: Mask) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle that holds every True pixel; None without any."""
    rows = np.flatnonzero(mask.any(1))
    if len(rows) == 0:
        return None
    columns = np.flatnonzero(mask[rows[0] : rows[-1] + 1].any(0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def grown(area: tuple[slice, slice], radius: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The rectangle grown by `radius` on every side, as far as an image of this shape goes."""
    rows, columns = area
    return (
        slice(max(rows.start - radius, 0), min(rows.stop + radius, shape[0])),
        slice(max(columns.start - radius, 0), min(columns.stop + radius, shape[1])),
    )
