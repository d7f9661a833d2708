"""One frame's pose and shape of a SMPL body, as everything here takes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadValue

OTHER_POSE = "; ihbench.body.pose_estimators takes what pose estimators write"
MOST_RADIANS = 8 * np.pi  # of one number of a pose: fits may count whole turns, but nobody's count four


@dataclass(frozen=True)
class BodyPose:
    """SMPL parameters of one frame, standard root convention: rotate about joint 0, then translate."""

    pose: NDArray[np.float64]  # [24, 3] rad, axis-angle, root first
    betas: NDArray[np.float64]  # [B] shape coefficients
    transl: NDArray[np.float64]  # [3] m

    def __post_init__(self) -> None:
        """Raises `BadValue` for other shapes, and for angles that can only be degrees."""
        for name in ("pose", "betas", "transl"):
            value: Any = getattr(self, name)
            value = np.array(value.detach().cpu().double().numpy() if hasattr(value, "detach") else value, np.float64)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.pose.shape != (24, 3) or self.betas.ndim != 1 or self.transl.shape != (3,):
            words = {
                (24, 3, 3): "; body.pose_estimators.matrix_to_axis_angle turns rotation matrices into axis-angle",
                (24, 4): "; turn quaternions into axis-angle",
                (72,): "; pose.reshape(24, 3)",
            }
            word = words.get(self.pose.shape, OTHER_POSE)
            raise BadValue(
                f"body pose: expected pose [24, 3], betas [B], transl [3], "
                f"got {self.pose.shape}, {self.betas.shape}, {self.transl.shape}{word}"
            )
        if (np.abs(self.pose) > MOST_RADIANS).any():
            raise BadValue(
                f"body pose: expected axis-angle in radians, got angles up to {np.nanmax(np.abs(self.pose)):.4g}; "
                f"turn degrees into radians with np.deg2rad"
            )
