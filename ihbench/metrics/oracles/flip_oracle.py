"""FLIP spelled out in float64 by the formulas of Andersson et al. (HPG 2020); what the fast one is held to.

Filters are dense squares, moved over the image tap by tap; edges are continued by their outermost pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.oracles.oracle import unit

DEFAULT_PPD = 3840 * math.pi / 180  # 0.7 m from a screen of 3840 px and 0.7 m

_XYZ_OF_RGB = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _XYZ_OF_RGB @ np.ones(3)  # XYZ of the reference illuminant, D65
_RGB_OF_XYZ = np.linalg.inv(_XYZ_OF_RGB)


def flip_oracle(
    pred: NDArray,  # [H, W, 3]
    truth: NDArray,  # [H, W, 3]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
    background: float | tuple[float, ...] = 1.0,
    ppd: float = DEFAULT_PPD,
) -> float:
    """Mean of the FLIP map over the frame, or over the mask after painting both images outside it."""
    pred, truth = unit(pred), unit(truth)
    if mask is not None:
        pred[~mask] = truth[~mask] = background
    if not (np.isfinite(pred).all() and np.isfinite(truth).all()):
        return math.nan
    values = flip_map_oracle(pred, truth, ppd)
    inside = values.ravel() if mask is None else values[mask]
    return math.fsum(inside) / len(inside) if len(inside) else math.nan


def flip_map_oracle(
    pred: NDArray,  # [H, W, 3] float in [0, 1] or uint8
    truth: NDArray,  # as pred
    ppd: float = DEFAULT_PPD,
) -> NDArray[np.float64]:
    """[H, W] FLIP of two finite images [H, W, 3]."""
    x, y = (_opponent(np.clip(unit(image), 0, 1)) for image in (pred, truth))
    color = _color_difference(_lab_with_hunt(_blurred(x, ppd)), _lab_with_hunt(_blurred(y, ppd)))
    feature = _feature_difference((x[..., 0] + 16) / 116, (y[..., 0] + 16) / 116, ppd)
    return color ** (1 - feature)


def _opponent(srgb: NDArray) -> NDArray:
    """sRGB -> Y, Cx, Cz (§ 4.1)."""
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    x, y, z = np.moveaxis(linear @ _XYZ_OF_RGB.T / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _blurred(opponent: NDArray, ppd: float) -> NDArray:
    """The contrast sensitivity filters (§ 4.1), and back to RGB in [0, 1]."""
    radius = math.ceil(3 * math.sqrt(0.04 / (2 * math.pi**2)) * ppd)
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1] / ppd
    out = np.empty(opponent.shape)
    for channel, (a1, b1, a2, b2) in enumerate(
        [(1, 0.0047, 0, 1e-5), (1, 0.0053, 0, 1e-5), (34.1, 0.04, 13.5, 0.025)]
    ):
        kernel = sum(
            a * math.sqrt(math.pi / b) * np.exp(-(math.pi**2) * (rows**2 + columns**2) / b)
            for a, b in ((a1, b1), (a2, b2))
        )
        out[..., channel] = _filtered(opponent[..., channel], kernel / np.sum(kernel))
    y = (out[..., 0] + 16) / 116
    xyz = np.stack([out[..., 1] / 500 + y, y, y - out[..., 2] / 200], -1) * _WHITE
    return np.clip(xyz @ _RGB_OF_XYZ.T, 0, 1)


def _lab_with_hunt(linear: NDArray) -> NDArray:
    """Linear RGB -> CIELAB with a and b times L / 100."""
    t = linear @ _XYZ_OF_RGB.T / _WHITE
    x, y, z = np.moveaxis(np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29), -1, 0)
    lightness, a, b = 116 * y - 16, 500 * (x - y), 200 * (y - z)
    return np.stack([lightness, 0.01 * lightness * a, 0.01 * lightness * b], -1)


def _hyab(x: NDArray, y: NDArray) -> NDArray:
    d = x - y
    return np.abs(d[..., 0]) + np.sqrt(d[..., 1] ** 2 + d[..., 2] ** 2)


def _color_difference(x: NDArray, y: NDArray) -> NDArray:
    """HyAB to the power 0.7, mapped onto [0, 1] (§ 4.1)."""
    green, blue = _lab_with_hunt(np.array([0.0, 1.0, 0.0])), _lab_with_hunt(np.array([0.0, 0.0, 1.0]))
    largest = _hyab(green, blue) ** 0.7
    knee = 0.4 * largest
    difference = _hyab(x, y) ** 0.7
    return np.where(
        difference < knee, difference * 0.95 / knee, 0.95 + (difference - knee) / (largest - knee) * (1 - 0.95)
    )


def _feature_difference(x: NDArray, y: NDArray, ppd: float) -> NDArray:
    """The larger difference of edges and of points, over √2 and to the power 0.5 (§ 4.2)."""
    sigma = 0.5 * 0.082 * ppd
    radius = math.ceil(3 * sigma)
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(float)
    gauss = np.exp(-(rows**2 + columns**2) / (2 * sigma**2))
    edge, point = _balanced(-columns * gauss), _balanced((columns**2 / sigma**2 - 1) * gauss)
    differences = []
    for kernel in (edge, point):
        magnitudes = [np.hypot(_filtered(image, kernel, True), _filtered(image, kernel.T, True)) for image in (x, y)]
        differences.append(np.abs(magnitudes[0] - magnitudes[1]))
    return np.sqrt(np.maximum(*differences) / math.sqrt(2))


def _balanced(kernel: NDArray) -> NDArray:
    """Positive weights that sum to 1 and negative ones that sum to -1."""
    return np.where(kernel > 0, kernel / kernel[kernel > 0].sum(), kernel / -kernel[kernel < 0].sum())


def _filtered(image: NDArray, kernel: NDArray, contrast: bool = False) -> NDArray:
    """out[i, j] = sum of kernel[a, b] image[i + a - radius, j + b - radius].

    For weights that sum to 0 `contrast` takes what a pixel has more than the middle one. That is the same number, and
    on a flat patch exactly 0: a feature difference of 1e-17 would weigh 3e-9.
    """
    radius, (height, width) = len(kernel) // 2, image.shape
    padded = np.pad(image, radius, "edge")
    out = np.zeros(image.shape)
    for i, j in np.ndindex(kernel.shape):
        out += kernel[i, j] * (padded[i : i + height, j : j + width] - (image if contrast else 0))
    return out
