"""From the canonical big pose to a frame: linear blend skinning with corrected weights and a corrected pose.

For a Gaussian at x, with n its nearest canonical vertex (GauHuman, scene/gaussian_model.py:631-731):

    w     = softmax(ln(W[n] + 1e-9) + offsets(x))
    x_T   = Ā_R⁻¹ (x - Ā_t) - P(θ_big)[n]            Ā = Σ w_k A_k(θ_big, β = 0)
    x_s   = x_T + S[n] β + P(θ ΔR)[n]
    world = B̄_R x_s + B̄_t                            B̄ = Σ w_k A_k(θ ΔR, β)
    B     = B̄_R Ā_R⁻¹                                Σ_world = B Σ Bᵀ

The way back is the inverse of a blend and not a blend of inverses. The released code turns the root apart from the
pose; with the root as joint 0 of `A` the result is the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning import transforms_of_rotations
from ihbench.body.skinning_numpy import axis_angle_to_matrix, pose_blend_offsets

LEAST_WEIGHT = 1e-9  # before the logarithm: a joint that does not move a vertex begins at e^-20.7
CANONICAL = "big_pose"
AT_ONCE = 2048  # points whose distances to all vertices are in memory together, on a GPU


@dataclass(frozen=True)
class Frame:
    """A frame's pose and shape as tensors: all that does not depend on what is learned."""

    pose: Tensor  # [23, 3] rad, of the joints other than the root
    rotations: Tensor  # [24, 3, 3]
    joints: Tensor  # [24, 3] m of the shaped rest pose
    transl: Tensor  # [3] m
    shape_offsets: Tensor  # [V, 3] m: S β


@dataclass(frozen=True)
class Posed:
    """Gaussians in the world."""

    means: Tensor  # [N, 3] m
    linear: Tensor  # [N, 3, 3] B
    weights: Tensor  # [N, 24] w


class Deformation(nn.Module):
    """What a body contributes: fixed. In float64 until it is turned into another type."""

    vertices: Tensor  # [V, 3] m, in the big pose, with pose blend shapes
    log_weights: Tensor  # [V, 24]
    big_turns: Tensor  # [24, 9] A(θ_big, 0), rotations by rows
    big_shifts: Tensor  # [24, 3] m, its translations
    big_offsets: Tensor  # [V, 3] m: P(θ_big)
    posedirs: Tensor  # [V · 3, 207], or none of the rows of a body without pose blend shapes

    def __init__(self, body: Body):
        super().__init__()
        self.body = body
        big = BodyPose(canonical_pose(CANONICAL), np.zeros(1), np.zeros(3))
        vertices, transforms = body.pose(big), body.joint_transforms(big)
        offsets = np.zeros_like(vertices)
        posedirs = np.zeros((0, 207))
        if body.posedirs is not None:
            offsets, posedirs = pose_blend_offsets(big.pose, body.posedirs), body.posedirs.reshape(-1, 207)
        for name, value in (
            ("vertices", vertices),
            ("log_weights", np.log(body.weights + LEAST_WEIGHT)),
            ("big_turns", transforms[:, :3, :3].reshape(24, 9)),
            ("big_shifts", transforms[:, :3, 3]),
            ("big_offsets", offsets),
            ("posedirs", posedirs),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float64)), persistent=False)
        self._tree = KDTree(vertices)
        self.parents = [int(p) for p in body.parents]

    def frame(self, body_pose: BodyPose) -> Frame:
        """Raises `BadInput` for shape coefficients that the body does not have."""
        betas = body_pose.betas
        shaped, joints = self.body.shaped(betas)
        return Frame(
            *(
                self._tensor(value)
                for value in (
                    body_pose.pose[1:],
                    axis_angle_to_matrix(body_pose.pose),
                    joints,
                    body_pose.transl,
                    shaped - self.body.v_template,
                )
            )
        )

    def _tensor(self, value: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(np.array(value)).to(self.vertices)

    @torch.no_grad()
    def nearest(
        self,
        points: Tensor,  # [N, 3] m, canonical
    ) -> Tensor:
        """[N] int64: the canonical vertex next to each point. A point that is not finite has the first."""
        if points.is_cuda:
            parts = points.nan_to_num().split(AT_ONCE)
            return torch.cat([torch.cdist(part, self.vertices).argmin(1) for part in parts])
        number = self._tree.query(points.detach().nan_to_num().numpy())[1]
        return torch.from_numpy(np.asarray(number, np.int64))

    def forward(
        self,
        points: Tensor,  # [N, 3] m, canonical
        nearest: Tensor,  # [N] int64
        frame: Frame,
        offsets: Tensor | None = None,  # [N, 24] added to ln w
        correction: Tensor | None = None,  # [23, 3, 3] ΔR
    ) -> Posed:
        """Where Gaussians are in a frame. Differentiable in points, offsets and correction."""
        log_weights = self.log_weights[nearest]
        weights = (log_weights if offsets is None else log_weights + offsets).softmax(1)
        rotations = frame.rotations
        if correction is not None:
            rotations = torch.cat([rotations[:1], rotations[1:] @ correction])
        transforms = transforms_of_rotations(rotations, frame.joints, self.parents, frame.transl)
        turns, shifts = transforms[:, :3, :3].reshape(24, 9), transforms[:, :3, 3]
        # one product for both blends, cut without copies in the backward pass
        blended = weights @ torch.cat([self.big_turns, self.big_shifts, turns, shifts], 1)
        big_turn, big_shift, turn, shift = blended.split([9, 3, 9, 3], 1)
        turn, back = turn.unflatten(1, (3, 3)), inverse(big_turn.unflatten(1, (3, 3)))
        rest = (back @ (points - big_shift)[..., None])[..., 0]
        shape = rest + self._blend_offsets(rotations, frame.shape_offsets)[nearest]
        return Posed((turn @ shape[..., None])[..., 0] + shift, turn @ back, weights)

    def _blend_offsets(self, rotations: Tensor, shape_offsets: Tensor) -> Tensor:
        """[V, 3] m: S β + P(θ) - P(θ_big)."""
        offsets = shape_offsets - self.big_offsets
        if not len(self.posedirs):
            return offsets
        feature = (rotations[1:] - torch.eye(3).to(rotations)).flatten()
        return offsets + (self.posedirs @ feature).reshape(-1, 3)


def inverse(
    matrices: Tensor,  # [N, 3, 3] of full rank
) -> Tensor:
    """[N, 3, 3] inverses by cofactors: ten times as fast as a factorisation of each."""
    a, b, c = matrices.unbind(-1)
    rows = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -2)
    determinant = (a * rows[..., 0, :]).sum(-1)
    return rows / determinant[..., None, None]
