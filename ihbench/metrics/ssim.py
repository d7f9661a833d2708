"""Structural similarity (Wang et al., IEEE TIP 2004).

The headline definition, all of it: weights exp(-r²/2σ²) on an 11×11 square with σ = 1.5, normalised to 1; K1 = 0.01,
K2 = 0.03; population moments (the weights sum to 1, no n/(n-1) correction); every channel by itself; images mirrored
at their edges (d c b a | a b c d, scipy's "reflect"); the mean runs over the whole map, no border is cropped. Every
one of these is a field of `Window`, so that the released evaluators' readings are one line each.

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
from dataclasses import dataclass
from threading import local
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.images import Mask, as_background, bounds, checked, differing_pixels, grown, peak_of

K1, K2 = 0.01, 0.03
BAND = 2**16  # about so many pixels are worked on at a time: their float64 sums and differences take 1.5 MB

Border = Literal["mirror", "reflect", "zero"]
BORDERS = ("mirror", "reflect", "zero")


@dataclass(frozen=True)
class Window:
    """Everything that defines an SSIM. Raises `ValueError` for a window without a centre or a width, for a data range
    that is not above 0 and for an unknown border."""

    size: int = 11  # px, odd
    sigma: float | None = 1.5  # px; None for equal weights
    data_range: float = 1.0  # of the images; 2 is what old scikit-image assumed of any float image
    border: Border = "mirror"  # d c b a | a b c d, d c b | a b c d (torch's "reflect"), 0 0 0 | a b c d
    crop: int = 0  # px at the frame's edges that do not count
    sample: bool = False  # moments times n/(n-1), scikit-image's default

    def __post_init__(self) -> None:
        for name, value in (("window", self.size), ("crop", self.crop)):
            if isinstance(value, bool) or not isinstance(value, int | np.integer):
                raise ValueError(f"ssim {name}: expected a whole number of pixels, got {value!r}")
        if self.size < 1 or self.size % 2 == 0 or (self.sigma is not None and not self.sigma > 0):
            raise ValueError(
                f"ssim window: expected an odd size and sigma > 0, got window={self.size}, sigma={self.sigma}"
            )
        if not 0 < self.data_range < math.inf or self.border not in BORDERS:
            raise ValueError(
                f"ssim: expected a data range above 0 and a border of {', '.join(BORDERS)}, "
                f"got {self.data_range!r}, {self.border!r}"
            )
        if self.crop < 0 or (self.sample and self.size == 1):
            raise ValueError(f"ssim window: crop below 0 or sample moments of one pixel: {self}")

    @property
    def weights(self) -> NDArray[np.float64]:
        """[size] weights along one axis, summing to 1."""
        return np.full(self.size, 1 / self.size) if self.sigma is None else gaussian_window(self.size, self.sigma)

    @property
    def unbias(self) -> float:
        """What variances and the covariance are multiplied by."""
        return self.size**2 / (self.size**2 - 1) if self.sample else 1.0


HEADLINE = Window()


def ssim(
    pred: Any,  # [H, W, C] or [H, W], float in [0, data_range] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W] bool; None is the whole frame
    *,
    window: int = 11,
    sigma: float | None = 1.5,
    data_range: float = 1.0,
    border: Border = "mirror",
    crop: int = 0,
    sample: bool = False,
    background: float | tuple[float, ...] | None = 1.0,
    hdr: bool = False,
) -> float:
    """Mean SSIM over the frame, or over a region.

    For a region both images are first painted with `background` (a value, or one per channel, in the units of
    `data_range`) outside the mask, then the map is averaged over the mask: nothing outside can leak in through the
    windows. `background=None` does not paint, as OccNeRF's evaluator does not; then windows at the mask's border see
    what lies outside. The other switches are the fields of `Window`. uint8 images are divided by 255. An empty mask
    gives NaN, a NaN or infinite pixel inside the mask NaN, a frame without pixels beyond `crop` NaN. `hdr=True` takes
    floats of any range as they are. Raises `ValueError` for shapes or dtypes that do not match, for what is no image
    (`images.as_image`), for a background outside the range and for an even window.
    """
    definition = Window(window, sigma, data_range, border, crop, sample)
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr, data_range=data_range)
    if background is not None:
        as_background(background, pred.shape[2] if pred.ndim == 3 else 1, data_range)
    return mean_ssim(pred, truth, differing_pixels(pred, truth), mask, definition, background)


def mean_ssim(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    differs: Mask,  # [H, W] from `differing_pixels`; shared by all regions of a frame
    mask: Mask | None,  # [H, W]; None is the whole frame
    window: Window = HEADLINE,
    background: float | tuple[float, ...] | None = 1.0,
) -> float:
    """`ssim` for images already checked."""
    channels = pred.shape[2] if pred.ndim == 3 else 1
    counted = _within_crop(mask, differs.shape, window.crop)
    pixels = differs.size if counted is None else int(np.count_nonzero(counted))
    if pixels * channels == 0:
        return math.nan
    painted = mask if background is not None else None
    deficit = 0.0  # the sum of 1 - SSIM: values near 1 keep their digits
    for band in _bands(differs if painted is None else differs & painted, counted, window.size // 2):
        deficit += _deficit_of(pred, truth, band, counted, painted, window, background)
    return float(1.0 - deficit / (pixels * channels)) if math.isfinite(deficit) else math.nan


def ssim_map(
    pred: Any,  # [H, W, C] or [H, W], float in [0, data_range] or uint8
    truth: Any,  # as pred
    *,
    window: Window = HEADLINE,
    hdr: bool = False,
) -> NDArray[np.float64]:
    """SSIM at every pixel and channel, with the images' shape. Raises `ValueError` as `ssim` does."""
    pred, truth, _ = checked(pred, truth, hdr=hdr, data_range=window.data_range)
    out = np.ones(pred.shape)
    for band in _bands(differing_pixels(pred, truth), None, window.size // 2):
        _deficit_of(pred, truth, band, None, None, window, None, out)
    return out


def gaussian_window(size: int, sigma: float) -> NDArray[np.float64]:
    """[size] weights of the separable Gaussian, summing to 1."""
    offset = np.arange(size) - size // 2
    weights = np.exp(-0.5 * (offset / sigma) ** 2)
    return weights / weights.sum()


@dataclass(frozen=True)
class _Band:
    """Some rows of the image, and the columns of each that need work."""

    top: int
    first: NDArray[np.int64]  # [m]
    last: NDArray[np.int64]  # [m], not included; at or below `first` where the row needs none

    @property
    def rows(self) -> slice:
        return slice(self.top, self.top + len(self.first))


def _bands(differs: Mask, counted: Mask | None, radius: int) -> Iterator[_Band]:
    """Every counted pixel with a differing pixel in its window, as spans of rows."""
    area = bounds(differs)
    if area is None:
        return
    rows, columns = grown(area, radius, differs.shape)  # nothing beyond has a differing pixel in its window
    differs = differs[rows, columns]
    first, last = _row_extents(differs)
    width = differs.shape[1]
    around = np.lib.stride_tricks.sliding_window_view
    first = around(np.pad(first, radius, constant_values=width), 2 * radius + 1).min(1)
    last = around(np.pad(last, radius), 2 * radius + 1).max(1)
    empty = first >= last
    first, last = np.maximum(first - radius, 0), np.minimum(last + radius, width)
    if counted is not None:
        inner_first, inner_last = _row_extents(counted[rows, columns])
        first, last = np.maximum(first, inner_first), np.minimum(last, inner_last)
    last = np.where(empty, 0, last)
    work = np.flatnonzero(first < last)
    if len(work):
        step = max(4 * radius + 1, BAND // int((last - first)[work].max()))
        for top in range(work[0], work[-1] + 1, step):
            span = slice(top, min(top + step, work[-1] + 1))
            if (first[span] < last[span]).any():
                yield _Band(rows.start + top, columns.start + first[span], columns.start + last[span])


def _row_extents(mask: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and one past the last True column of every row [H]; an empty row has first = W, last = 0."""
    width = mask.shape[1]
    if width == 0:
        return np.zeros(len(mask), np.int64), np.zeros(len(mask), np.int64)
    first, last = mask.argmax(1), width - mask[:, ::-1].argmax(1)
    empty = ~mask[np.arange(len(mask)), first]
    return np.where(empty, width, first), np.where(empty, 0, last)


def _deficit_of(
    pred: NDArray,
    truth: NDArray,
    band: _Band,
    counted: Mask | None,
    painted: Mask | None,
    window: Window,
    background: float | tuple[float, ...] | None,
    values: NDArray[np.float64] | None = None,
) -> float:
    """The sum of 1 - SSIM over a band's counted pixels; SSIM itself into `values` where one is given."""
    from ihbench.metrics import ssim_kernel as kernel

    (height, width), radius = pred.shape[:2], window.size // 2
    filled = band.first < band.last
    left, right = int(band.first[filled].min()), int(band.last[filled].max())
    # rows and columns that the windows reach; where the image ends earlier the border rule takes over
    outer = (
        slice(max(band.rows.start - radius, 0), min(band.rows.stop + radius, height)),
        slice(max(left - radius, 0), min(right + radius, width)),
    )
    s, d = _sum_and_difference(pred[outer], truth[outer], None if painted is None else painted[outer], background)
    channels = s.shape[2]
    counts = np.ones((len(filled), s.shape[1]), np.bool_)
    if counted is not None:
        counts = np.ascontiguousarray(counted[band.rows, outer[1]])
    keep = np.empty((len(filled), s.shape[1] * channels) if values is not None else (0, 0))
    weights = np.zeros(-(-window.size // kernel.GROUP) * kernel.GROUP)
    weights[: window.size] = window.weights
    scale = (window.data_range * peak_of(pred.dtype)) ** 2
    border = {"mirror": kernel.MIRROR, "reflect": kernel.REFLECT, "zero": kernel.ZERO}[window.border]
    deficit = kernel.ssim_rows(
        s.reshape(len(s), -1), d.reshape(len(d), -1), channels, weights, window.size, border, window.unbias,
        2 * K1**2 * scale, 2 * K2**2 * scale, band.top - outer[0].start, band.first - outer[1].start,
        band.last - outer[1].start, counts, values is not None, keep,
    )  # fmt: skip
    if values is not None:
        kept = keep.reshape(len(filled), -1, channels)
        for i in np.flatnonzero(filled):
            columns = slice(band.first[i], band.last[i])
            row = kept[i, columns.start - outer[1].start : columns.stop - outer[1].start]
            values[band.top + i, columns] = row.reshape(values[band.top + i, columns].shape)
    return deficit


def _sum_and_difference(
    pred: NDArray,  # [h, w, C] or [h, w]
    truth: NDArray,
    inside: Mask | None,  # [h, w]
    background: float | tuple[float, ...] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x + y and x - y, [h, w, C], both images painted outside `inside`."""
    from ihbench.metrics.ssim_kernel import sum_and_difference

    shape = pred.shape if pred.ndim == 3 else (*pred.shape, 1)
    dtype = np.dtype(np.float32) if pred.dtype == np.float16 else pred.dtype
    # own copies: the kernel would be compiled again for arrays that are read-only or not contiguous
    x, y = _scratch("pred", shape, dtype), _scratch("truth", shape, dtype)
    x[...], y[...] = pred.reshape(shape), truth.reshape(shape)
    s, d = _scratch("s", shape, np.dtype(np.float64)), _scratch("d", shape, np.dtype(np.float64))
    paint = np.full(shape[2], peak_of(pred.dtype)) * (0.0 if background is None else np.asarray(background))
    painted = np.zeros((0, 0), np.bool_) if inside is None or background is None else np.array(inside, order="C")
    sum_and_difference(x, y, painted, paint, s, d)
    return s, d


_OWN = local()


def _scratch(name: str, shape: tuple[int, ...], dtype: np.dtype) -> NDArray:
    """An array of this thread that is used again: fresh memory of this size costs more than what is done with it."""
    size = math.prod(shape)
    kept = getattr(_OWN, name, None)
    if kept is None or len(kept) < size or kept.dtype != dtype:
        kept = np.empty(size, dtype)
        setattr(_OWN, name, kept)
    return kept[:size].reshape(shape)


def _within_crop(mask: Mask | None, shape: tuple[int, int], crop: int) -> Mask | None:
    """The mask without a border of `crop` pixels."""
    if crop == 0:
        return mask
    out = np.zeros(shape, np.bool_)
    inner = slice(crop, max(shape[0] - crop, crop)), slice(crop, max(shape[1] - crop, crop))
    out[inner] = True if mask is None else mask[inner]
    return out
