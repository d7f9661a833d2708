"""Build the procedural body: the bench's own SMPL-shaped person, free of anybody's licence.

    python -m ihbench.body.procedural OUT.npz

writes what ships as `procedural_body.npz`. Building it takes scikit-image, which reading the file
does not. Same vertex layout every time: nothing here is random.

Surface: `procedural_surface.py`. Skinning weights follow from where a vertex lies between the joints. Shape
coefficients lengthen bones and widen limbs, linearly by construction. The joint regressor is fitted so that joints
follow the shape coefficients.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body.atlas import part_atlas
from ihbench.body.procedural_surface import build_mesh
from ihbench.body.skeleton import JOINT_INDEX, JOINT_NAMES, PARENTS
from ihbench.files.npz import write_npz

Array = NDArray[np.float64]

# m, on the left half; right joints are their mirror images
LEFT_AND_CENTRE_JOINTS = {
    "pelvis": (0, 0, 0),
    "spine1": (0, 0.10, -0.015),
    "spine2": (0, 0.205, -0.01),
    "spine3": (0, 0.285, -0.005),
    "neck": (0, 0.505, -0.02),
    "head": (0, 0.60, 0.005),
    "left_hip": (0.092, -0.075, 0),
    "left_knee": (0.105, -0.47, 0.005),
    "left_ankle": (0.11, -0.87, -0.03),
    "left_foot": (0.12, -0.925, 0.085),
    "left_collar": (0.06, 0.43, -0.01),
    "left_shoulder": (0.180, 0.428, -0.015),
    "left_elbow": (0.445, 0.435, -0.025),
    "left_wrist": (0.695, 0.435, -0.01),
    "left_hand": (0.775, 0.432, -0.005),
}
MIRRORED_JOINT = tuple(
    JOINT_INDEX[name.replace("left_", "right_") if name.startswith("left_") else name.replace("right_", "left_")]
    for name in JOINT_NAMES
)
FACE_LANDMARKS = (0.031, 0.685, 0.627)  # m: eye |x|, eye y, mouth y
LENGTH_STEP = 2.0**-16  # m, 15 micrometres: what lengths are rounded to in the file


def rest_joints() -> Array:
    """[24, 3] m."""
    joints = np.zeros((24, 3))
    for name, position in LEFT_AND_CENTRE_JOINTS.items():
        k = JOINT_INDEX[name]
        joints[k] = position
        joints[MIRRORED_JOINT[k]] = np.multiply(position, (-1, 1, 1)) if name.startswith("left_") else position
    return joints


def ramp(x: Array, start: float, end: float) -> Array:
    """0 before `start`, 1 after `end` (either may be the larger), smooth in between."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)


def chain(joints: tuple[str, ...], passed: tuple[Array, ...]) -> Array:
    """[N, 24] weights along a chain of joints: `passed[k]` [N] says how far a point is past joint k + 1."""
    out = np.zeros((len(passed[0]), 24))
    remaining = np.ones(len(passed[0]))
    for name, beyond in zip(joints, passed, strict=False):
        out[:, JOINT_INDEX[name]] += remaining * (1 - beyond)
        remaining = remaining * beyond
    out[:, JOINT_INDEX[joints[-1]]] += remaining
    return out


def blend(base: Array, over: Array, amount: Array) -> Array:
    return base * (1 - amount[:, None]) + over * amount[:, None]


def skinning_weights(vertices: Array) -> Array:
    """[V, 24] weights of points on the surface; a point and its mirror image have mirrored weights."""
    weights = _one_sided_weights(vertices)
    mirrored = _one_sided_weights(vertices * [-1, 1, 1])[:, MIRRORED_JOINT]
    return (weights + mirrored) / 2


