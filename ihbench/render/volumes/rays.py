"""Rays through pixels. A ray's parameter t is the depth in the camera: directions have z = 1 there, not length 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rays:
    """Points of ray n: origins[n] + t directions[n]."""

    origins: Tensor  # [N, 3] m
    directions: Tensor  # [N, 3], the depth in the camera grows by 1 m along one of them

    def __len__(self) -> int:
        return len(self.origins)

    def __getitem__(self, chosen: Tensor | slice) -> Rays:
        """Some of the rays, by index or mask."""
        return Rays(self.origins[chosen], self.directions[chosen])

    @property
    def lengths(self) -> Tensor:
        """[N] m along the ray for each metre of depth."""
        return self.directions.norm(dim=1)

    def points(self, depths: Tensor) -> Tensor:  # [N, S]
        """[N, S, 3] m."""
        return self.origins[:, None] + depths[..., None] * self.directions[:, None]


def pixel_rays(
    camera: Camera,
    rows: NDArray[np.integer],  # [N]
    columns: NDArray[np.integer],  # [N]
    frame: tuple[Array, Array]
    | None = None,  # R [3, 3], t [3] m: points p of the world are R p + t in the rays' frame
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
) -> Rays:
    """Rays through the centres (+0.5) of pixels, in the world or another frame. Computed in float64, then rounded.

    Raises `ValueError` for a camera with lens distortion: undistort the image and use `camera.undistorted()`.
    """
    if camera.distortion is not None:
        raise ValueError("rays: expected no lens distortion; undistort the image and use camera.undistorted()")
    v = (rows + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    u = (columns + 0.5 - camera.K[0, 2] - camera.K[0, 1] * v) / camera.K[0, 0]
    directions = np.stack([u, v, np.ones_like(u)], 1) @ camera.R  # [N, 3] world
    origin = camera.center
    if frame is not None:
        R, t = frame
        directions, origin = directions @ R.T, R @ origin + t
    origins = np.broadcast_to(origin, directions.shape)
    return Rays(*(torch.from_numpy(np.array(each)).to(device, dtype) for each in (origins, directions)))
