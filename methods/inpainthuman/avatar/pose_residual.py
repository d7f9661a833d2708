"""Pose-dependent residual features (sec. 3.2): position map of the posed body -> U-Net -> residual feature map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import interpolate

from ihbench.body.pose import BodyPose

if TYPE_CHECKING:
    from ihbench.body import Body


def root_free_position_map(body: Body, body_pose: BodyPose, resolution: int) -> NDArray[np.float32]:
    """[3, R, R] m: the body in this pose with root rotation and translation taken out, zero outside the charts.

    With the root left in (as GaussianAvatar renders it) the encoder would have to learn every place in the room.
    """
    from ihbench.body.uv import position_map

    pose = body_pose.pose.copy()
    pose[0] = 0
    vertices = body.pose(BodyPose(pose, body_pose.betas, np.zeros(3)), blend_shapes=False)
    positions, _ = position_map(vertices, body, resolution)
    return np.ascontiguousarray(positions.transpose(2, 0, 1))


def _block(channels_in: int, channels_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, padding=1),
        nn.GroupNorm(4, channels_out),
        nn.LeakyReLU(0.2),
    )


class ResidualEncoder(nn.Module):
    """A four-level U-Net. Its last layer starts at zero, so switching it on changes nothing at first."""

    def __init__(self, base: int, channels_out: int):
        super().__init__()
        widths = (base, base * 2, base * 4, base * 4)
        self.down = nn.ModuleList(_block(a, b) for a, b in zip((3, *widths[:-1]), widths, strict=True))
        self.up = nn.ModuleList(_block(a + b, b) for a, b in zip(widths[:0:-1], widths[-2::-1], strict=True))
        self.last = nn.Conv2d(base, channels_out, 1)
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)

    def forward(self, positions: Tensor) -> Tensor:  # [3, R, R] m
        """Residual feature map as a table [R², C], row-major."""
        x, skips = positions[None], []
        for k, block in enumerate(self.down):
            x = block(x if k == 0 else torch.nn.functional.avg_pool2d(x, 2))
            skips.append(x)
        for block, skip in zip(self.up, skips[-2::-1], strict=True):
            x = block(torch.cat([interpolate(x, size=skip.shape[-2:], mode="nearest"), skip], 1))
        return self.last(x)[0].flatten(1).T
