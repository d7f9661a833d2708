"""The metrics spelled out in float64, one pixel and one window at a time; what the fast ones are held to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

EDGES = {"mirror": "symmetric", "reflect": "reflect", "zero": "constant"}  # what numpy calls them


def psnr_oracle(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    mask: NDArray[np.bool_] | None = None,  # [H, W]; None is the whole frame
) -> float:
    """PSNR in dB of [H, W, C] images, float with peak 1 or uint8; exactly rounded sums."""
    pred, truth = unit(pred), unit(truth)
    errors = []
    for i, j in np.ndindex(pred.shape[:2]):
        if mask is None or mask[i, j]:
            errors += [(float(a) - float(b)) ** 2 for a, b in zip(pred[i, j].flat, truth[i, j].flat, strict=True)]
    if not errors or not all(map(math.isfinite, errors)):
        return math.nan
    mse = math.fsum(errors) / len(errors)
    return math.inf if mse == 0 else -10 * math.log10(mse)


def psnr_channels_oracle(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    mask: NDArray[np.bool_] | None = None,  # [H, W]; None is the whole frame
) -> float:
    """The mean of the channels' PSNRs in dB."""
    values = [psnr_oracle(pred[..., c : c + 1], truth[..., c : c + 1], mask) for c in range(pred.shape[2])]
    return math.fsum(values) / len(values) if all(map(math.isfinite, values)) else sum(values)


def ssim_oracle(
    pred: NDArray,  # [H, W, C]
    truth: NDArray,  # [H, W, C]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
    *,
    window: int = 11,
    sigma: float | None = 1.5,
    data_range: float = 1.0,
    border: str = "mirror",
    crop: int = 0,
    sample: bool = False,
    background: float | tuple[float, ...] | None = 1.0,
) -> float:
    """Mean of the SSIM map over the frame without `crop` pixels at its edges, or over the mask within it, after
    painting both images outside the mask (not for `background=None`)."""
    pred, truth = unit(pred), unit(truth)
    if mask is not None and background is not None:
        pred, truth = pred.copy(), truth.copy()
        pred[~mask] = truth[~mask] = background
    values = ssim_map_oracle(
        pred, truth, window=window, sigma=sigma, data_range=data_range, border=border, sample=sample
    )
    height, width = values.shape[:2]
    inside = [
        value
        for i in range(crop, height - crop)
        for j in range(crop, width - crop)
        if mask is None or mask[i, j]
        for value in values[i, j]
    ]
    return math.fsum(inside) / len(inside) if inside else math.nan


def ssim_map_oracle(
    pred: NDArray,  # [H, W, C] or [H, W], float in [0, 1] or uint8
    truth: NDArray,  # as pred
    *,
    window: int = 11,
    sigma: float | None = 1.5,
    data_range: float = 1.0,
    border: str = "mirror",
    sample: bool = False,
) -> NDArray[np.float64]:
    """[H, W, C] SSIM (Wang et al. 2004, eq. 13) with a Gaussian window, or equal weights for no sigma.

    Population moments, or those times n/(n-1). Edges: "mirror" d c b a | a b c d, "reflect" d c b | a b c d, "zero".
    """
    pred, truth = unit(pred), unit(truth)
    height, width, channels = pred.shape
    radius = window // 2
    offsets = range(-radius, radius + 1)
    weights = np.array([[1.0 if sigma is None else _gauss(dy, dx, sigma) for dx in offsets] for dy in offsets])
    weights /= math.fsum(weights.flat)
    unbias = window**2 / (window**2 - 1) if sample else 1.0
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    out = np.empty(pred.shape)
    around = ((radius, radius), (radius, radius), (0, 0))
    padded = [np.pad(image, around, EDGES[border]) for image in (pred, truth)]  # type: ignore[call-overload]
    for i, j, c in np.ndindex(height, width, channels):
        x, y = (image[i : i + window, j : j + window, c] for image in padded)
        mean_x, mean_y = math.fsum((weights * x).flat), math.fsum((weights * y).flat)
        var_x = unbias * math.fsum((weights * (x - mean_x) ** 2).flat)
        var_y = unbias * math.fsum((weights * (y - mean_y) ** 2).flat)
        covariance = unbias * math.fsum((weights * (x - mean_x) * (y - mean_y)).flat)
        luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
        out[i, j, c] = luminance * (2 * covariance + c2) / (var_x + var_y + c2)
    return out


def _gauss(dy: int, dx: int, sigma: float) -> float:
    return math.exp(-(dy * dy + dx * dx) / (2 * sigma * sigma))


def unit(
    image: NDArray,  # [...] uint8, or float with peak 1
) -> NDArray[np.float64]:
    """[...] the image in float64 with peak 1."""
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)
