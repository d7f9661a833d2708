"""The 24-joint SMPL skeleton: names, parents, and one fixed colour per joint for part maps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

JOINT_NAMES: tuple[str, ...] = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle",
    "spine3", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip

PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

JOINT_INDEX: dict[str, int] = {name: index for index, name in enumerate(JOINT_NAMES)}

# [24, 3] RGB, one per joint, at least 37 apart in CIELAB and never grey: the colours of every part map. Fixed for
# good: models trained on part maps depend on them.
PART_PALETTE: NDArray[np.uint8] = np.array(
    [
        (102, 102, 153), (0, 255, 0), (255, 0, 0), (0, 0, 255), (255, 204, 0), (153, 255, 204),
        (255, 0, 204), (102, 51, 0), (0, 102, 0), (255, 153, 153), (0, 102, 255), (0, 204, 255),
        (255, 0, 102), (204, 255, 102), (153, 153, 102), (153, 0, 102), (255, 153, 255), (0, 102, 102),
        (102, 0, 153), (204, 102, 0), (0, 204, 102), (204, 0, 255), (204, 204, 255), (0, 153, 255),
    ],
    dtype=np.uint8,
)  # fmt: skip
PART_PALETTE.setflags(write=False)


SMPLX_SIZES = {  # numbers of a pose whose first 22 joints are SMPL's -> whose it is
    66: "SMPL-X or SMPL-H without hands, as GVHMR writes them",
    78: "EasyMocap's SMPL-H",
    87: "EasyMocap's SMPL-X",
    156: "SMPL-H",
    159: "SMPL-X without its eyes",
    165: "SMPL-X",
}


def pose_hint(given: tuple[int, ...]) -> str:
    """What a pose of another shape than [72] or [24, 3] probably is, and what to take of it: the end of a message."""
    shape, size = tuple(n for n in given if n != 1), math.prod(given)
    numbers = shape[-2] * 3 if len(shape) > 1 and shape[-1] == 3 else (shape or (1,))[-1]
    if shape[-2:] == (3, 3):
        return (
            "; convert 24 rotations, root first, with matrix_to_axis_angle (concatenate global_orient and body_pose)"
        )
    if shape[-1:] == (6,):
        return "; 6D rotations are turned by six_d_to_matrix and matrix_to_axis_angle"
    if shape[-1:] == (4,):
        return "; quaternions are turned into axis-angle first"
    if numbers == 72:
        return f"; give one row a call: these are {size // 72} frames or persons"
    if numbers == 69:
        return "; 69 are SMPL's 23 joints without the root: put global_orient in front"
    if numbers in (63, 153, 162):
        body = {63: "the body of SMPL-X", 153: "SMPL-H", 162: "SMPL-X"}[numbers]
        return f"; {numbers} are {body} without the root: put global_orient in front, then see from_smplx"
    if numbers in SMPLX_SIZES:
        return f"; {numbers} are {SMPLX_SIZES[numbers]}: from_smplx takes the 22 joints that SMPL shares"
    if size in (216, 144, 96):
        kind = {216: "rotation matrices", 144: "6D rotations", 96: "quaternions"}[size]
        return f"; {size} may be 24 {kind}: reshape and convert them"
    return ""
