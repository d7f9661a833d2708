"""LDR-FLIP, a perceptual difference without learned weights (Andersson et al., "FLIP: A Difference Evaluator for
Alternating Images", HPG 2020).

The definition, all of it. Both images go from sRGB to linear RGB, to XYZ over the XYZ of white, and to the opponent
channels Y, Cx = X - Y, Cz = Y - Z. There every channel is blurred by what an eye resolves at `ppd` pixels per degree
(§ 4.1; a Gaussian each for Y and Cx, two for Cz). The blurred colours, clipped to the RGB cube, are compared in
CIELAB: a and b times L / 100 (the Hunt effect), |ΔL| + √(Δa² + Δb²) (HyAB), to the power 0.7, mapped onto [0, 1] so
that 0.4 of the distance from green to blue becomes 0.95. Edges and points are first and second derivatives of a
Gaussian over the unblurred Y (§ 4.2). With ΔF the larger difference of their magnitudes, over √2 and to the power
0.5, the map is ΔC^(1 - ΔF). It is symmetric in the images.

Where the paper leaves a choice NVIDIA's evaluator is followed (flip-evaluator 1.7, NVlabs/flip, `FLIP.h`): edges are
continued by their outermost pixel, all filters of Y, Cx and Cz reach as far as three deviations of the widest one,
and the default is a 0.7 m wide screen of 3840 px seen from 0.7 m. Two roundings of it are not followed: its
arithmetic is float32, and white and the inverse colour matrix, nine digits there, are exact here.

How it is computed. Every filter is separable or a sum of two that are; `flip_numba` runs them in float64 over a ring
of rows. Where the images agree as far as the filters reach FLIP is exactly 0, so only what lies within their radius
of a differing pixel is looked at. The weights of a derivative sum to 0, so it is taken of differences between pixels:
on a flat patch it is then exactly 0, where a rounding error of 1e-17 would come out of the square root as 3e-9.

The map equals its twin's to 1e-12 except in the outermost pixels of a difference, where filters leave 1e-13 of it and
rounding errors are as large: there FLIP is below 1e-5, and both are wrong by up to 1e-9.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.images import Mask, as_background, bounds, checked, differing_pixels, grown, peak_of

PPD = (
    0.7 * (3840 / 0.7) * math.pi / 180
)  # pixels per degree: distance, pixels and width of the official tool's screen
BAND = 2**18  # about so many pixels are worked on at a time: the float64 channels of both take 13 MB

# exponent of the colour difference, the part of the largest one that becomes KNEE, width of a feature in degrees
COLOR_EXPONENT, KNEE_AT, KNEE, FEATURE_WIDTH = 0.7, 0.4, 0.95, 0.082
# of the contrast sensitivity: widths of the Gaussians of Y, Cx and Cz, and the amplitudes where there are two
WIDTH_Y, WIDTH_CX = 0.0047, 0.0053
AMPLITUDES_CZ, WIDTHS_CZ = (34.1, 13.5), (0.04, 0.025)

# linear sRGB -> XYZ, as exact fractions; then over the XYZ of white, so that white is 1, 1, 1
_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
TO_XYZ: NDArray[np.float64] = _XYZ / _XYZ.sum(1, keepdims=True)
TO_RGB = np.linalg.inv(TO_XYZ).astype(np.float64)


def flip(
    pred: Any,  # [H, W, 3] or [H, W], sRGB, float in [0, 1] or uint8
    truth: Any,  # as pred
    mask: Any = None,  # [H, W] bool; None is the whole frame
    *,
    ppd: float = PPD,
    background: float | tuple[float, ...] = 1.0,
    hdr: bool = False,
) -> float:
    """Mean FLIP over the frame, or over a region: in [0, 1], 0 for identical images.

    ppd: pixels per degree of visual angle, at least 1
    background: for a region both images are first painted with it outside the mask, a value or one per channel in
        [0, 1]; then the map is averaged over the mask, so nothing outside can leak in through the filters

    Values outside [0, 1] are clipped; far outside they are refused, unless `hdr=True` says that they are meant. An
    empty mask gives NaN, a NaN or infinite pixel inside the mask NaN. Raises `ValueError` for shapes or dtypes that
    do not match, for what is no image (`images.as_image`), for a background outside [0, 1], and for a `ppd` below 1.
    """
    pred, truth, mask = _checked_colors(pred, truth, mask, hdr)
    as_background(background, 3)
    return mean_flip(pred, truth, differing_pixels(pred, truth), mask, background, ppd)


def mean_flip(
    pred: NDArray,  # [H, W, 3]
    truth: NDArray,  # [H, W, 3]
    differs: Mask,  # [H, W] from `differing_pixels`; shared by all regions of a frame
    mask: Mask | None,
    background: float | tuple[float, ...] = 1.0,
    ppd: float = PPD,
) -> float:
    """`flip` for images already checked."""
    filters = Filters.of(ppd)
    pixels = differs.size if mask is None else int(np.count_nonzero(mask))
    if pixels == 0:
        return math.nan
    total = 0.0
    for band in _bands(differs if mask is None else differs & mask, filters.radius):
        part = _sum_of(pred, truth, band, differs, mask, background, filters)
        if math.isnan(part):
            return math.nan
        total += part
    return total / pixels


def flip_map(
    pred: Any,  # [H, W, 3] or [H, W], sRGB, float in [0, 1] or uint8
    truth: Any,  # as pred
    *,
    ppd: float = PPD,
    hdr: bool = False,
) -> NDArray[np.float64]:
    """[H, W] FLIP at every pixel; NaN where a filter meets a NaN or infinite pixel. Raises `ValueError` as `flip`."""
    pred, truth, _ = _checked_colors(pred, truth, None, hdr)
    filters = Filters.of(ppd)
    differs = differing_pixels(pred, truth)
    values = np.zeros(differs.shape)
    for band in _bands(differs, filters.radius):
        _sum_of(pred, truth, band, differs, None, 1.0, filters, values)
    if pred.dtype != np.uint8:
        values[_near(~(np.isfinite(pred).all(2) & np.isfinite(truth).all(2)), filters.radius)] = np.nan
    return values


def _near(mask: Mask, radius: int) -> Mask:
    """[H, W] True within a square of the radius around a True pixel."""
    if not mask.any():
        return mask
    out = mask
    for _ in range(2):  # along rows, then along columns
        spread = out.copy()
        for k in range(1, radius + 1):
            spread[k:] |= out[:-k]
            spread[:-k] |= out[k:]
        out = spread.T
    return out


@dataclass(frozen=True)
class Filters:
    """The filters at one number of pixels per degree, each along one axis.

    A 2-D filter is the product of two of them; that of Cz is the sum of the products of its two Gaussians with
    themselves, and the weights of all sum to 1. The derivatives are odd and even, and sum to 0: their positive
    weights sum to 1 and their negative ones to -1.
    """

    radius: int  # px, of `blur`; features reach less far
    blur: NDArray[np.float64]  # [4, 2 radius + 1] Y, Cx, and twice Cz
    gauss: NDArray[np.float64]  # [2 r + 1]
    slope: NDArray[np.float64]  # [r] weights of x[k] - x[-k], k = 1 … r
    curve: NDArray[np.float64]  # [r] weights of x[k] + x[-k] - 2 x[0]

    @staticmethod
    @lru_cache(maxsize=16)
    def of(ppd: float) -> Filters:
        """Raises `ValueError` below 1 pixel per degree: a feature is then too narrow to be sampled."""
        if not 1 <= ppd < math.inf:
            raise ValueError(f"flip: expected at least 1 pixel per degree, got ppd={ppd}")
        radius = math.ceil(3 * math.sqrt(max(WIDTH_Y, WIDTH_CX, *WIDTHS_CZ) / (2 * math.pi**2)) * ppd)
        squares = (np.arange(-radius, radius + 1) / ppd) ** 2
        blur = np.array([np.exp(-(math.pi**2) * squares / b) for b in (WIDTH_Y, WIDTH_CX, *WIDTHS_CZ)])
        blur[:2] /= blur[:2].sum(1, keepdims=True)
        shares = np.array([a * math.sqrt(math.pi / b) for a, b in zip(AMPLITUDES_CZ, WIDTHS_CZ, strict=True)])
        # the two are filtered along rows and along columns, so each direction takes the root of a share
        blur[2:] *= np.sqrt(shares / (shares * blur[2:].sum(1) ** 2).sum())[:, None]
        sigma = 0.5 * FEATURE_WIDTH * ppd
        offset = np.arange(math.ceil(3 * sigma) + 1)
        gauss = np.exp(-(offset**2) / (2 * sigma**2))
        slope = offset * gauss
        curve = (offset**2 / sigma**2 - 1) * gauss
        twice = np.where(offset == 0, 1, 2)  # every weight but the middle one is there on both sides
        for sign in (1, -1):
            of_sign = sign * curve > 0
            curve[of_sign] /= np.abs(twice * curve)[of_sign].sum()
        gauss /= (twice * gauss).sum()
        return Filters(
            radius, blur, np.concatenate([gauss[:0:-1], gauss]), slope[1:] / slope[1:].sum(), curve[1:].copy()
        )


@lru_cache(maxsize=1)
def largest_color_difference() -> float:
    """HyAB between green and blue, to the power of colour differences: the largest in the sRGB gamut."""
    green, blue = (_hunt_lab(TO_XYZ[:, channel]) for channel in (1, 2))
    return float((abs(green[0] - blue[0]) + math.hypot(*(green[1:] - blue[1:]))) ** COLOR_EXPONENT)


def _hunt_lab(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """L, a L / 100 and b L / 100 of a colour relative to white that is bright enough not to need the linear part."""
    x, y, z = np.cbrt(xyz)
    lightness = 116 * y - 16
    return np.array([lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)])


def _checked_colors(pred: Any, truth: Any, mask: Any, hdr: bool) -> tuple[NDArray, NDArray, Mask | None]:
    """Two images [H, W, 3] and a mask that can be compared; grey becomes three channels. Raises `ValueError`."""
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr)
    if pred.ndim == 2 or pred.shape[2] == 1:
        pred, truth = (
            np.broadcast_to(image.reshape(*image.shape[:2], 1), (*image.shape[:2], 3)) for image in (pred, truth)
        )
    return pred, truth, mask


def _bands(differs: Mask, radius: int) -> Iterator[tuple[slice, slice]]:
    """Rectangles that hold every pixel within the radius of a differing one."""
    area = bounds(differs)
    if area is None:
        return
    rows, columns = grown(area, radius, differs.shape)
    step = max(8 * radius, BAND // (columns.stop - columns.start))
    for top in range(rows.start, rows.stop, step):
        band = slice(top, min(top + step, rows.stop))
        if differs[max(band.start - radius, 0) : band.stop + radius].any():
            yield band, columns


def _sum_of(
    pred: NDArray,
    truth: NDArray,
    band: tuple[slice, slice],
    differs: Mask,
    mask: Mask | None,
    background: float | tuple[float, ...],
    filters: Filters,
    values: NDArray[np.float64] | None = None,
) -> float:
    """The sum of FLIP over a band's pixels in the mask, NaN if one there is not finite; FLIP itself into `values`."""
    from ihbench.metrics import flip_numba as kernel

    # rows and columns that the filters reach; where the image ends earlier its outermost pixels continue it
    outer = grown(band, filters.radius, differs.shape)
    rows, columns = (slice(b.start - o.start, b.stop - o.start) for b, o in zip(band, outer, strict=True))
    unequal = np.array(differs[outer], order="C")
    inside = np.zeros((0, 0), np.bool_)
    if mask is not None:
        inside = np.array(mask[outer], order="C")
        unequal &= inside
    paint = linear(np.clip(np.broadcast_to(np.asarray(background, np.float64), 3), 0, 1))
    planes = _scratch((2, 3, *unequal.shape))
    for image, channels in zip((pred, truth), planes, strict=True):
        # own copies: the kernel would be compiled again for arrays that are read-only or not contiguous
        part = np.array(image[outer], np.float32 if image.dtype == np.float16 else image.dtype, order="C")
        if part.dtype == np.uint8:
            kernel.opponent_of_bytes(part, _linear_bytes(), inside, paint, TO_XYZ, channels)
        elif not kernel.opponent_of_floats(part, inside, paint, TO_XYZ, channels) and values is None:
            return math.nan
    weights = kernel.whole_groups(filters.blur, filters.gauss, filters.slope, filters.curve)
    remap = np.array([COLOR_EXPONENT, KNEE_AT, KNEE, largest_color_difference()])
    keep = np.zeros(unequal.shape if values is not None else (0, 0))
    total = kernel.flip_rows(
        planes[0], planes[1], unequal, inside, rows.start, rows.stop, filters.radius, *weights,
        TO_XYZ, TO_RGB, remap, keep,
    )  # fmt: skip
    if values is not None:
        values[band] = keep[rows, columns]
    return total


_OWN = local()


def _scratch(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """An array of this thread that is used again: fresh memory of this size costs as much as what is put into it."""
    size = math.prod(shape)
    kept = getattr(_OWN, "planes", None)
    if kept is None or len(kept) < size:
        kept = _OWN.planes = np.empty(size)
    return kept[:size].reshape(shape)


def linear(srgb: NDArray[np.float64]) -> NDArray[np.float64]:
    """sRGB in [0, 1] to linear RGB (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


@lru_cache(maxsize=1)
def _linear_bytes() -> NDArray[np.float64]:
    """[256] linear RGB of every 8-bit value."""
    return linear(np.arange(256) / peak_of(np.dtype(np.uint8)))
