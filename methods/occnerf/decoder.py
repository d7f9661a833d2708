"""From features of the surface to density and colour: two networks, no position and no direction of view in them.

As released (tiangexiang/OccNeRF 1cb1ef3, canonical_mlps/occnerf_mlp.py:49-83): hidden layers with ReLU and no skips,
evenly drawn weights of Xavier's variance with a gain of √2 but for last layers, biases of 0.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

GEOMETRY = 64  # features that the first network gives the second


def layers(inputs: int, width: int, depth: int, outputs: int, generator: torch.Generator) -> nn.ModuleList:
    """`depth` hidden layers and the last."""
    made = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise([inputs, *[width] * depth, outputs]))
    for k, layer in enumerate(made):
        assert isinstance(layer, nn.Linear)
        nn.init.xavier_uniform_(layer.weight, 1.0 if k == depth else math.sqrt(2), generator)
        nn.init.zeros_(layer.bias)
    return made


def through(made: nn.ModuleList, x: Tensor) -> Tensor:
    for layer in made[:-1]:
        x = layer(x).relu_()
    return made[-1](x)


class SurfaceDecoder(nn.Module):
    """[neighbours' features, how differently they were seen, own features] → density before its law, colour."""

    def __init__(self, lent: int, own: int, width: int, depth: int, generator: torch.Generator):
        super().__init__()
        self.density = layers(lent + 1 + own, width, depth, 1 + GEOMETRY, generator)
        self.color = layers(GEOMETRY + lent + own, width, depth, 3, generator)

    def forward(
        self,
        lent: Tensor,  # [M, 35] weighted mean of the neighbours' features
        variance: Tensor,  # [M] of their scaled counters
        own: Tensor,  # [M, 32] of the place's projection
    ) -> tuple[Tensor, Tensor]:
        """Raw density [M], and colours [M, 3] in 0..1."""
        geometry = through(self.density, torch.cat([lent, variance[:, None], own], 1))
        color = through(self.color, torch.cat([geometry[:, 1:], lent, own], 1))
        return geometry[:, 0], color.sigmoid()
