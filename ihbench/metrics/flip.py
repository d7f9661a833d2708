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

How it is computed. Every filter is separable or a sum of two that are; OpenCV runs them in float64. Where the images
agree as far as the filters reach FLIP is exactly 0, so only the rectangle within their radius of a differing pixel is
looked at. The weights of a derivative sum to 0, so it is a filter of the differences between neighbours: on a flat
patch it is then exactly 0, where a rounding error of 1e-17 would come out of the square root as 3e-9.

The map equals its twin's to 1e-12 except in the outermost pixels of a difference, where filters leave 1e-13 of it and
rounding errors are as large: there FLIP is below 1e-5, and both are wrong by up to 1e-9.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.images import Mask, as_background, bounds, checked, differing_pixels, grown, in_colour

PPD = (
    0.7 * (3840 / 0.7) * math.pi / 180
)  # pixels per degree: distance, pixels and width of the official tool's screen
BAND = 2**15  # about so many pixels are worked on at a time: a float64 channel takes 0.5 MB

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

Plane = NDArray[np.float64]  # [h, w] one channel


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
    pred, truth, mask = checked(pred, truth, mask, hdr=hdr)
    pred, truth = in_colour(pred), in_colour(truth)
    as_background(background, 3)
    return mean_flip(pred, truth, differing_pixels(pred, truth), mask, background, ppd)


def mean_flip(
    pred: NDArray,  # [H, W, 3]
    truth: NDArray,  # [H, W, 3]
    differs: Mask,  # [H, W] from `differing_pixels`; shared by all regions of a frame
    mask: Mask | None,  # [H, W]; None is the whole frame
    background: float | tuple[float, ...] = 1.0,
    ppd: float = PPD,
) -> float:
    """`flip` for images already checked."""
    filters = Filters.of(ppd)
    count = differs.size if mask is None else int(np.count_nonzero(mask))
    if count == 0:
        return math.nan
    total = 0.0
    for band in _bands(differs, mask, filters.radius):
        values = _flip(pred, truth, band, mask, background, filters)
        total += float(np.sum(values if mask is None else values[mask[band]]))
    finite = all(np.isfinite(image if mask is None else image[mask]).all() for image in (pred, truth))
    return total / count if finite else math.nan


def flip_map(
    pred: Any,  # [H, W, 3] or [H, W], sRGB, float in [0, 1] or uint8
    truth: Any,  # as pred
    *,
    ppd: float = PPD,
    hdr: bool = False,
) -> NDArray[np.float64]:
    """[H, W] FLIP at every pixel; NaN where a filter meets a NaN or infinite pixel. Raises `ValueError` as `flip`."""
    pred, truth = map(in_colour, checked(pred, truth, hdr=hdr)[:2])
    filters = Filters.of(ppd)
    differs = differing_pixels(pred, truth)
    values = np.zeros(differs.shape)
    for band in _bands(differs, None, filters.radius):
        values[band] = _flip(pred, truth, band, None, 1.0, filters)
    if pred.dtype != np.uint8 and pred.size:
        import cv2

        bad = ~(np.isfinite(pred) & np.isfinite(truth)).all(2)
        square = np.ones((2 * filters.radius + 1,) * 2, np.uint8)
        values[cv2.dilate(bad.astype(np.uint8), square) > 0] = np.nan
    return values


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
    slope: NDArray[np.float64]  # [2 r] weights of the differences x[k + 1] - x[k], k = -r … r - 1
    curve: NDArray[np.float64]  # [2 r] as slope

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
        reach = math.ceil(3 * sigma)
        offset = np.arange(-reach, reach + 1.0)
        gauss = np.exp(-(offset**2) / (2 * sigma**2))
        slope, curve = offset * gauss, (offset**2 / sigma**2 - 1) * gauss
        for weights in (slope, curve):
            for part in (weights > 0, weights < 0):
                weights[part] /= np.abs(weights[part]).sum()
        return Filters(radius, blur, gauss / gauss.sum(), -np.cumsum(slope)[:-1], -np.cumsum(curve)[:-1])


@lru_cache(maxsize=1)
def largest_color_difference() -> float:
    """HyAB between green and blue, to the power of colour differences: the largest in the sRGB gamut."""
    lightness, a, b = (float(x[1] - x[2]) for x in _hunt_lab(list(TO_XYZ)))  # each of red, green, blue
    return (abs(lightness) + math.hypot(a, b)) ** COLOR_EXPONENT


def _hunt_lab(xyz: Sequence[Plane]) -> list[Plane]:
    """L, a L / 100 and b L / 100 of colours X, Y, Z relative to white."""
    x, y, z = (np.where(t > 216 / 24389, np.cbrt(t), t * (841 / 108) + 4 / 29) for t in xyz)
    lightness = 116 * y - 16
    return [lightness, 5 * lightness * (x - y), 2 * lightness * (y - z)]


