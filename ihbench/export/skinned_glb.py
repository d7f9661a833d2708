"""The body with an avatar's texture as a skinned glTF mesh: 24 joints with SMPL's names, a clip for each motion.

The mesh is the shaped T-pose, shape coefficients baked in; joints turn about their own axes, which are the world's in
the T-pose. SMPL's pose blend shapes are not in it: they are no linear blend skinning. y up, metres, the feet of the
pose that it stands in at y = 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.skeleton import JOINT_NAMES
from ihbench.export.glb import INDICES, VERTICES, Glb
from ihbench.files.pictures import encoded
from ihbench.render.zbuffer import vertex_normals
from ihbench.show.motion import Motion, Stand, placed

Array = NDArray[np.float64]

MOST_WEIGHTS = 4  # joints that move one vertex, in every engine
TRIANGLES, CLAMP, LINEAR, MIPMAPPED = 4, 33071, 9729, 9987


@dataclass(frozen=True)
class SkinnedMesh:
    """One row a corner: a vertex stands there once for each place of the texture that it has."""

    vertex: NDArray[np.int64]  # [C] of the body
    uv: NDArray[np.float32]  # [C, 2] v down
    triangles: NDArray[np.uint32]  # [F, 3] of corners
    joints: NDArray[np.uint8]  # [V, 4]
    weights: NDArray[np.float32]  # [V, 4] rows sum to 1

    @classmethod
    def of(cls, body: Body) -> SkinnedMesh:
        pairs = np.stack([body.faces.reshape(-1), body.uv_faces.reshape(-1)], 1)
        corners, inverse = np.unique(pairs, axis=0, return_inverse=True)
        uv = body.uv[corners[:, 1]] * (1, -1) + (0, 1)  # glTF counts from the upper left
        triangles = inverse.reshape(-1, 3).astype(np.uint32)
        joints, weights = four_weights(body.weights)
        return cls(corners[:, 0].astype(np.int64), uv.astype(np.float32), triangles, joints, weights)


def four_weights(
    weights: Array,  # [V, 24]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Joints [V, 4] and weights [V, 4] of the four that move a vertex most, largest first; they sum to 1. Joints
    without weight are joint 0."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, :MOST_WEIGHTS]
    kept = np.take_along_axis(weights, order, 1)
    kept = (kept / kept.sum(1, keepdims=True)).astype(np.float32)
    kept[:, 0] += 1 - kept.sum(1, dtype=np.float64).astype(np.float32)
    return np.where(kept > 0, order, 0).astype(np.uint8), kept


def standing(motion: Motion, body: Body, betas: Array, relief: Array | None = None) -> Motion:
    """A motion of any world in glTF's: y up, the first frame facing +z with its pelvis over the origin; the lowest
    point of all frames on the floor. `relief` [V, 3] m lies on the shaped T-pose."""
    moved = placed(motion, body, betas, Stand(np.eye(3), np.zeros(3)))
    some = moved.body_poses(betas)[:: max(1, len(moved) // 100)]
    floor = min(body.pose(p, blend_shapes=False, offsets=relief)[:, 1].min() for p in some)
    return Motion(moved.pose, moved.transl - (0, floor, 0), moved.fps, moved.cyclic)


def skinned_glb(
    glb: Glb,
    body: Body,
    betas: Array,  # [B]
    still: Motion,  # one frame: what is seen without a clip
    clips: Mapping[str, Motion],  # as `standing` has them
    texture: NDArray[np.uint8],  # [R, R, 3] sRGB, row 0 at the top
    relief: Array | None,  # [V, 3] m, on the shaped T-pose
    extras: Mapping[str, Any],
) -> bytes:
    """The file."""
    mesh = SkinnedMesh.of(body)
    vertices, joints = body.shaped(betas)
    vertices = vertices if relief is None else vertices + relief
    normals = vertex_normals(vertices, body.faces)
    normals[~normals.any(1)] = (0, 1, 0)
    attributes = {
        "POSITION": glb.accessor(vertices[mesh.vertex].astype(np.float32), VERTICES, bounds=True),
        "NORMAL": glb.accessor(normals[mesh.vertex].astype(np.float32), VERTICES),
        "TEXCOORD_0": glb.accessor(mesh.uv, VERTICES),
        "JOINTS_0": glb.accessor(mesh.joints[mesh.vertex], VERTICES),
        "WEIGHTS_0": glb.accessor(mesh.weights[mesh.vertex], VERTICES),
    }
    indices = glb.accessor(mesh.triangles.reshape(-1), INDICES)
    material = _material(glb, texture)
    primitive = {"attributes": attributes, "indices": indices, "mode": TRIANGLES, "material": material}
    shape = glb.add("meshes", {"name": "avatar", "primitives": [primitive]})
    first = _skeleton(glb, body, joints, still)
    nodes = list(range(first, first + len(joints)))
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    inverse[:, :3, 3] = -joints
    # matrices column by column
    bind = glb.accessor(inverse.transpose(0, 2, 1).reshape(-1, 16))
    skin = glb.add("skins", {"joints": nodes, "skeleton": first, "inverseBindMatrices": bind})
    avatar = glb.add("nodes", {"name": "avatar", "mesh": shape, "skin": skin, "extras": dict(extras)})
    for name, motion in clips.items():
        _clip(glb, name, motion, joints, first)
    glb.document |= {"scene": glb.add("scenes", {"nodes": [avatar, first]})}
    return glb.data()


def _material(glb: Glb, texture: NDArray[np.uint8]) -> int:
    """The colours as they are: light is in them already."""
    glb.use("KHR_materials_unlit")
    wrap = {"magFilter": LINEAR, "minFilter": MIPMAPPED, "wrapS": CLAMP, "wrapT": CLAMP}
    sampler = glb.add("samplers", wrap)
    image = glb.picture(encoded(texture, "PNG", compress_level=9))
    number = glb.add("textures", {"sampler": sampler, "source": image})
    surface = {"baseColorTexture": {"index": number}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    words = {"name": "avatar", "pbrMetallicRoughness": surface, "extensions": {"KHR_materials_unlit": {}}}
    return glb.add("materials", words)


def _skeleton(glb: Glb, body: Body, joints: Array, still: Motion) -> int:
    """The joints as nodes, in SMPL's order; the number of the first."""
    first = len(glb.document.get("nodes", []))
    rotations = quaternions(still.pose)[0]
    for k, parent in enumerate(body.parents):
        place = joints[k] + still.transl[0] if parent < 0 else joints[k] - joints[parent]
        node: dict[str, Any] = {
            "name": JOINT_NAMES[k],
            "translation": place.astype(np.float32).tolist(),
            "rotation": rotations[k].tolist(),
            "extras": {"smpl_joint": k},
        }
        children = [first + int(c) for c in np.flatnonzero(body.parents == k)]
        glb.add("nodes", node | ({"children": children} if children else {}))
    return first