def _one_sided_weights(vertices: Array) -> Array:
    height = dict(zip(JOINT_NAMES, rest_joints()[:, 1], strict=True))
    x, y, z = vertices.T
    spine = chain(
        ("pelvis", "spine1", "spine2", "spine3"),
        (
            ramp(y, height["spine1"] - 0.07, height["spine1"] + 0.05),
            ramp(y, height["spine2"] - 0.05, height["spine2"] + 0.05),
            ramp(y, height["spine3"] - 0.05, height["spine3"] + 0.05),
        ),
    )
    neck = chain(
        ("spine3", "neck", "head"),
        (
            ramp(y, height["neck"] - 0.05, height["neck"] + 0.025),
            ramp(y, height["head"] - 0.035, height["head"] + 0.03),
        ),
    )
    out = blend(spine, neck, ramp(y, 0.44, 0.50) * ramp(np.abs(x), 0.13, 0.05))
    below_head = 1 - ramp(y, 0.50, 0.54)
    for side, sign in (("left", 1), ("right", -1)):
        outward = x * sign
        this_side = outward > 0
        collar = chain((f"{side}_collar",), (np.zeros_like(x),))
        arm = chain(
            (f"{side}_shoulder", f"{side}_elbow", f"{side}_wrist", f"{side}_hand"),
            (ramp(outward, 0.39, 0.50), ramp(outward, 0.66, 0.725), ramp(outward, 0.755, 0.795)),
        )
        # the upper arm takes over across a slanted plane through the shoulder; neither the flank nor the head follows
        on_collar = ramp(outward, 0.03, 0.13) * ramp(y, 0.27, 0.42) * below_head
        on_arm = ramp(outward + 0.35 * (y - 0.435), 0.105, 0.235) * ramp(y, 0.27, 0.36) * below_head
        out = blend(out, collar, on_collar * this_side)
        out = blend(out, arm, on_arm * this_side)
        leg = chain(
            (f"{side}_hip", f"{side}_knee", f"{side}_ankle", f"{side}_foot"),
            (
                ramp(height[f"{side}_knee"] - y, -0.065, 0.065),
                ramp(height[f"{side}_ankle"] - y, -0.045, 0.03),
                ramp(z, 0.045, 0.10) * ramp(-y, 0.88, 0.90),
            ),
        )
        # the hip plane runs from the crotch up to the iliac crest
        below_hip = height[f"{side}_hip"] - y + 0.55 * (outward - 0.092)
        out = blend(out, leg, ramp(below_hip, -0.075, 0.085) * ramp(outward, -0.012, 0.03))
    return out / out.sum(1, keepdims=True)


@dataclass(frozen=True)
class ShapeDirection:
    """What one unit of a shape coefficient does: fractions by which bones get longer and limbs wider."""

    name: str
    longer: tuple[str, ...] = ()  # joints whose bone to their parent is lengthened
    length: float = 0.0
    wider: tuple[str, ...] = ()  # joints whose skin is scaled about the bone
    girth: float = 0.0
    all_round: bool = False  # scale along the bone as well


def both(*names: str) -> tuple[str, ...]:
    return tuple(f"{side}_{name}" for name in names for side in ("left", "right"))


SPINE = ("spine1", "spine2", "spine3", "neck", "head")
SHAPE_DIRECTIONS = (
    ShapeDirection("stature", JOINT_NAMES, 0.05, JOINT_NAMES, 0.05, all_round=True),
    ShapeDirection(
        "weight",
        wider=("pelvis", "spine1", "spine2", "spine3", "neck", *both("hip", "knee", "shoulder", "elbow")),
        girth=0.09,
    ),
    ShapeDirection("leg length", both("knee", "ankle"), 0.06),
    ShapeDirection("arm length", both("elbow", "wrist", "hand"), 0.06),
    ShapeDirection("torso length", (*SPINE, *both("collar")), 0.06),
    ShapeDirection("shoulder width", both("shoulder", "collar"), 0.10, ("spine3",), 0.06),
    ShapeDirection("hip width", both("hip"), 0.12, ("pelvis", *both("hip")), 0.10),
    ShapeDirection("belly", wider=("spine1", "spine2"), girth=0.14),
    ShapeDirection("arm girth", wider=both("shoulder", "elbow"), girth=0.14),
    ShapeDirection("head size", wider=("head",), girth=0.06, all_round=True),
)
# the joint at the far end of each bone that has skin along it
NEXT_JOINT = {
    JOINT_INDEX[near]: JOINT_INDEX[far]
    for near, far in (
        *zip(("pelvis", *SPINE), SPINE, strict=False),
        *zip(both("hip", "knee", "ankle"), both("knee", "ankle", "foot"), strict=True),
        *zip(both("collar", "shoulder", "elbow", "wrist"), both("shoulder", "elbow", "wrist", "hand"), strict=True),
    )
}
SIDEWAYS_BONES = {JOINT_INDEX[name] for name in both("collar", "shoulder", "elbow", "wrist", "hand")}


