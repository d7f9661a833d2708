"""From the posed world back to the canonical pose: each point with the weights of the posed vertex next to it.

    x_c = (Σ_j w_j B_j)⁻¹ x_d        w: of the nearest posed vertex (K = 1)

The inverse of a blend. A gradient ∇f of the canonical pose becomes (∇f)ᵀ M⁻¹ in the world, M the blend's linear part.
(Vid2Avatar, deformer.py.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ihbench.fit.big_pose.deformation import inverse
from ihbench.methods.wild2avatar.person.canonical_body import CanonicalBody

AT_ONCE = 16_384  # points whose distances to all vertices are in memory together, on a GPU


@dataclass(frozen=True)
class Canonical:
    """Points of a frame in the canonical pose."""

    points: Tensor  # [N, 3] m
    back: Tensor  # [N, 3, 3] M⁻¹
    away: Tensor  # [N] m from the nearest posed vertex


class PosedBody:
    """A frame's posed vertices, and the way back from around them. Differentiable in the bones, but for which vertex
    is the nearest."""

    def __init__(self, body: CanonicalBody, bones: Tensor):  # [24, 4, 4]
        blended = (body.weights @ bones[:, :3].flatten(1)).unflatten(1, (3, 4))
        linear, self.shift = blended[..., :3], blended[..., 3]
        self.back = inverse(linear)
        self.vertices = ((linear @ body.vertices[..., None])[..., 0] + self.shift).detach()
        self._tree = None if self.vertices.is_cuda else KDTree(self.vertices.nan_to_num().double().numpy())

    @torch.no_grad()
    def nearest(
        self,
        points: Tensor,  # [N, 3] m, world
    ) -> tuple[Tensor, Tensor]:
        """[N] int64 and [N] m: the vertex next to each point and its distance. A point that is not finite has the
        first."""
        points = points.detach().nan_to_num()
        if self._tree is None:
            parts = [torch.cdist(part, self.vertices).min(1) for part in points.split(AT_ONCE)]
            return torch.cat([p.indices for p in parts]), torch.cat([p.values for p in parts])
        away, number = self._tree.query(points.numpy())
        return torch.from_numpy(np.asarray(number, np.int64)), torch.from_numpy(np.asarray(away, np.float32))

    def to_canonical(
        self,
        points: Tensor,  # [N, 3] m, world
    ) -> Canonical:
        number, away = self.nearest(points)
        back = self.back[number]
        moved = (back @ (points - self.shift[number])[..., None])[..., 0]
        return Canonical(moved, back, away)
