"""Small rotations that correct the joints of a frame, from its pose by a network (HumanNeRF, then GauHuman)."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

from ihbench.body.skinning import axis_angle_to_matrix

LAST_LAYER = 1e-5  # bound of its first weights: a fit begins with all but no correction


class PoseCorrection(nn.Module):
    """69 pose values → 23 axis-angle corrections of the joints other than the root, `depth` hidden layers with ReLU.

    As released by GauHuman (nets/mlp_delta_body_pose.py: depth 2, width 128, 34,373 parameters; HumanNeRF has 4 of
    256), but for the rotation of a zero vector, which is the identity here and 0.999995 of it there.
    """

    def __init__(self, generator: torch.Generator, depth: int = 2, width: int = 128, joints: int = 23):
        super().__init__()
        sizes = pairwise([3 * joints, *[width] * depth, 3 * joints])
        layers = [nn.Linear(inputs, outputs) for inputs, outputs in sizes]
        for layer in layers:
            nn.init.xavier_uniform_(layer.weight, math.sqrt(2), generator)
            nn.init.zeros_(layer.bias)
        nn.init.uniform_(layers[-1].weight, -LAST_LAYER, LAST_LAYER, generator)
        self.layers = nn.ModuleList(layers)

    def forward(
        self,
        pose: Tensor,  # [23, 3] rad, axis-angle of the joints other than the root
    ) -> Tensor:
        """[23, 3, 3] rotations ΔR, to be applied as R ΔR."""
        x = pose.reshape(-1)
        for layer in self.layers[:-1]:
            x = layer(x).relu()
        return axis_angle_to_matrix(self.layers[-1](x).reshape(pose.shape))
