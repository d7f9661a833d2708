"""The body in its star pose: where Gaussians are born, what bounds them, and how bones go from there to a frame.

The star pose is the T-pose with the legs turned outwards by 45° about the hips, in the person's shape and without
pose blend shapes (3DGS-Avatar, utils/dataset_utils.py:9-48, dataset/zjumocap.py:192-245). With A_j the skinning
transforms of a frame and S_j those of the star pose, bone j moves by B_j = A_j S_j⁻¹. When a shape is fitted, A and S
follow it; vertices, bounds and surface samples stay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning import axis_angle_to_matrix, transforms_of_rotations
from ihbench.render.triangles import triangle_areas

STAR = "vitruvian"
PADDING = (0.1, 0.1, 0.4)  # of the vertices' extent along x, y, z, on either side (config `padding`)
MARGIN = 0.05  # of the body's range, around joints that are normalised


@dataclass(frozen=True)
class Frame:
    """A pose as the networks and the bones have it."""

    rotations: Tensor  # [24, 3, 3] of joints against their parents
    joints: Tensor  # [24, 3] rest joints, normalised to about ±1
    bones: Tensor  # [24, 4, 4] B: star pose to world


class StarBody(nn.Module):
    """What the body of one person contributes; not learned. In float64 until turned into another type."""

    vertices: Tensor  # [V, 3] m, star pose
    weights: Tensor  # [V, 24]
    low: Tensor  # [3] m, corner of the padded bounds
    high: Tensor  # [3] m
    rest_joints: Tensor  # [24, 3] m at the person's shape
    joint_shapes: Tensor  # [24, 3, B] m per unit of each shape coefficient
    center: Tensor  # [3] m, mean of the rest pose's vertices
    reach: Tensor  # [2] m, least and range of its coordinates about that centre, over all axes
    star_turns: Tensor  # [24, 3, 3] how bones are turned in the star pose: legs about their hips
    pivots: Tensor  # [24] int64 the joint that each is turned about

    def __init__(self, body: Body, betas: NDArray[np.float64]):
        """Raises `BadInput` for shape coefficients that the body does not have."""
        super().__init__()
        self.betas = np.asarray(betas, np.float64)
        star = BodyPose(canonical_pose(STAR), self.betas, np.zeros(3))
        vertices = body.pose(star, blend_shapes=False)
        shaped, joints = body.shaped(self.betas)
        padding = np.array(PADDING) * np.ptp(vertices, axis=0)
        center = shaped.mean(0)
        known = min(len(self.betas), body.shapedirs.shape[2])
        shapes = np.zeros((24, 3, len(self.betas)))
        shapes[..., :known] = np.einsum("jv,vab->jab", body.J_regressor, body.shapedirs[..., :known])
        for name, value in (
            ("vertices", vertices),
            ("weights", body.weights),
            ("low", vertices.min(0) - padding),
            ("high", vertices.max(0) + padding),
            ("rest_joints", joints),
            ("joint_shapes", shapes),
            ("center", center),
            ("reach", np.array([(shaped - center).min(), np.ptp(shaped - center)])),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float64)), persistent=False)
        self.parents = [int(p) for p in body.parents]
        pivots = list(range(24))
        for joint, parent in enumerate(self.parents):
            if parent >= 0 and not star.pose[joint].any():
                pivots[joint] = pivots[parent]
        turns = axis_angle_to_matrix(torch.tensor(star.pose))[pivots]
        self.register_buffer("star_turns", turns, persistent=False)
        self.register_buffer("pivots", torch.tensor(pivots), persistent=False)
        self.faces = body.faces
        self._area_up_to = np.cumsum(triangle_areas(vertices[body.faces]))

    # --- the surface ---

    def surface(self, rng: np.random.Generator, count: int) -> tuple[Tensor, Tensor]:
        """Points [count, 3] m, even over the surface, and the body's skinning weights there [count, 24]."""
        area = self._area_up_to
        face = np.searchsorted(area, rng.uniform(0, area[-1], count), side="right").clip(max=len(area) - 1)
        u, v = rng.uniform(size=(2, count))
        root = np.sqrt(u)
        share = torch.from_numpy(np.stack([1 - root, root * (1 - v), root * v], 1)).to(self.vertices)
        corners = torch.from_numpy(self.faces[face].astype(np.int64)).to(share.device)
        points, weights = (torch.einsum("nc,nca->na", share, of[corners]) for of in (self.vertices, self.weights))
        return points, weights

    def normalised(self, points: Tensor) -> Tensor:  # [N, 3] m
        """ξ [N, 3]: -1 and 1 at the bounds, beyond them outside."""
        return 2 * (points - self.low) / (self.high - self.low) - 1

    # --- frames ---

    def frame(self, body_pose: BodyPose) -> Frame:
        """A given pose, with the person's own shape whatever the pose's coefficients are."""
        pose, transl = (self._tensor(each) for each in (body_pose.pose, body_pose.transl))
        return self.frame_of(pose, transl)

    def frame_of(
        self,
        pose: Tensor,  # [24, 3] rad
        transl: Tensor,  # [3] m
        betas: Tensor | None = None,  # [B]; None: the person's first
    ) -> Frame:
        """Differentiable in all three."""
        joints = self.rest_joints
        if betas is not None:
            joints = joints + self.joint_shapes @ (betas - self._tensor(self.betas))
        rotations = axis_angle_to_matrix(pose)
        posed = transforms_of_rotations(rotations, joints, self.parents, transl)
        return Frame(rotations, self._normalised_joints(joints), posed @ self._from_star(joints))

    def _from_star(self, joints: Tensor) -> Tensor:  # [24, 3] m
        """[24, 4, 4] S⁻¹: from the star pose back to rest. One joint at most is turned on the way to each bone."""
        back, pivots = self.star_turns.mT, joints[self.pivots]
        shift = pivots[:, :, None] - back @ pivots[:, :, None]
        last = joints.new_tensor([0, 0, 0, 1]).expand(24, 1, 4)
        return torch.cat([torch.cat([back, shift], 2), last], 1)

    def _normalised_joints(self, joints: Tensor) -> Tensor:
        least, span = self.reach
        return 2 * (joints - self.center - least + MARGIN * span) / span / 1.1 - 1

    def _tensor(self, value: NDArray[np.float64]) -> Tensor:
        return torch.from_numpy(np.array(value)).to(self.vertices)
