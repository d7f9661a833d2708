"""A motion as AMASS keeps it: SMPL-H's 52 joints, z up, for Blender's SMPL add-ons and motion models."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.show.motion import Motion, Stand, placed

JOINTS, SHARED = 52, 22  # of SMPL-H, and of these those that SMPL has too; the others are fingers
SHAPE = 16  # coefficients that AMASS has
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # columns: to the left, up, forwards


def amass_arrays(
    motion: Motion,
    body: Body,
    betas: NDArray[np.float64],  # [B]
    upright: bool = True,  # False: in the world that the motion is in
    note: str = "",
) -> dict[str, NDArray]:
    """Arrays of an .npz. SMPL's two hand joints have no counterpart and are left out. The shape of a body that is not
    SMPL's is not SMPL's shape: `betas` are zeros then."""
    if upright:
        moved = placed(motion, body, betas, Stand(Z_UP, np.zeros(3)))
        some = moved.body_poses(betas)[:: max(1, len(moved) // 100)]
        floor = min(body.pose(p)[:, 2].min() for p in some)
        motion = Motion(moved.pose, moved.transl - (0, 0, floor), moved.fps, moved.cyclic)
    poses = np.zeros((len(motion), JOINTS, 3))
    poses[:, :SHARED] = motion.pose[:, :SHARED]
    shape = np.zeros(SHAPE)
    if body.name == "smpl":
        shape[: min(SHAPE, len(betas))] = betas[:SHAPE]
    return {
        "poses": poses.reshape(len(motion), -1),
        "trans": motion.transl.copy(),
        "betas": shape,
        "dmpls": np.zeros((len(motion), 8)),
        "gender": np.array("neutral"),
        "mocap_framerate": np.array(motion.fps),
        "note": np.array(note),
    }
