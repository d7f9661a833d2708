"""Peak signal-to-noise ratio: the mean squared error is pooled over the region's pixels and channels."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def psnr(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    mask: NDArray[np.bool_] | None = None,  # [H, W]; None is the whole frame
) -> float:
    """PSNR in dB for a peak of 1 (255 for uint8): -10 log10 of the mean squared error over the mask and all channels.

    Averaging the three channels' PSNRs instead, as some released code does, is never smaller (Jensen) and is a
    different number. Identical images give inf, an empty mask NaN, a NaN or infinite pixel inside the mask NaN.
    Pixels outside the mask never count. Raises `ValueError` when shapes or dtypes do not match.
    """
    check_images(pred, truth, mask)
    return pooled_psnr(squared_error(pred, truth), mask, pred.shape, peak=peak_of(pred.dtype))


def pooled_psnr(
    error: NDArray,  # [H, W] from `squared_error`; shared by all regions of a frame
    mask: NDArray[np.bool_] | None,  # [H, W]
    shape: tuple[int, ...],  # of the images
    peak: float,
) -> float:
    """`psnr` from the squared error of images already checked."""
    pixels = error.size if mask is None else int(np.count_nonzero(mask))
    count = pixels * math.prod(shape[2:])
    if count == 0:
        return math.nan
    total = float(error.sum() if mask is None else error.sum(where=mask))
    if not math.isfinite(total):
        return math.nan
    return -10.0 * math.log10(total / count / peak**2) if total > 0 else math.inf


def squared_error(pred: NDArray, truth: NDArray) -> NDArray:
    """[H, W] squared difference summed over the channels: exact integers for uint8, else float64.

    Not divided by the peak, so that sums over 8-bit images are exact in any order.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # a NaN or infinite pixel becomes a NaN score, not a warning
        if pred.dtype == np.uint8:
            difference = np.subtract(pred, truth, dtype=np.int32)
        else:
            difference = np.subtract(pred, truth, dtype=np.float64)
        difference *= difference
        if difference.ndim == 2:
            return difference.astype(np.int64) if pred.dtype == np.uint8 else difference
        out = np.zeros(difference.shape[:2], np.int64 if pred.dtype == np.uint8 else np.float64)
        for channel in range(difference.shape[2]):  # faster than sum(axis=-1) over an axis of three
            out += difference[..., channel]
        return out


def peak_of(dtype: np.dtype) -> float:
    """The largest value of an image of this dtype: 255 for uint8, 1 for floats."""
    return 255.0 if dtype == np.uint8 else 1.0


def check_images(pred: NDArray, truth: NDArray, mask: NDArray | None = None) -> None:
    """Raise `ValueError`, naming both sides, unless two images and a mask can be compared."""
    for name, image in (("pred", pred), ("truth", truth)):
        if not isinstance(image, np.ndarray):
            raise ValueError(f"{name}: expected a numpy array, got {type(image).__name__}")
        if image.dtype != np.uint8 and not np.issubdtype(image.dtype, np.floating):
            raise ValueError(f"{name}: expected uint8, or floats in [0, 1], got {image.dtype}")
    if pred.shape != truth.shape or pred.ndim not in (2, 3):
        raise ValueError(
            f"images: expected two of the same shape [H, W] or [H, W, C], got pred {pred.shape}, truth {truth.shape}"
        )
    if (pred.dtype == np.uint8) != (truth.dtype == np.uint8):
        raise ValueError(f"images: expected both uint8 or both float, got pred {pred.dtype}, truth {truth.dtype}")
    if mask is not None and (mask.shape != pred.shape[:2] or mask.dtype != np.bool_):
        raise ValueError(f"mask: expected bool {pred.shape[:2]} like the images, got {mask.dtype} {mask.shape}")
