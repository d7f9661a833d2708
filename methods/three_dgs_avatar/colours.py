"""Colours: a network of each Gaussian's feature and code, the direction it is seen from, and the frame's latent code.

3DGS-Avatar, models/texture/texture.py:40-124 and configs/texture/shallow_mlp.yaml.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor, nn
from torch.nn import functional as F

from ihbench.methods.three_dgs_avatar.leaky_layers import LeakyLayers
from ihbench.methods.three_dgs_avatar.non_rigid import CODE
from ihbench.render.spherical_harmonics import basis

FEATURE, LATENT, DEGREE = 32, 16, 3
WIDTH = 64
DIRECTIONS = (DEGREE + 1) ** 2 - 1
SPREAD_DEG, MOST_DEG = 45.0, 90.0


class ColourNetwork(nn.Module):
    """[feature 32, spherical harmonics of the direction 15, code 16, latent 16] → 64 → 64 → 3, LeakyReLU, sigmoid."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = LeakyLayers([FEATURE + DIRECTIONS + CODE + LATENT, WIDTH, WIDTH, 3])

    def forward(
        self,
        features: Tensor,  # [N, 32]
        directions: Tensor | None,  # [N, 3] unit; None: no colour depends on them
        codes: Tensor | None,  # [N, 16]; None: zeros
        latent: Tensor,  # [16]
    ) -> Tensor:
        """[N, 3] in 0..1."""
        first = self.layers.first
        parts = first.weight.split([FEATURE, DIRECTIONS, CODE, LATENT], 1)
        # the latent code is one for all: its part is a bias; parts that are absent are zeros
        x = F.linear(features, parts[0], first.bias + parts[3] @ latent)
        if directions is not None:
            x = x + F.linear(basis(directions, DEGREE)[:, 1:], parts[1])
        if codes is not None:
            x = x + F.linear(codes, parts[2])
        return self.layers.after_first(x).sigmoid()


def canonical_directions(
    means: Tensor,  # [N, 3] m, world
    linear: Tensor,  # [N, 3, 3] of the skinning; no gradient goes to it
    center: Tensor,  # [3] m, the camera
    turn: Tensor | None = None,  # [3, 3]
) -> Tensor:
    """[N, 3] unit vectors from the camera to each Gaussian, taken back to the star pose by the transposed skinning,
    then turned. A Gaussian in the camera's centre has the zero vector."""
    rays = (linear.detach().mT @ (means - center)[:, :, None])[..., 0]
    rays = rays if turn is None else rays @ turn.mT
    return F.normalize(rays, dim=1)


def random_turn(rng: np.random.Generator, how: str) -> np.ndarray:
    """[3, 3] R_x R_y R_z by angles of N(0, 45°), at most 90°; how="released" draws that about y evenly from 0° to 45°
    (utils/sh_utils.py:169-214 calls rand where it means randn)."""
    angles = np.clip(SPREAD_DEG * rng.standard_normal(3), -MOST_DEG, MOST_DEG)
    even = SPREAD_DEG * rng.uniform()
    if how == "released":
        angles[1] = even
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.deg2rad(angles)), np.sin(np.deg2rad(angles))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_x @ about_y @ about_z
