"""The person: signed distance, density and colour of canonical points (Vid2Avatar's implicit network, rendering
network and Laplace density)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ihbench.methods.wild2avatar.person.sdf_network import POSE, SdfNetwork

if TYPE_CHECKING:
    from ihbench.methods.wild2avatar.config import Wild2AvatarConfig

POSE_CODE = 8
LEAST_SPREAD = 1e-4  # m, added to |β|


class ColourNetwork(nn.Module):
    """[x ⊕ normal ⊕ linear(pose) ⊕ features] → `depth` layers with ReLU → RGB. No direction of view."""

    def __init__(self, generator: torch.Generator, features: int, width: int, depth: int, posed: bool):
        super().__init__()
        self.pose_code = nn.Linear(POSE, POSE_CODE) if posed else None
        sizes = [6 + POSE_CODE * posed + features, *[width] * depth, 3]
        self.layers = nn.ModuleList(nn.Linear(inputs, outputs) for inputs, outputs in pairwise(sizes))
        for layer in [*self.layers, *([self.pose_code] if self.pose_code is not None else [])]:
            bound = 1 / math.sqrt(layer.in_features)
            nn.init.uniform_(layer.weight, -bound, bound, generator)
            nn.init.uniform_(layer.bias, -bound, bound, generator)

    def forward(
        self,
        points: Tensor,  # [N, 3] m, canonical
        normals: Tensor,  # [N, 3] unit, posed space
        features: Tensor,  # [N, F]
        pose: Tensor | None,  # [69] rad; None for a code of 0
    ) -> Tensor:
        """[N, 3] in [0, 1]."""
        parts = [points, normals, features]
        if self.pose_code is not None:
            code = self.pose_code(pose / math.pi) if pose is not None else points.new_zeros(POSE_CODE)
            parts.append(code.expand(len(points), -1))
        x = torch.cat(parts, 1)
        for layer in self.layers[:-1]:
            x = F.relu(layer(x))
        return self.layers[-1](x).sigmoid()


class HumanField(nn.Module):
    def __init__(self, config: Wild2AvatarConfig, generator: torch.Generator):
        super().__init__()
        width = config.sdf_width
        self.sdf = SdfNetwork(
            generator, width, config.sdf_depth, config.sdf_skip, config.sdf_frequencies, config.pose_conditioning
        )
        self.colour = ColourNetwork(
            generator, width, config.colour_width, config.colour_depth, config.pose_conditioning
        )
        self.beta = nn.Parameter(torch.tensor(float(config.beta)))

    @property
    def spread(self) -> Tensor:
        """[] m: b of the Laplace density."""
        return self.beta.abs() + LEAST_SPREAD
