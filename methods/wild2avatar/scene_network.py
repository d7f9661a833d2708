"""What stands before and behind the person: one network in inverted-sphere coordinates (Vid2Avatar's background).

γ₁₀(p/ρ, ±1/ρ) ⊕ code of the frame → layers with softplus (β = 100) → density |raw|, features
γ₄(direction) ⊕ code ⊕ features → one layer with ReLU → RGB
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ihbench.methods.wild2avatar.person.activation import sharp_softplus
from ihbench.nets.positional_encoding import positional_encoding

CODE = 32
VIEW_FREQUENCIES = 4


class SceneNetwork(nn.Module):
    def __init__(self, generator: torch.Generator, width: int, depth: int, skip: int, frequencies: int, frames: int):
        super().__init__()
        self.frequencies, self.skip = frequencies, skip
        self.codes = nn.Parameter(torch.randn(frames, CODE, generator=generator))
        encoded = 4 + 8 * frequencies + CODE
        self.layers = nn.ModuleList(
            nn.Linear(encoded if k == 0 else width + encoded * (k == skip), width) for k in range(depth)
        )
        self.last = nn.Linear(width, 1 + width)
        direction = 3 + 6 * VIEW_FREQUENCIES
        self.colour = nn.Linear(direction + CODE + width, width // 2)
        self.rgb = nn.Linear(width // 2, 3)
        for layer in self.modules():
            if not isinstance(layer, nn.Linear):
                continue
            bound = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.weight, -math.sqrt(3) * bound, math.sqrt(3) * bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)

    def forward(
        self,
        points: Tensor,  # [N, S, 4] inverted-sphere coordinates
        directions: Tensor,  # [N, 3] unit, of the rays
        frame: int,  # row of the codes
    ) -> tuple[Tensor, Tensor]:
        """Densities [N, S] >= 0 per unit of 1/ρ, and RGB [N, S, 3] in [0, 1]."""
        rays, samples = points.shape[:2]
        code = self.codes[frame].expand(rays * samples, -1)
        encoded = x = torch.cat([positional_encoding(points.flatten(0, 1), self.frequencies, 1.0), code], 1)
        for k, layer in enumerate(self.layers):
            if 0 < k == self.skip:
                x = torch.cat([x, encoded], 1)
            x = sharp_softplus(layer(x))
        raw, features = self.last(x).split([1, self.last.out_features - 1], 1)
        views = positional_encoding(directions, VIEW_FREQUENCIES, 1.0).repeat_interleave(samples, 0)
        rgb = self.rgb(F.relu(self.colour(torch.cat([views, code, features], 1)))).sigmoid()
        return raw.abs().reshape(rays, samples), rgb.reshape(rays, samples, 3)
