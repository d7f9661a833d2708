"""The body: an SMPL-shaped mesh with blend shapes, a skeleton, skinning weights and texture coordinates."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import skinning_numpy
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import JOINT_INDEX
from ihbench.errors import BadInput

Array = NDArray[np.float64]


@lru_cache(maxsize=16)  # one person is posed thousands of times in one shape
def _shaped(body: Body, betas: bytes) -> tuple[Array, Array]:
    coefficients = np.frombuffer(betas)
    vertices = body.v_template + body.shapedirs[:, :, : len(coefficients)] @ coefficients
    joints = body.J_regressor @ vertices
    vertices.setflags(write=False)
    joints.setflags(write=False)
    return vertices, joints


@dataclass(frozen=True, eq=False)
class Body:
    """An SMPL-shaped body model in its T-pose: y up, facing +z, left hand at +x, metres.

    Made by `load_body`, which checks every shape. Arrays are read-only; two bodies are equal only if they are the
    same object, so a body can be a cache key. Compare contents with `content_sha`.
    """

    v_template: Array  # [V, 3] m
    shapedirs: Array  # [V, 3, B] m per unit of each shape coefficient
    posedirs: Array | None  # [V, 3, 207], or None for a body without pose correctives
    J_regressor: Array  # [24, V] joints from vertices
    weights: Array  # [V, 24] skinning weights, rows sum to 1
    parents: NDArray[np.int32]  # [24] -1 for the root
    faces: NDArray[np.int32]  # [F, 3] counter-clockwise seen from outside
    uv: Array  # [Vt, 2] in [0, 1], OBJ convention: u right, v up, origin bottom left
    uv_faces: NDArray[np.int32]  # [F, 3] into uv; face k is faces[k]
    name: str  # "procedural" or "smpl"
    face_landmarks: Array | None = None  # [3] m: eye |x|, eye y, mouth y; only known for the procedural body

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = np.array(value, np.int32 if value.dtype.kind in "iu" else np.float64)
                value.setflags(write=False)
                object.__setattr__(self, field.name, value)

    def shaped(
        self,
        betas: Array,  # [b]
    ) -> tuple[Array, Array]:
        """Vertices [V, 3] m and joints [24, 3] m of the rest pose with the given shape coefficients.

        Read-only arrays. Missing coefficients count as 0; surplus ones must be 0, else `BadInput`: dropping them
        would make it another person.
        """
        betas = np.asarray(betas, np.float64).reshape(-1)
        known = self.shapedirs.shape[2]
        if betas[known:].any():
            raise BadInput(
                f"body {self.name!r} has {known} shape coefficients, the data gives {len(betas)} and those beyond "
                f"{known} are not 0; load a body file with more coefficients"
            )
        return _shaped(self, betas[:known].tobytes())

    def joint_transforms(self, body_pose: BodyPose) -> Array:
        """[24, 4, 4] transforms that take points of the shaped T-pose to the posed world, translation included."""
        joints = self.shaped(body_pose.betas)[1]
        return skinning_numpy.joint_transforms(body_pose.pose, joints, self.parents, body_pose.transl)

    def posed_joints(self, body_pose: BodyPose) -> Array:
        """[24, 3] m, the joints in the posed world."""
        joints, transforms = self.shaped(body_pose.betas)[1], self.joint_transforms(body_pose)
        return np.einsum("kab,kb->ka", transforms[:, :3, :3], joints) + transforms[:, :3, 3]

    def pose(
        self,
        body_pose: BodyPose,
        *,
        blend_shapes: bool = True,
        offsets: Array | None = None,  # [V, 3] m
    ) -> Array:
        """[V, 3] m, the posed mesh in the world.

        `blend_shapes=False` leaves SMPL's pose correctives out. `offsets` are added to the shaped T-pose before
        skinning (clothes, hair).
        """
        vertices = self.shaped(body_pose.betas)[0]
        if blend_shapes and self.posedirs is not None:
            vertices = vertices + skinning_numpy.pose_blend_offsets(body_pose.pose, self.posedirs)
        if offsets is not None:
            if np.shape(offsets) != vertices.shape:
                raise ValueError(f"offsets: expected {vertices.shape} like the vertices, got {np.shape(offsets)}")
            vertices = vertices + offsets
        return skinning_numpy.lbs(vertices, self.weights, self.joint_transforms(body_pose))

    @cached_property
    def joints(self) -> Array:
        """[24, 3] m, rest joints at zero shape coefficients."""
        return self.J_regressor @ self.v_template

    @property
    def eyes_and_mouth(self) -> tuple[float, float, float]:
        """m, of the template: how far the eyes stand from the middle, their height, and that of the mouth. Of a body
        file that does not say, as SMPL's does not, estimated from the head's joint."""
        if self.face_landmarks is None:
            head = float(self.joints[JOINT_INDEX["head"], 1])
            return 0.031, head + 0.085, head + 0.027
        eye_x, eye_y, mouth_y = map(float, self.face_landmarks)
        return eye_x, eye_y, mouth_y

    @cached_property
    def parts(self) -> NDArray[np.int32]:
        """[V] the joint that moves each vertex most; colours in `PART_PALETTE`."""
        return self.weights.argmax(1).astype(np.int32)

    def content_sha(self) -> str:
        """12 hex digits that change when any array of this body changes; goes into run identities."""
        return self._content_sha

    @cached_property
    def _content_sha(self) -> str:
        digest = hashlib.sha256()
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                digest.update(f"{field.name} {value.dtype} {value.shape}\n".encode())
                digest.update(np.ascontiguousarray(value).tobytes())
        return digest.hexdigest()[:12]
