"""Canonical poses that avatar methods define their body in. None of them moves or turns the root.

Signs: SMPL's T-pose looks along +z with the left hand at +x, so a positive turn of the left hip about z spreads the
legs, and a negative turn of the left shoulder about z lowers the arm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.body.skeleton import JOINT_INDEX
from ihbench.errors import BadInput
from ihbench.registry import nearest

# name -> degrees about z per joint; every other component is 0
CANONICAL_POSES: dict[str, dict[str, float]] = {
    # HumanNeRF, OccNeRF
    "t_pose": {},
    # InpaintHuman says "A-pose" and no more: GaussianAvatar's legs with the arms lowered by 45 degrees
    "a_pose": {"left_hip": 30, "right_hip": -30, "left_shoulder": -45, "right_shoulder": 45},
    # GaussianAvatar (arguments/__init__.py; it also lifts the body by 0.30 m) and GTU (gtu/smpl_deformer)
    "gaussianavatar": {"left_hip": 30, "right_hip": -30},
    # GauHuman and OccFusion (scene/dataset_readers.py)
    "big_pose": {"left_hip": 45, "right_hip": -45, "left_ankle": -30, "right_ankle": 30},
    # 3DGS-Avatar (utils/dataset_utils.py, "02v"): each leg chain turned rigidly
    "vitruvian": {"left_hip": 45, "right_hip": -45},
}


def canonical_pose(name: str) -> NDArray[np.float64]:
    """[24, 3] rad, the named canonical pose. Raises `BadInput` on an unknown name."""
    if name not in CANONICAL_POSES:
        raise BadInput(f"unknown canonical pose {name!r}: {nearest(name, list(CANONICAL_POSES))}")
    pose = np.zeros((24, 3))
    for joint, degrees in CANONICAL_POSES[name].items():
        pose[JOINT_INDEX[joint], 2] = np.deg2rad(degrees)
    return pose