def _bands(differs: Mask, mask: Mask | None, radius: int) -> Iterator[tuple[slice, slice]]:
    """Rectangles that hold every pixel of the mask within the radius of a differing one in it."""
    area = bounds(differs if mask is None else differs & mask)
    if area is None:
        return
    rows, columns = grown(area, radius, differs.shape)
    if mask is not None and (inside := bounds(mask)):
        rows, columns = (
            slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip((rows, columns), inside, strict=True)
        )
    step = max(4 * radius, BAND // (columns.stop - columns.start))
    for top in range(rows.start, rows.stop, step):
        yield slice(top, min(top + step, rows.stop)), columns


def _flip(
    pred: NDArray,  # [H, W, 3]
    truth: NDArray,  # [H, W, 3]
    area: tuple[slice, slice],
    mask: Mask | None,  # [H, W] both are painted outside it
    background: float | tuple[float, ...],
    filters: Filters,
) -> Plane:
    """[h, w] FLIP in a rectangle; a pixel that is not finite counts as 0."""
    outer = grown(area, filters.radius, pred.shape)  # where the image ends its outermost pixels continue it
    inner = tuple(slice(a.start - o.start, a.stop - o.start) for a, o in zip(area, outer, strict=True))
    outside = None if mask is None else ~mask[outer]
    paint = linear(np.clip(np.broadcast_to(np.asarray(background, np.float64), 3), 0, 1))
    first, second = (_seen(_opponent(image[outer], outside, paint), inner, filters) for image in (pred, truth))
    lightness, a, b, edge, point = (np.abs(x - y) for x, y in zip(first, second, strict=True))
    color = (lightness + np.sqrt(a * a + b * b)) ** COLOR_EXPONENT / largest_color_difference()
    color = np.minimum(color * (KNEE / KNEE_AT), KNEE + (color - KNEE_AT) * ((1 - KNEE) / (1 - KNEE_AT)))
    return color ** (1 - np.sqrt(np.maximum(edge, point) * math.sqrt(0.5)))


def _opponent(image: NDArray, outside: Mask | None, paint: NDArray[np.float64]) -> list[Plane]:
    """Y, Cx, Cz of an image [h, w, 3] painted with linear RGB [3] outside."""
    if image.dtype == np.uint8:
        rgb = [_linear_bytes()[image[..., c]] for c in range(3)]
    else:
        finite = np.where(np.isfinite(image), image, 0).astype(np.float64)
        rgb = [linear(np.clip(finite[..., c], 0, 1)) for c in range(3)]
    if outside is not None:
        for plane, color in zip(rgb, paint, strict=True):
            plane[outside] = color
    x, y, z = _product(TO_XYZ, rgb)
    return [y, x - y, y - z]


def _seen(opponent: list[Plane], inner: tuple[slice, ...], filters: Filters) -> list[Plane]:
    """L, a and b of `_hunt_lab` after the blur, and the strengths of edges and of points, in the inner rectangle."""
    import cv2

    def filtered(plane: Plane, weights_x: NDArray, weights_y: NDArray, anchor: tuple[int, int] = (-1, -1)) -> Plane:
        blurred = cv2.sepFilter2D(
            plane, cv2.CV_64F, weights_x, weights_y, anchor=anchor, borderType=cv2.BORDER_REPLICATE
        )
        return np.asarray(blurred, np.float64)[inner]

    y, cx, cz, cz_2 = (filtered(opponent[min(k, 2)], blur, blur) for k, blur in enumerate(filters.blur))
    rgb = [np.clip(plane, 0, 1) for plane in _product(TO_RGB, [y + cx, y, y - cz - cz_2])]
    strengths = []
    # differences between neighbours, 0 at both ends and so beyond them
    steps_x = np.diff(np.pad(opponent[0], ((0, 0), (1, 1)), "edge"), axis=1)
    steps_y = np.diff(np.pad(opponent[0], ((1, 1), (0, 0)), "edge"), axis=0)
    for weights in (filters.slope, filters.curve):
        middle = len(weights) // 2 - 1
        along_x = filtered(steps_x, weights, filters.gauss, (middle, -1))
        along_y = filtered(steps_y, filters.gauss, weights, (-1, middle))
        strengths.append(np.sqrt(along_x * along_x + along_y * along_y))
    return [*_hunt_lab(_product(TO_XYZ, rgb)), *strengths]


def _product(matrix: NDArray[np.float64], planes: list[Plane]) -> list[Plane]:
    """A matrix [3, 3] times three planes. Not by BLAS: all pixels of one colour must come out the same."""
    a, b, c = planes
    return [row[0] * a + row[1] * b + row[2] * c for row in matrix]


def linear(
    srgb: NDArray[np.float64],  # [...] in [0, 1]
) -> NDArray[np.float64]:
    """sRGB in [0, 1] to linear RGB (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


@lru_cache(maxsize=1)
def _linear_bytes() -> NDArray[np.float64]:
    """[256] linear RGB of every 8-bit value."""
    return linear(np.arange(256) / 255)
