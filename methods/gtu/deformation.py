"""From GTU's canonical body, the T-pose with the legs apart, to a pose: linear blend skinning read from a grid.

For a Gaussian at x (gtu/smpl_deformer/deformer.py, smpl_server.py):

    w = the grid's weights at x, trilinear; 0 outside         grid: the weights of the nearest canonical vertex
    A = Σ w_k G_k(θ, β) G_k(canonical, β₀)⁻¹                  posed: A x, A Σ Aᵀ, A not orthonormalised

β₀ is the person's shape, β that of the frame: where they are one, A is skinning and no more. There are no pose blend
shapes beyond those of the canonical pose, and no non-rigid part.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning import joint_transforms

CANONICAL = "gaussianavatar"  # hips turned by 30 degrees; GTU's too


class Deformation(nn.Module):
    """What a body of one shape contributes: fixed. In float64 until it is turned into another type."""

    vertices: Tensor  # [V, 3] m, canonical
    grid: Tensor  # [1, 24, G, G, G] weights, along z, y, x
    low: Tensor  # [3] m, corner of the grid's cube
    side: Tensor  # [] m
    back: Tensor  # [24, 4, 4] from the canonical pose to the T-pose

    def __init__(self, body: Body, betas: NDArray[np.float64], points: int):
        """`points` along a side of the grid. Raises `BadInput` for shape coefficients that the body does not have."""
        super().__init__()
        self.body = body
        at_rest = BodyPose(canonical_pose(CANONICAL), betas, np.zeros(3))
        vertices = body.pose(at_rest)
        low, high = vertices.min(0), vertices.max(0)
        side = (high - low).max()  # a cube of the longest side, no margin
        low = (low + high - side) / 2
        for name, value in (
            ("vertices", vertices),
            ("grid", _nearest_weights(vertices, body.weights, low, side, points)),
            ("low", low),
            ("side", side),
            ("back", np.linalg.inv(body.joint_transforms(at_rest))),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float64)), persistent=False)
        self.parents = [int(p) for p in body.parents]

    def joints(self, betas: NDArray[np.float64]) -> Tensor:
        """[24, 3] m of the T-pose. Raises `BadInput` for coefficients that the body does not have."""
        return torch.from_numpy(np.array(self.body.shaped(betas)[1])).to(self.vertices)

    def weights(
        self,
        points: Tensor,  # [N, 3] m, canonical
    ) -> Tensor:
        """[N, 24] skinning weights, differentiable in the points. Outside the cube they fall to 0 within a cell."""
        place = 2 * (points - self.low) / self.side - 1
        read = F.grid_sample(
            self.grid, place[None, :, None, None], mode="bilinear", padding_mode="zeros", align_corners=True
        )
        return read[0, :, :, 0, 0].T

    def outside(self, points: Tensor) -> Tensor:
        """[N] bool: not in the cube, where weights do not sum to 1."""
        return ((points < self.low) | (points > self.low + self.side)).any(1)

    def forward(
        self,
        points: Tensor,  # [N, 3] m, canonical
        pose: Tensor,  # [24, 3] rad
        joints: Tensor,  # [24, 3] m
        transl: Tensor,  # [3] m
    ) -> tuple[Tensor, Tensor]:
        """Places [N, 3] m in the world and the linear parts [N, 3, 3] of A. Differentiable in all four."""
        transforms = joint_transforms(pose, joints, self.parents, transl) @ self.back
        turn, shift = (self.weights(points) @ transforms[:, :3].flatten(1)).unflatten(1, (3, 4)).split([3, 1], 2)
        return (turn @ points[..., None] + shift)[..., 0], turn


def _nearest_weights(
    vertices: NDArray[np.float64], weights: NDArray[np.float64], low: NDArray[np.float64], side: float, points: int
) -> NDArray[np.float64]:
    """[1, 24, G, G, G]: at each point of the cube the weights of the vertex next to it."""
    x, y, z = (low[axis] + side * np.linspace(0, 1, points) for axis in range(3))
    where = np.stack(np.meshgrid(z, y, x, indexing="ij"), -1)[..., ::-1]
    number = np.asarray(KDTree(vertices).query(where.reshape(-1, 3))[1])
    return weights[number].T.reshape(1, -1, points, points, points)
