"""Stage 2's pose features: the posed body's position map through a U-Net (released: modules.py:62-111, 185-232)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, relu

BASE = 32
DOWN = (BASE, 2 * BASE, 4 * BASE, 8 * BASE, 8 * BASE)  # channels after each halving
UP = (8 * BASE, 4 * BASE, 2 * BASE, BASE)  # after each doubling but the last
SLOPE = 0.2


class PoseEncoder(nn.Module):
    """Five halvings and five doublings with skips.

    The released LeakyReLU works in place, so what its skips carry is the activated map, and so it is here. Its batch
    norms have nothing to learn and use the batch's statistics at all times.
    """

    def __init__(self, channels: int):
        super().__init__()
        inputs = (3, *DOWN[:-1])
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 4, stride=2, padding=1, bias=False) for a, b in zip(inputs, DOWN, strict=True)
        )
        skips = (0, *DOWN[-2::-1])  # channels that join each doubling
        outputs = (*UP, channels)
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(a + skip, b, 4, stride=2, padding=1, bias=k == len(UP))
            for k, (a, skip, b) in enumerate(zip((DOWN[-1], *UP), skips, outputs, strict=True))
        )

    def forward(self, positions: Tensor) -> Tensor:  # [B, 3, S, S] m
        """[B, channels, S, S]; S must be a multiple of 32."""
        maps, x = [], positions
        for k, convolution in enumerate(self.down):
            x = convolution(x)
            if 0 < k < len(DOWN) - 1:
                x = _normalised(x)
            x = leaky_relu(x, SLOPE) if k < len(DOWN) - 1 else x
            maps.append(x)
        for k, convolution in enumerate(self.up):
            x = convolution(relu(x if k == 0 else torch.cat([maps[-1 - k], x], 1)))
            if k < len(UP):
                x = _normalised(x)
        return x


def _normalised(x: Tensor) -> Tensor:
    """Batch norm without parameters, by the batch's own statistics."""
    return nn.functional.batch_norm(x, None, None, training=True)
