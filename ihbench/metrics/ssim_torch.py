"""The SSIM of `ssim.py` for training losses: same definition, differentiable, on any device."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ihbench.metrics.images import range_fault
from ihbench.metrics.ssim import K1, K2, Window


def ssim_map_torch(
    pred: Tensor,  # [..., C, H, W] in [0, data_range]
    truth: Tensor,  # [..., C, H, W]
    *,
    window: int = 11,
    sigma: float = 1.5,
    data_range: float = 1.0,
) -> Tensor:
    """[..., C, H, W] SSIM at every pixel, differentiable in both images.

    Half precision is raised to float32; float64 stays. Sums are centred on the middle of the range, which keeps the
    cancellation in E[s²] - E[s]² small: in float32 a variance may come out 1e-7 below zero on a flat patch, against
    C2 = 9e-4, so no division comes near zero. Raises `ValueError` for shapes that do not match, channels that come
    last, integers, and a truth outside the range (a prediction in training may leave it).
    """
    if pred.shape != truth.shape or pred.ndim < 3:
        raise ValueError(
            f"images: expected two of the same shape [..., C, H, W], got {tuple(pred.shape)}, {tuple(truth.shape)}"
        )
    if pred.shape[-1] in (1, 3) and pred.shape[-3] not in (1, 3):
        raise ValueError(
            f"images: expected [..., C, H, W], got {tuple(pred.shape)}; move the channels before H and W"
        )
    if not (pred.is_floating_point() and truth.is_floating_point()):
        raise ValueError(f"images: expected floats, got {pred.dtype}, {truth.dtype}; divide uint8 by 255")
    if truth.numel():
        low, high = torch.stack(torch.aminmax(truth.detach())).tolist()
        fault = range_fault(low, high, data_range, below=0.5, above=1.0)
        if fault and math.isfinite(low + high):
            raise ValueError(f"truth: {fault}")
    taps = Window(window, sigma, data_range).weights
    dtype = torch.promote_types(torch.promote_types(pred.dtype, truth.dtype), torch.float32)
    height, width = pred.shape[-2:]
    x, y = (image.to(dtype).reshape(-1, 1, height, width) for image in (pred, truth))
    weights = torch.from_numpy(taps).to(pred.device, dtype)
    s, d = x + y - data_range, x - y
    mean_s, mean_d, square_s, square_d = _blurred(torch.cat([s, d, s * s, d * d], 1), weights).unbind(1)
    contrast = _ratio(square_s - mean_s**2, square_d - mean_d**2, 2 * (K2 * data_range) ** 2)
    luminance = _ratio((mean_s + data_range) ** 2, mean_d**2, 2 * (K1 * data_range) ** 2)
    return (luminance * contrast).reshape(pred.shape)


def _ratio(a: Tensor, b: Tensor, c: float) -> Tensor:
    return (a - b + c) / (a + b + c)


def _blurred(images: Tensor, weights: Tensor) -> Tensor:
    """[N, M, H, W] filtered along both axes, mirrored at the edges."""
    count, maps, height, width = images.shape
    planes, size = count * maps, len(weights)
    out = images.reshape(1, planes, height, width)
    # depthwise over all planes at once: on a CPU forty times faster than a batch of one-channel images
    down, across = weights.view(1, 1, -1, 1), weights.view(1, 1, 1, -1)
    out = F.conv2d(_mirrored(out, -2, size // 2), down.expand(planes, 1, size, 1), groups=planes)
    out = F.conv2d(_mirrored(out, -1, size // 2), across.expand(planes, 1, 1, size), groups=planes)
    return out.reshape(images.shape)


def _mirrored(images: Tensor, dim: int, radius: int) -> Tensor:
    """Padded by `radius` on both sides, d c b a | a b c d. `F.pad` knows only the form that skips the edge pixel."""
    while radius > 0:  # an image smaller than the window is mirrored more than once
        step = min(radius, images.shape[dim])
        head, tail = images.narrow(dim, 0, step), images.narrow(dim, images.shape[dim] - step, step)
        images = torch.cat([head.flip(dim), images, tail.flip(dim)], dim)
        radius -= step
    return images