def _clip(glb: Glb, name: str, motion: Motion, joints: Array, first: int) -> None:
    """One animation: turns of all joints, the pelvis's path. A cyclic motion ends with its first frame."""
    pose, transl = motion.pose, motion.transl
    if motion.cyclic:
        pose, transl = np.concatenate([pose, pose[:1]]), np.concatenate([transl, transl[:1]])
    times = glb.accessor((np.arange(len(pose)) / motion.fps).astype(np.float32), bounds=True)
    turns = quaternions(pose)
    channels, samplers = [], []
    paths = [(k, "rotation", turns[:, k]) for k in range(turns.shape[1])]
    paths.append((0, "translation", (joints[0] + transl).astype(np.float32)))
    for joint, path, values in paths:
        samplers.append({"input": times, "output": glb.accessor(values), "interpolation": "LINEAR"})
        channels.append({"sampler": len(samplers) - 1, "target": {"node": first + joint, "path": path}})
    glb.add("animations", {"name": name, "channels": channels, "samplers": samplers})


def quaternions(
    pose: Array,  # [T, 24, 3] rad
) -> NDArray[np.float32]:
    """[T, 24, 4] x y z w, unit, each on the same side as the one before it, so that straight lines between them are
    short."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(np.array(pose).reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)
    flips = np.sign((turns[1:] * turns[:-1]).sum(-1))
    signs = np.concatenate([np.ones((1, pose.shape[1])), np.cumprod(np.where(flips < 0, -1, 1), 0)])
    return (turns * signs[..., None]).astype(np.float32)
