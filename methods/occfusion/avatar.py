"""OccFusion's avatar: `ihbench.fit.big_pose.avatar`, and its look in the big pose, without networks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera
from ihbench.fit.big_pose.avatar import BigPoseAvatar
from ihbench.fit.gaussians.skinned_covariance import skinned_covariance
from ihbench.methods.occfusion.config import OccFusionConfig
from ihbench.render.splat import render_gaussians

SIDES = 18  # azimuths of the big pose, 20° apart; 0 looks at the front
IMAGE, FOCAL, DISTANCE = 512, 1000.0, 4.5  # px, px, m


class OccFusionAvatar(BigPoseAvatar[OccFusionConfig]):
    kind, config_class = "occfusion", OccFusionConfig

    def draw_big_pose(self, camera: Camera, background: Sequence[float]) -> tuple[Tensor, Tensor]:
        """rgb [H, W, 3] and alpha [H, W] of the Gaussians as they are, centred by the mean of their centres (through
        which the gradient goes, so that none moves them all)."""
        own = self.gaussians
        return render_gaussians(
            own.means - own.means.mean(0),
            skinned_covariance(own.scales, own.quaternions),
            self.sh,
            camera,
            background,
            opacities=own.opacities,
            sh_degree=self.degree,
            preset="3dgs",
        )


def big_pose_camera(side: int, size: int) -> Camera:
    """The released camera on a body at the origin, y up, from side 0 to 17, in an image of `size` px."""
    angle = 2 * np.pi * side / SIDES
    forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
    down = np.array([0.0, -1.0, 0.0])
    R: NDArray[np.float64] = np.stack([np.cross(down, forward), down, forward])
    half = IMAGE / 2
    K = np.array([[FOCAL, 0, half], [0, FOCAL, half], [0, 0, 1]])
    return Camera(K, R, np.array([0.0, 0.0, DISTANCE]), IMAGE, IMAGE).scaled(size, size)
