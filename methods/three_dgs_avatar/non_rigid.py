"""The non-rigid deformation: a hash grid's features and the pose's code → how each Gaussian moves, grows and turns.

3DGS-Avatar, models/deformer/non_rigid.py:191-288 and configs/non_rigid/hashgrid.yaml.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ihbench.methods.three_dgs_avatar.leaky_layers import LeakyLayers
from ihbench.methods.three_dgs_avatar.pose_code import PoseCode
from ihbench.nets.hash_grid import HashGrid

WIDTH, HIDDEN = 128, 3
CODE = 16  # of each Gaussian, for its colour
OUTPUTS = (3, 3, 4, CODE)


@dataclass(frozen=True)
class Deformation:
    """What changes of each Gaussian before it is skinned."""

    offset: Tensor  # [N, 3] m
    growth: Tensor  # [N, 3] added to the logarithms of scales
    turn: Tensor  # [N, 3] vector part of a quaternion whose real part is 1; it turns the Gaussian's own
    code: Tensor  # [N, 16]


class NonRigid(nn.Module):
    """Hash grid 16 × 2 on (ξ + 1)/2, then [32 + 144] → 3 × 128 LeakyReLU → 26."""

    def __init__(
        self, parents: Sequence[int], generator: torch.Generator, log2_size: int, finest: int, last_layer: float
    ):
        super().__init__()
        self.grid = HashGrid(generator, log2_size=log2_size, finest=finest)
        self.pose_code = PoseCode(parents)
        inputs = self.grid.width + self.pose_code.width
        self.layers = LeakyLayers([inputs, *[WIDTH] * HIDDEN, sum(OUTPUTS)])
        if last_layer > 0:
            nn.init.normal_(self.layers.last.weight, 0, last_layer, generator)
            nn.init.zeros_(self.layers.last.bias)

    def forward(
        self,
        places: Tensor,  # [N, 3] ξ
        rotations: Tensor,  # [24, 9], the root's the identity
        joints: Tensor,  # [24, 3] normalised
    ) -> Deformation:
        features = self.grid((places + 1) / 2)
        code = self.pose_code(rotations, joints)
        # the code is one for all: its part of the first layer is a bias
        first = self.layers.first
        of_grid, of_code = first.weight.split([features.shape[1], len(code)], 1)
        x = self.layers.after_first(F.linear(features, of_grid, first.bias + of_code @ code))
        offset, growth, quaternion, code = x.split(OUTPUTS, 1)
        # as released: the real part is written over with 1, so its output has no effect
        return Deformation(offset, growth, quaternion[:, 1:], code)


def turned(
    quaternions: Tensor,  # [N, 4] w first
    turn: Tensor,  # [N, 3] vector part beside a real part of 1
) -> Tensor:
    """[N, 4] (1, turn) ⊗ q, not of unit length."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    return torch.cat([w - (turn * v).sum(1, keepdim=True), v + w * turn + torch.linalg.cross(turn, v)], 1)
