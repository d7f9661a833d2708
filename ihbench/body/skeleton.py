"""The 24-joint SMPL skeleton: names, parents, and one fixed colour per joint for part maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

JOINT_NAMES: tuple[str, ...] = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hand",
    "right_hand",
)

PARENTS: tuple[int, ...] = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21)

JOINT_INDEX: dict[str, int] = {name: index for index, name in enumerate(JOINT_NAMES)}

# [24, 3] RGB, one per joint, at least 37 apart in CIELAB and never grey: the colours of every part map. Fixed for
# good: models trained on part maps depend on them.
PART_PALETTE: NDArray[np.uint8] = np.array(
    [
        (102, 102, 153),
        (0, 255, 0),
        (255, 0, 0),
        (0, 0, 255),
        (255, 204, 0),
        (153, 255, 204),
        (255, 0, 204),
        (102, 51, 0),
        (0, 102, 0),
        (255, 153, 153),
        (0, 102, 255),
        (0, 204, 255),
        (255, 0, 102),
        (204, 255, 102),
        (153, 153, 102),
        (153, 0, 102),
        (255, 153, 255),
        (0, 102, 102),
        (102, 0, 153),
        (204, 102, 0),
        (0, 204, 102),
        (204, 0, 255),
        (204, 204, 255),
        (0, 153, 255),
    ],
    dtype=np.uint8,
)
PART_PALETTE.setflags(write=False)
