"""The Gaussian parameter decoder (sec. 3.2, eq. 1): features and encoded position -> offset, scale factor, colour."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, softplus

SOFTPLUS_ONE = math.log(math.e - 1)  # softplus of this is 1


class GaussianDecoder(nn.Module):
    """`layers` linear layers with ReLU between. The last starts at zero, so a fit begins on the surface, at the
    initial scale, in grey."""

    def __init__(self, in_features: int, width: int, layers: int, generator: torch.Generator):
        super().__init__()
        stack = [nn.Linear(a, b) for a, b in pairwise([in_features, *[width] * (layers - 1), 7])]
        for layer in stack:
            bound = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.weight, -bound * math.sqrt(3), bound * math.sqrt(3), generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(stack[-1].weight)
        self.linear = nn.ModuleList(stack)

    def forward(self, features: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Raw outputs offset [n, 3], scale [n], colour [n, 3] in [0, 1] of features [n, C] and positions [n, E],
        which are as one input [n, C + E]. Apart, what needs no gradient has none computed."""
        first, *others = cast("list[nn.Linear]", list(self.linear))
        of_features, of_encoded = first.weight.split([features.shape[1], encoded.shape[1]], 1)
        hidden = linear(features, of_features, first.bias) + linear(encoded, of_encoded)
        for layer in others:
            hidden = layer(torch.relu_(hidden))
        out = hidden
        return out[:, :3], out[:, 3], torch.sigmoid(out[:, 4:])


def scale_factor(raw: Tensor, activation: str) -> Tensor:
    """A positive factor, 1 at 0. `exp` is cut at e^±5, beyond which the scale limit rules anyway."""
    if activation == "softplus":
        return softplus(raw + SOFTPLUS_ONE)
    return torch.exp(raw.clamp(-5, 5))
