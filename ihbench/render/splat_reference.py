"""The float64 twin of the splat renderer: dense, plain torch, gradients by autograd.

Slow and obvious. Every other back end is compared with this one.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ihbench.render.splats import PRESETS, Ellipses, Preset, Splats, as_ellipses

AT_THE_STOP = 3  # what an undecided stop counts: a last splat of the "3dgs" preset weighs up to 0.01, some ALPHA_MIN


def composite(
    splats: Splats | Ellipses,
    height: int,
    width: int,
    background: Tensor,  # [C]
    preset: Preset | None = None,
    block: int = 16,
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float64.

    The picture is drawn in blocks of `block`² px, each with the splats whose footprint can reach it: that bounds the
    memory to block² x (splats at one block) and changes nothing, since alpha is exactly 0 outside a footprint.
    """
    rules = preset or PRESETS["opaque"]
    s = _sorted(splats)
    background = background.double()
    rows = []
    for y0 in range(0, height, block):
        row = []
        for x0 in range(0, width, block):
            centers = pixel_centers(x0, y0, min(block, width - x0), min(block, height - y0)).to(s.xy.device)
            near = splats_near(s, centers, rules)
            inputs = s.xy[near], s.covariance[near], s.opacity[near], s.colors[near]
            # recomputed in the backward pass: the graph of a whole image would not fit
            row.append(checkpoint(_composite_dense, *inputs, centers, background, rules, use_reentrant=False))
        rows.append(torch.cat(row, 1))
    image = torch.cat(rows, 0)
    return image[..., :-1], image[..., -1]


def _sorted(splats: Splats | Ellipses) -> Ellipses:
    """In the order of depth, float64."""
    s = as_ellipses(splats)
    order = torch.sort(s.depth, stable=True).indices
    xy, covariance, opacity, colors = (x[order].double() for x in (s.xy, s.covariance, s.opacity, s.colors))
    return Ellipses(xy, covariance, opacity, s.depth[order], colors)


def _footprints(xy: Tensor, covariance: Tensor, opacity: Tensor, centers: Tensor) -> Tensor:
    """Splats [K, …] and pixel centres [h, w, 2] px -> opacity exp(-dᵀ Σ⁻¹ d / 2), [h, w, K]."""
    dx, dy = (centers[:, :, None] - xy).unbind(-1)
    xx, both, yy = covariance.unbind(1)
    exponent = (yy * dx * dx - 2 * both * dx * dy + xx * dy * dy) / (xx * yy - both * both)
    return opacity * torch.exp(-exponent / 2)


def _alphas(footprints: Tensor, rules: Preset) -> Tensor:
    """[h, w, K] in the order of depth: 0 for what is dropped, and for what comes after the end of a pixel."""
    alpha = torch.where(footprints < rules.alpha_min, 0.0, footprints.clamp(max=rules.alpha_max))
    if rules.stop > 0:
        alpha = torch.where(torch.cumprod(1 - alpha, -1) <= rules.stop, 0.0, alpha)
    return alpha


@torch.no_grad()
def alphas_near_threshold(
    splats: Splats | Ellipses, height: int, width: int, tolerance: float = 1e-4, preset: Preset | None = None
) -> Tensor:
    """[H, W] int64: how many splats have an alpha within `tolerance`, relative, of a threshold at a pixel.

    Alpha jumps at the first and its gradient at the second, so that rounding alone can decide between two right
    answers. A comparison of two back ends leaves such pixels out, or allows each of these splats ALPHA_MIN. Where a
    transmittance lies within `tolerance` of the preset's stop, `AT_THE_STOP` more are counted.
    """
    rules = preset or PRESETS["opaque"]
    s = _sorted(splats)
    rows = []
    for y in range(height):
        centers = pixel_centers(0, y, width, 1).to(s.xy.device)
        near = splats_near(s, centers, rules, 1 + 2 * tolerance)
        footprint = _footprints(s.xy[near], s.covariance[near], s.opacity[near], centers)
        close = (footprint / rules.alpha_min - 1).abs() < tolerance
        close |= (footprint / rules.alpha_max - 1).abs() < tolerance
        count = close.sum(-1)
        if rules.stop > 0:
            alpha = torch.where(footprint < rules.alpha_min, 0.0, footprint.clamp(max=rules.alpha_max))
            left = torch.cumprod(1 - alpha, -1)
            count += AT_THE_STOP * ((left / rules.stop - 1).abs() < tolerance).any(-1)
        rows.append(count)
    return torch.cat(rows, 0)


def pixel_centers(x0: int, y0: int, width: int, height: int) -> Tensor:
    """[h, w, 2] px, float64: the centres of the pixels of a window."""
    x = torch.arange(x0, x0 + width, dtype=torch.float64) + 0.5
    y = torch.arange(y0, y0 + height, dtype=torch.float64) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


@torch.no_grad()
def splats_near(splats: Ellipses, centers: Tensor, rules: Preset, margin: float = 1.0) -> Tensor:
    """[K] indices, in order, of the splats whose footprint's box can reach a window of pixel centres [h, w, 2]."""
    beside = splats.xy - splats.xy.clamp(centers[0, 0], centers[-1, -1])  # distance to the window
    cut = 2 * (splats.opacity * margin / rules.alpha_min).clamp(min=1).log() * margin * (1 + 1e-9) + 1e-12
    return (beside.square() <= splats.covariance[:, ::2] * cut[:, None]).all(1).nonzero()[:, 0]


def _composite_dense(
    xy: Tensor,
    covariance: Tensor,
    opacity: Tensor,
    colors: Tensor,
    centers: Tensor,
    background: Tensor,
    rules: Preset,
) -> Tensor:
    """[h, w, C + 1]: the colour over the background, and alpha."""
    alpha = _alphas(_footprints(xy, covariance, opacity, centers), rules)
    transmittance = torch.cumprod(1 - alpha, -1)
    before = torch.cat([torch.ones_like(centers[..., :1]), transmittance[..., :-1]], -1)[..., : len(xy)]
    weights = alpha * before
    left = 1 - weights.sum(-1, keepdim=True)
    return torch.cat([weights @ colors + left * background, 1 - left], -1)