def shape_displacements(vertices: Array, weights: Array, direction: ShapeDirection) -> tuple[Array, Array]:
    """What one unit of a direction adds to the vertices [V, 3] m and the joints [24, 3] m."""
    J = rest_joints()
    stretch = np.array([direction.length * (name in direction.longer) for name in JOINT_NAMES])
    girth = np.array([direction.girth * (name in direction.wider) for name in JOINT_NAMES])
    joint_moves = np.zeros((24, 3))
    for k in range(1, 24):
        joint_moves[k] = joint_moves[PARENTS[k]] + (J[k] - J[PARENTS[k]]) * stretch[k]
    moves = np.zeros_like(vertices)
    for k in range(24):
        from_joint = vertices - J[k]
        across = np.ones(3)
        if not direction.all_round:
            across[0 if k in SIDEWAYS_BONES else 1] = 0
        move = joint_moves[k] + from_joint * girth[k] * across
        if k in NEXT_JOINT and not direction.all_round:  # the skin of a bone stretches evenly along it
            bone = J[NEXT_JOINT[k]] - J[k]
            along = np.clip(from_joint @ bone / (bone @ bone), 0, 1)
            move = move + stretch[NEXT_JOINT[k]] * along[:, None] * bone
        moves += weights[:, [k]] * move
    return moves, joint_moves


def joint_regressor(vertices: Array, weights: Array, shapedirs: Array, joint_dirs: Array, mirror: NDArray) -> Array:
    """[24, V] non-negative rows that sum to 1: the joints as means of nearby vertices, at rest and along every shape
    direction (non-negative least squares over the 250 nearest vertices)."""
    from scipy.optimize import nnls

    J = rest_joints()
    regressor = np.zeros((24, len(vertices)))
    for k, name in enumerate(JOINT_NAMES):
        if name.startswith("right_"):
            continue
        own = weights[:, k] + (weights[:, PARENTS[k]] if k else 0)
        near = np.argsort(np.linalg.norm(vertices - J[k], axis=1) + np.where(own > 0.05, 0, 0.3), kind="stable")[:250]
        directions = shapedirs[near].transpose(2, 1, 0).reshape(-1, len(near))
        A = np.concatenate([vertices[near].T, directions, np.full((1, len(near)), 10.0)])  # the sum counts tenfold
        b = np.concatenate([J[k], joint_dirs[k].T.ravel(), [10.0]])
        row, _ = nnls(A, b, maxiter=20000)
        regressor[k, near] = row / row.sum()
        mirrored = regressor[k, mirror]
        if name.startswith("left_"):
            regressor[MIRRORED_JOINT[k]] = mirrored
        else:
            regressor[k] = (regressor[k] + mirrored) / 2
    return regressor


def rounded(lengths: Array) -> Array:
    """Lengths on a grid that float32 holds exactly and that compresses well."""
    return np.round(lengths / LENGTH_STEP) * LENGTH_STEP


def build_body(coarseness: float = 1.0) -> dict[str, NDArray]:
    """The arrays of the body file, in their storage types (half precision for weights and shapes)."""
    vertices, faces, mirror = build_mesh(coarseness)
    vertices = rounded(vertices)
    weights = skinning_weights(vertices).astype(np.float16)
    exact_weights = weights.astype(np.float64)
    exact_weights /= exact_weights.sum(1, keepdims=True)
    moves = [shape_displacements(vertices, exact_weights, direction) for direction in SHAPE_DIRECTIONS]
    shapedirs = rounded(np.stack([vertex_moves for vertex_moves, _ in moves], -1)).astype(np.float16)
    joint_dirs = np.stack([joint_moves for _, joint_moves in moves], -1)
    regressor = joint_regressor(vertices, exact_weights, shapedirs.astype(np.float64), joint_dirs, mirror)
    uv, uv_faces, _ = part_atlas(vertices, faces, exact_weights, regressor @ vertices)
    return {
        "v_template": vertices.astype(np.float32),
        "shapedirs": shapedirs,
        "weights": weights,
        "J_regressor": regressor.astype(np.float32),
        "kintree_table": np.array([PARENTS, range(24)], np.int32),
        "f": faces.astype(np.uint16),
        "vt": rounded(uv).astype(np.float32),
        "ft": uv_faces.astype(np.uint16),
        "face_landmarks": np.array(FACE_LANDMARKS, np.float32),
        "name": np.array("procedural"),
    }


def main(arguments: list[str]) -> int:
    if len(arguments) != 1 or not arguments[0].endswith(".npz"):
        print("usage: python -m ihbench.body.procedural OUT.npz", file=sys.stderr)
        return 2
    out = Path(arguments[0])
    arrays = build_body()
    write_npz(out, arrays, compressed=True)
    V, F = len(arrays["v_template"]), len(arrays["f"])
    print(f"{out}: {V} vertices, {F} faces, Euler characteristic {V - F // 2}, {out.stat().st_size / 1e6:.3f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
