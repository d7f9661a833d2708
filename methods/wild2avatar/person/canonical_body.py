"""The body in its canonical pose (hips turned outwards by 30°), its signed distance, and bones from there to a frame.

With A_j the skinning transforms of a frame and S_j those of the canonical pose, bone j moves by B_j = A_j S_j⁻¹. When
a shape is fitted, A follows it; S and the vertices stay, as in Vid2Avatar.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn

from ihbench.body import Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skinning import joint_transforms
from ihbench.render.triangles import triangle_areas, triangle_crosses

CANONICAL = "gaussianavatar"  # the legs apart by 30°, nothing else
SURFACE_SAMPLES = 60_000  # about 5 mm apart


class CanonicalBody(nn.Module):
    """What the body of one person contributes; not learned."""

    vertices: Tensor  # [V, 3] m, canonical
    weights: Tensor  # [V, 24]
    rest_joints: Tensor  # [24, 3] m
    joint_shapes: Tensor  # [24, 3, B] m per unit of each shape coefficient
    from_canonical: Tensor  # [24, 4, 4] S⁻¹

    def __init__(self, body: Body, betas: NDArray[np.float64]):
        """Raises `BadInput` for shape coefficients that the body does not have."""
        super().__init__()
        self.betas = np.asarray(betas, np.float64)
        pose = BodyPose(canonical_pose(CANONICAL), self.betas, np.zeros(3))
        known = min(len(self.betas), body.shapedirs.shape[2])
        shapes = np.zeros((24, 3, len(self.betas)))
        shapes[..., :known] = np.einsum("jv,vab->jab", body.J_regressor, body.shapedirs[..., :known])
        for name, value in (
            ("vertices", body.pose(pose, blend_shapes=False)),
            ("weights", body.weights),
            ("rest_joints", body.shaped(self.betas)[1]),
            ("joint_shapes", shapes),
            ("from_canonical", np.linalg.inv(body.joint_transforms(pose))),
        ):
            self.register_buffer(name, torch.from_numpy(np.array(value, np.float32)), persistent=False)
        self.parents = [int(p) for p in body.parents]
        self.faces = body.faces

    def bones(
        self,
        pose: Tensor,  # [24, 3] rad
        transl: Tensor,  # [3] m
        betas: Tensor | None = None,  # [B]; None: the person's first
    ) -> Tensor:
        """[24, 4, 4] B: canonical pose to world. Differentiable in all three."""
        joints = self.rest_joints
        if betas is not None:
            joints = joints + self.joint_shapes @ (betas - torch.from_numpy(np.array(self.betas)).to(betas))
        return joint_transforms(pose, joints, self.parents, transl) @ self.from_canonical

    def bones_of(self, body_pose: BodyPose, betas: Tensor | None = None) -> Tensor:
        """[24, 4, 4] of a given pose, with the person's own shape whatever the pose's coefficients are: the first,
        or `betas` [B]."""
        pose, transl = (torch.from_numpy(np.array(x)).to(self.vertices) for x in (body_pose.pose, body_pose.transl))
        return self.bones(pose, transl, betas)


class BodySurface:
    """The canonical surface as points with normals, for signed distances that are right to a millimetre or two."""

    def __init__(self, body: CanonicalBody, rng: np.random.Generator, count: int = SURFACE_SAMPLES):
        corners = body.vertices.double().cpu().numpy()[body.faces]
        areas = np.cumsum(triangle_areas(corners))
        face = np.searchsorted(areas, rng.uniform(0, areas[-1], count), side="right").clip(max=len(areas) - 1)
        root, v = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
        share = np.stack([1 - root, root * (1 - v), root * v], 1)
        self.points = np.einsum("nc,nca->na", share, corners[face])
        normals = triangle_crosses(corners)[face]
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-20)
        self._tree = KDTree(self.points)

    def distance(
        self,
        points: NDArray[np.float64],  # [N, 3] m
    ) -> NDArray[np.float64]:
        """[N] m, negative inside: the nearest sample's plane where it is near, its distance beyond."""
        far, nearest = self._tree.query(points)
        along = ((points - self.points[nearest]) * self.normals[nearest]).sum(1)
        plane = np.abs(along) + np.maximum(far - 2 * np.abs(along), 0)  # beside a rim the plane is too near
        return np.where(along < 0, -1, 1) * np.minimum(far, np.where(far < 0.02, plane, far))
