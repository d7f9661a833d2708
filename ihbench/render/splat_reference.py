"""The float64 twin of the splat renderer: dense, plain torch, gradients by autograd, no early stop.

Slow and obvious. Every other back end is compared with this one.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, Splats


def composite(
    splats: Splats,
    height: int,
    width: int,
    background: Tensor,  # [C]
    block: int = 16,
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float64.

    The picture is drawn in blocks of `block`² px, each with the splats whose footprint can reach it: that bounds the
    memory to block² x (splats at one block) and changes nothing, since alpha is exactly 0 outside a footprint.
    """
    order = torch.sort(splats.depth, stable=True).indices
    xy, variance, colors = splats.xy[order].double(), splats.variance[order].double(), splats.colors[order].double()
    background = background.double()
    rows = []
    for y0 in range(0, height, block):
        row = []
        for x0 in range(0, width, block):
            centers = pixel_centers(x0, y0, min(block, width - x0), min(block, height - y0)).to(xy.device)
            near = splats_near(xy, variance, centers)
            # recomputed in the backward pass: the graph of a whole image would not fit
            image = checkpoint(
                _composite_dense, xy[near], variance[near], colors[near], centers, background, use_reentrant=False
            )
            row.append(image)
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows, 0)
    return image[..., :-1], image[..., -1]


def alphas(xy: Tensor, variance: Tensor, centers: Tensor) -> Tensor:
    """Splat centres [K, 2] px, variances [K] px² and pixel centres [h, w, 2] px -> alpha [h, w, K]."""
    footprint = _footprints(xy, variance, centers)
    return torch.where(footprint < ALPHA_MIN, 0.0, footprint.clamp(max=ALPHA_MAX))


def _footprints(xy: Tensor, variance: Tensor, centers: Tensor) -> Tensor:
    distance_squared = (centers[:, :, None] - xy).square().sum(-1)
    return torch.exp(-distance_squared / (2 * variance))


@torch.no_grad()
def alphas_near_threshold(splats: Splats, height: int, width: int, tolerance: float = 1e-4) -> Tensor:
    """[H, W] int64: how many splats have an alpha within `tolerance`, relative, of ALPHA_MIN or ALPHA_MAX at a pixel.

    Alpha jumps at the first and its gradient at the second, so that rounding alone can decide between two right
    answers. A comparison of two back ends leaves such pixels out, or allows each of these splats ALPHA_MIN.
    """
    rows = []
    for y in range(height):
        centers = pixel_centers(0, y, width, 1).to(splats.xy.device)
        near = splats_near(splats.xy, splats.variance * (1 + 2 * tolerance), centers)
        footprint = _footprints(splats.xy[near].double(), splats.variance[near].double(), centers)
        close = (footprint / ALPHA_MIN - 1).abs() < tolerance
        close |= (footprint / ALPHA_MAX - 1).abs() < tolerance
        rows.append(close.sum(-1))
    return torch.cat(rows, 0)


def pixel_centers(x0: int, y0: int, width: int, height: int) -> Tensor:
    """[h, w, 2] px, float64: the centres of the pixels of a window."""
    x = torch.arange(x0, x0 + width, dtype=torch.float64) + 0.5
    y = torch.arange(y0, y0 + height, dtype=torch.float64) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


@torch.no_grad()
def splats_near(xy: Tensor, variance: Tensor, centers: Tensor) -> Tensor:
    """[K] indices, in order, of the splats whose footprint can reach a window of pixel centres [h, w, 2]."""
    outside = (xy - xy.clamp(centers[0, 0], centers[-1, -1])).square().sum(1)  # squared distance to the window
    reach = 2 * variance * math.log(1 / ALPHA_MIN)
    return (outside <= reach * (1 + 1e-9)).nonzero()[:, 0]


def _composite_dense(xy: Tensor, variance: Tensor, colors: Tensor, centers: Tensor, background: Tensor) -> Tensor:
    """[h, w, C + 1]: the colour over the background, and alpha."""
    alpha = alphas(xy, variance, centers)
    transmittance = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(centers[..., :1]), transmittance[..., :-1]], -1)[..., : len(xy)]
    weights = alpha * before
    left = 1 - weights.sum(-1, keepdim=True)
    return torch.cat([weights @ colors + left * background, 1 - left], -1)
