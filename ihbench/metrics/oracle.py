"""The metrics spelled out in float64, one pixel and one window at a time; what the fast ones are held to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def psnr_oracle(pred: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float:
    """PSNR in dB of [H, W, C] images, float with peak 1 or uint8; exactly rounded sums."""
    pred, truth = _unit(pred), _unit(truth)
    errors = []
    for i, j in np.ndindex(pred.shape[:2]):
        if mask is None or mask[i, j]:
            errors += [(float(a) - float(b)) ** 2 for a, b in zip(pred[i, j].flat, truth[i, j].flat, strict=True)]
    if not errors or not all(map(math.isfinite, errors)):
        return math.nan
    mse = math.fsum(errors) / len(errors)
    return math.inf if mse == 0 else -10 * math.log10(mse)


def ssim_oracle(
    pred: NDArray,  # [H, W, C]
    truth: NDArray,  # [H, W, C]
    mask: NDArray[np.bool_] | None = None,  # [H, W]
    *,
    window: int = 11,
    sigma: float = 1.5,
    data_range: float = 1.0,
    background: float | tuple[float, ...] = 1.0,
) -> float:
    """Mean of the SSIM map over the frame, or over the mask after painting both images outside it."""
    pred, truth = _unit(pred), _unit(truth)
    if mask is not None:
        pred, truth = pred.copy(), truth.copy()
        pred[~mask] = truth[~mask] = background
    values = ssim_map_oracle(pred, truth, window=window, sigma=sigma, data_range=data_range)
    inside = values.ravel() if mask is None else values[mask].ravel()
    return math.fsum(inside) / len(inside) if len(inside) else math.nan


def ssim_map_oracle(
    pred: NDArray, truth: NDArray, *, window: int = 11, sigma: float = 1.5, data_range: float = 1.0
) -> NDArray[np.float64]:
    """[H, W, C] SSIM (Wang et al. 2004, eq. 13) with a Gaussian window, population moments, mirrored edges."""
    pred, truth = _unit(pred), _unit(truth)
    height, width, channels = pred.shape
    radius = window // 2
    weights = np.array(
        [
            [math.exp(-(dy * dy + dx * dx) / (2 * sigma * sigma)) for dx in range(-radius, radius + 1)]
            for dy in range(-radius, radius + 1)
        ]
    )
    weights /= math.fsum(weights.flat)
    c1, c2 = (0.01 * data_range) ** 2, (0.03 * data_range) ** 2
    out = np.empty(pred.shape)
    for i, j, c in np.ndindex(height, width, channels):
        rows = [_mirror(i + d, height) for d in range(-radius, radius + 1)]
        columns = [_mirror(j + d, width) for d in range(-radius, radius + 1)]
        x, y = pred[np.ix_(rows, columns, [c])][..., 0], truth[np.ix_(rows, columns, [c])][..., 0]
        mean_x, mean_y = math.fsum((weights * x).flat), math.fsum((weights * y).flat)
        var_x = math.fsum((weights * (x - mean_x) ** 2).flat)
        var_y = math.fsum((weights * (y - mean_y) ** 2).flat)
        covariance = math.fsum((weights * (x - mean_x) * (y - mean_y)).flat)
        luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
        out[i, j, c] = luminance * (2 * covariance + c2) / (var_x + var_y + c2)
    return out


def _mirror(index: int, length: int) -> int:
    """The pixel an index outside [0, length) falls on when the image is mirrored at its edges: d c b a | a b c d."""
    index %= 2 * length
    return index if index < length else 2 * length - 1 - index


def _unit(image: NDArray) -> NDArray[np.float64]:
    return image / 255.0 if image.dtype == np.uint8 else image.astype(np.float64)
