"""Φ: what a masked image says of the places where it shows a vertex (pixel-aligned features)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ihbench.methods.occgaussian.config import FeatureConfig

INPUTS = 4  # colours, and whether the pixel shows the person


class PixelFeatures(nn.Module):
    """Three 3x3 convolutions with instance norm and SiLU, at full, half and quarter size; their maps and the colours
    are read bilinearly at a place and mixed linearly."""

    def __init__(self, config: FeatureConfig, seed: int):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            widths = (INPUTS, *config.channels)
            self.layers = nn.ModuleList(
                nn.Conv2d(widths[k], widths[k + 1], 3, stride=1 if k == 0 else 2, padding=1) for k in range(3)
            )
            self.mix = nn.Linear(sum(config.channels) + 3, config.size)

    def forward(
        self,
        image: Tensor,  # [h, w, 4] colours in 0..1, background where the person is not shown; the person's mask
        xy: Tensor,  # [n, 2] px, pixel centres at +0.5
    ) -> Tensor:
        """[n, size]."""
        height, width = image.shape[:2]
        grid = (2 * xy / xy.new_tensor([width, height]) - 1)[None, :, None]
        x = image.permute(2, 0, 1)[None]
        read = [_at(x[:, :3], grid)]
        for layer in self.layers:
            x = F.silu(_instance_norm(layer(x)))
            read.append(_at(x, grid))
        return self.mix(torch.cat(read, 1))


def _at(
    maps: Tensor,  # [1, C, h, w]
    grid: Tensor,  # [1, n, 1, 2] in -1..1
) -> Tensor:
    """[n, C]."""
    return F.grid_sample(maps, grid, padding_mode="border", align_corners=False)[0, :, :, 0].T


def _instance_norm(x: Tensor) -> Tensor:
    """Each channel with mean 0 and variance 1 over the image; a map of one pixel is all 0."""
    mean = x.mean((2, 3), keepdim=True)
    return (x - mean) * ((x - mean).square().mean((2, 3), keepdim=True) + 1e-5).rsqrt()
