"""Structural similarity (Wang et al., IEEE TIP 2004) with a Gaussian window.

The definition, all of it: weights exp(-r²/2σ²) on an 11×11 square with σ = 1.5, normalised to 1; K1 = 0.01,
K2 = 0.03; population moments (the weights sum to 1, no n/(n-1) correction); every channel by itself; images mirrored
at their edges (d c b a | a b c d, scipy's "reflect"); the mean runs over the whole map, no border is cropped.

How it is computed. With s = x + y and d = x - y every term follows from four filtered images, E[s], E[d], E[s²] and
E[d²]:
    4 μx μy       = E[s]² - E[d]²      2 (μx² + μy²)         = E[s]² + E[d]²
    4 cov(x, y)   = var s - var d      2 (var x + var y)     = var s + var d
where var s = E[s²] - E[s]². That subtraction is where implementations in float32 lose all digits on smooth patches.
Here moments are accumulated in float64 whatever the input, so what is lost is 1e-16 against C2 = 9e-4. And where the
images agree d is exactly 0, both fractions have equal halves, and SSIM is exactly 1: windows in which the images are
identical need no work and are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.psnr import check_images

K1, K2 = 0.01, 0.03
BAND = 64  # rows worked on at a time: the float64 temporaries of a band stay in the cache


def ssim(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, data_range] or uint8
    truth: NDArray,  # as pred
    mask: NDArray[np.bool_] | None = None,  # [H, W]; None is the whole frame
    *,
    window: int = 11,
    sigma: float = 1.5,
    data_range: float = 1.0,
    background: float | tuple[float, ...] = 1.0,
) -> float:
    """Mean SSIM over the frame, or over a region.

    For a region both images are first painted with `background` (a value, or one per channel, in the units of
    `data_range`) outside the mask, then the map is averaged over the mask: nothing outside can leak in through the
    windows. uint8 images are divided by 255. An empty mask gives NaN, a NaN or infinite pixel inside the mask NaN.
    Raises `ValueError` for shapes or dtypes that do not match and for an even window.
    """
    check_images(pred, truth, mask)
    check_window(window, sigma)
    differs = differing_pixels(pred, truth)
    return mean_ssim(pred, truth, differs, mask, window, sigma, data_range, background)


def mean_ssim(
    pred: NDArray,
    truth: NDArray,
    differs: NDArray[np.bool_],  # [H, W] from `differing_pixels`; shared by all regions of a frame
    mask: NDArray[np.bool_] | None,
    window: int = 11,
    sigma: float = 1.5,
    data_range: float = 1.0,
    background: float | tuple[float, ...] = 1.0,
) -> float:
    """`ssim` for images already checked."""
    channels = pred.shape[2] if pred.ndim == 3 else 1
    pixels = differs.size if mask is None else int(np.count_nonzero(mask))
    if pixels * channels == 0:
        return math.nan
    if mask is not None:
        differs = differs & mask
    deficit = 0.0  # the sum of 1 - SSIM: values near 1 keep their digits
    for rows, columns, outer_rows, outer_columns in _windows_to_do(differs, mask, window // 2):
        inside = None if mask is None else mask[outer_rows, outer_columns]
        x, y = pred[outer_rows, outer_columns], truth[outer_rows, outer_columns]
        values = _ssim_of(x, y, inside, window, sigma, data_range, background)
        weights = np.zeros(values.shape[:2])  # selecting pixels by a product is ten times faster than by index
        within = _within(rows, outer_rows), _within(columns, outer_columns)
        weights[within] = 1.0 if inside is None else inside[within]
        deficit += channels * weights.sum() - (weights.ravel() @ values.reshape(weights.size, channels)).sum()
    return float(1.0 - deficit / (pixels * channels)) if math.isfinite(deficit) else math.nan


def ssim_map(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, data_range] or uint8
    truth: NDArray,  # as pred
    *,
    window: int = 11,
    sigma: float = 1.5,
    data_range: float = 1.0,
) -> NDArray[np.float64]:
    """SSIM at every pixel and channel, with the images' shape. Raises `ValueError` as `ssim` does."""
    check_images(pred, truth)
    check_window(window, sigma)
    out = np.ones(pred.shape)
    for rows, columns, outer_rows, outer_columns in _windows_to_do(differing_pixels(pred, truth), None, window // 2):
        x, y = pred[outer_rows, outer_columns], truth[outer_rows, outer_columns]
        values = _ssim_of(x, y, None, window, sigma, data_range, 0.0)
        out[rows, columns] = values[_within(rows, outer_rows), _within(columns, outer_columns)]
    return out


def gaussian_window(window: int, sigma: float) -> NDArray[np.float64]:
    """[window] weights of the separable Gaussian, summing to 1."""
    offset = np.arange(window) - window // 2
    weights = np.exp(-0.5 * (offset / sigma) ** 2)
    return weights / weights.sum()


def check_window(window: int, sigma: float) -> None:
    """Raise `ValueError` unless the window has a centre and a width."""
    if window < 1 or window % 2 == 0 or not sigma > 0:
        raise ValueError(f"ssim window: expected an odd size and sigma > 0, got window={window}, sigma={sigma}")


def _ssim_of(
    pred: NDArray,  # [h, w, C] or [h, w]
    truth: NDArray,
    inside: NDArray[np.bool_] | None,  # [h, w]
    window: int,
    sigma: float,
    data_range: float,
    background: float | tuple[float, ...],
) -> NDArray[np.float64]:
    """The SSIM map of two images, painted outside `inside` and mirrored at their edges."""
    import cv2

    peak = 255.0 if pred.dtype == np.uint8 else 1.0
    shape = pred.shape
    s, d = np.empty(shape), np.empty(shape)
    with np.errstate(invalid="ignore", over="ignore"):  # a NaN or infinite pixel becomes NaN, not a warning
        if pred.dtype == np.uint8:
            pred, truth = pred.astype(np.int16), truth.astype(np.int16)
            np.add(pred, truth, out=s)
            np.subtract(pred, truth, out=d)
        else:
            np.add(pred, truth, out=s, dtype=np.float64)
            np.subtract(pred, truth, out=d, dtype=np.float64)
        if inside is not None:
            outside = ~inside if s.ndim == 2 else np.repeat(~inside[..., None], shape[2], axis=2)
            np.copyto(s, 2 * peak * np.asarray(background, np.float64), where=outside)
            np.copyto(d, 0.0, where=outside)

        weights = gaussian_window(window, sigma)

        def filtered(image: NDArray) -> NDArray:
            out = np.empty(shape)  # given, because cv2 would drop a channel axis of length 1
            cv2.sepFilter2D(image, cv2.CV_64F, weights, weights, dst=out, borderType=cv2.BORDER_REFLECT)
            return out

        mean_s, mean_d = filtered(s), filtered(d)
        s *= s
        d *= d
        var_s, var_d = filtered(s), filtered(d)
        mean_s *= mean_s
        mean_d *= mean_d
        var_s -= mean_s
        var_d -= mean_d
        luminance = _ratio(mean_s, mean_d, 2 * (K1 * data_range * peak) ** 2, out=s)
        contrast = _ratio(var_s, var_d, 2 * (K2 * data_range * peak) ** 2, out=d)
        return np.multiply(luminance, contrast, out=s)


def _ratio(a: NDArray, b: NDArray, c: float, out: NDArray) -> NDArray:
    """(a - b + c) / (a + b + c) into `out`, overwriting a."""
    np.subtract(a, b, out=out)
    out += c
    a += b
    a += c
    return np.divide(out, a, out=out)


def differing_pixels(pred: NDArray, truth: NDArray) -> NDArray[np.bool_]:
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


def _windows_to_do(
    differs: NDArray[np.bool_],  # [H, W]
    mask: NDArray[np.bool_] | None,  # [H, W]
    radius: int,
) -> Iterator[tuple[slice, slice, slice, slice]]:
    """Rectangles that hold every pixel of the mask with a differing pixel in its window, as row bands.

    Each comes as rows and columns, then the same grown by the window's radius as far as the image goes. A window that
    is cut by the image's edge there is mirrored by the filter; everywhere else the grown rectangle holds all of it.
    """
    height, width = differs.shape
    first, last = _extent(differs, mask, 1, radius)
    for top in range(first, last, BAND):
        bottom = min(top + BAND, last)
        outer_rows = slice(max(top - radius, 0), min(bottom + radius, height))
        left, right = _extent(differs[outer_rows], None if mask is None else mask[top:bottom], 0, radius)
        if left < right:
            outer_columns = slice(max(left - radius, 0), min(right + radius, width))
            yield slice(top, bottom), slice(left, right), outer_rows, outer_columns


def _extent(differs: NDArray[np.bool_], mask: NDArray[np.bool_] | None, axis: int, radius: int) -> tuple[int, int]:
    """The range, across `axis`, of the mask within the radius of a differing pixel; (0, 0) if empty."""
    where = np.flatnonzero(differs.any(axis))
    if len(where) == 0:
        return 0, 0
    first, last = max(where[0] - radius, 0), min(where[-1] + radius + 1, differs.shape[1 - axis])
    if mask is not None:
        where = np.flatnonzero(mask.any(axis))
        if len(where) == 0:
            return 0, 0
        first, last = max(first, where[0]), min(last, where[-1] + 1)
    return int(first), int(last)


def _within(inner: slice, outer: slice) -> slice:
    """`inner` counted from the start of `outer`."""
    return slice(inner.start - outer.start, inner.stop - outer.start)
