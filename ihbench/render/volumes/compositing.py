"""Front to back along rays: weights, colour on a background, accumulated alpha, expected depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

CLEAR = 1e-10  # added to what a sample lets through, as released (NeRF, HumanNeRF): gradients stay finite


@dataclass(frozen=True)
class Composited:
    """What rays show. Colours are premultiplied: what the ray itself contributes, no background."""

    rgb: Tensor  # [N, 3]
    alpha: Tensor  # [N]
    depth: Tensor  # [N] m, sum of weight times depth: over alpha it is the expected depth
    weights: Tensor  # [N, S]

    def on(self, background: Tensor) -> Tensor:  # [3] or [N, 3]
        """[N, 3] colours on a background."""
        return self.rgb + (1 - self.alpha)[:, None] * background


def ray_weights(
    alpha: Tensor,  # [N, S] opacities, front to back
    through: Tensor | None = None,  # [N] what reaches the first of them; None: everything
) -> tuple[Tensor, Tensor]:
    """Weights [N, S] = α_s Π_{u<s} (1 - α_u + 1e-10), and [N] what is left behind the last sample."""
    left = torch.cumprod(1 - alpha + CLEAR, 1)
    if through is not None:
        left = left * through[:, None]
    first = alpha.new_ones(len(alpha), 1) if through is None else through[:, None]
    return alpha * torch.cat([first, left[:, :-1]], 1), left[:, -1]


def alpha_composite(
    alpha: Tensor,  # [N, S] opacities, front to back
    colors: Tensor,  # [N, S, 3]
    depths: Tensor,  # [N, S] m
) -> Composited:
    """Opacities and colours of all samples of rays to what the rays show."""
    weights, _ = ray_weights(alpha)
    rgb = (weights[..., None] * colors).sum(1)
    return Composited(rgb, weights.sum(1), (weights * depths).sum(1), weights)


def scattered_composite(
    alpha: Tensor,  # [N, S] opacities, 0 where nothing was evaluated
    colors: Tensor,  # [M, 3] of the samples in `active`, row by row
    depths: Tensor,  # [N, S] m
    active: Tensor,  # [N, S] bool, M of them
) -> Composited:
    """`alpha_composite` of samples most of which are empty: colours only of those that are not."""
    weights, _ = ray_weights(alpha)
    rows = active.nonzero()[:, 0]
    rgb = alpha.new_zeros(len(alpha), 3).index_add(0, rows, weights[active][:, None] * colors)
    return Composited(rgb, weights.sum(1), (weights * depths).sum(1), weights)
