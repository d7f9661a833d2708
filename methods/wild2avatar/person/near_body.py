"""Where rays of an image pass near the posed body: the first and the last place within `reach` of a vertex.

The rays' shares that the signed distance is evaluated on. Beyond .1 m from the posed body Vid2Avatar takes the
distance for 4 when it renders, so nothing is left out there.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera
from ihbench.render.volumes.rays import Rays, pixel_rays

REACH = 0.1  # m
AT_ONCE = 2_000_000  # pairs of a vertex and a pixel in memory together


def unit_rays(
    camera: Camera,
    pixels: Tensor,  # [N] int64, row-major
    frame: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None,  # see `pixel_rays`
    dtype: torch.dtype = torch.float32,
) -> Rays:
    """Rays through the centres of pixels with directions of length 1: t is the distance from the camera."""
    rows, columns = np.divmod(pixels.cpu().numpy(), camera.width)
    rays = pixel_rays(camera, rows, columns, frame, torch.float64, pixels.device)
    directions = rays.directions / rays.lengths[:, None]
    return Rays(rays.origins.to(dtype), directions.to(dtype))


def near_body(
    camera: Camera,
    vertices: NDArray[np.float64],  # [V, 3] m, posed, world
    device: torch.device | str = "cpu",
    reach: float = REACH,
) -> tuple[Tensor, Tensor]:
    """[H·W] m each: where each pixel's ray comes near the body and where it leaves it; infinity and -infinity for
    rays that never do. Vertices behind the camera, or nearer to its plane than `reach`, count for no ray."""
    seen = camera.to_camera(vertices)
    seen = np.ascontiguousarray(seen[seen[:, 2] > 1.01 * reach])
    kernel = _numba_kernel() if torch.device(device).type == "cpu" else None
    if kernel is None:
        return near_body_plain(camera, torch.from_numpy(seen).to(device), reach)
    near, far = kernel(seen, camera.K, np.linalg.inv(camera.K), camera.height, camera.width, reach)
    return torch.from_numpy(near), torch.from_numpy(far)


def near_body_plain(
    camera: Camera,
    seen: Tensor,  # [V, 3] m, vertices before the camera, in its frame, float64
    reach: float,
) -> tuple[Tensor, Tensor]:
    """`near_body` in plain torch, on the vertices' device."""
    height, width = camera.height, camera.width
    near = torch.full((height * width,), torch.inf, device=seen.device)
    far = torch.full((height * width,), -torch.inf, device=seen.device)
    if not len(seen):
        return near, far
    K = torch.from_numpy(np.array(camera.K)).to(seen)
    places = seen @ K.T
    columns, rows = places[:, 0] / places[:, 2], places[:, 1] / places[:, 2]
    slope = (seen[:, :2].square().sum(1).sqrt() / seen[:, 2]).square()
    half = (max(camera.K[0, 0], camera.K[1, 1]) * reach / (seen[:, 2] - reach) * (1 + slope).sqrt()).ceil() + 1
    half = half.clamp(max=max(height, width))
    every = torch.arange(height * width, device=seen.device)
    rays = unit_rays(camera, every, (camera.R, camera.t), seen.dtype).directions
    order = half.argsort()
    start = 0
    while start < len(order):  # vertices with windows of about one size together
        count = max(1, int(AT_ONCE // (2 * half[order[start]] + 1).square().item()))
        part = order[start : start + count]
        side = int(half[part].max().item())
        steps = torch.arange(-side, side + 1, device=seen.device)
        row = rows[part].floor().long()[:, None, None] + steps[None, :, None]
        column = columns[part].floor().long()[:, None, None] + steps[None, None, :]
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        vertex, y, x = inside.nonzero(as_tuple=True)
        pixel = row[vertex, y, 0] * width + column[vertex, 0, x]
        at = seen[part][vertex]
        along = (rays[pixel] * at).sum(1)
        room = reach**2 - at.square().sum(1) + along.square()
        hit = room >= 0
        pixel, along, half_length = pixel[hit], along[hit], room[hit].sqrt()
        near.scatter_reduce_(0, pixel, (along - half_length).clamp(min=0).float(), "amin")
        far.scatter_reduce_(0, pixel, (along + half_length).float(), "amax")
        start += count
    return near, far


@cache
def _numba_kernel():
    try:
        from numba import njit
    except ImportError:
        return None

    @njit(cache=True, nogil=True)
    def near_and_far(seen, K, back, height, width, reach):
        near = np.full(height * width, np.inf, np.float32)
        far = np.full(height * width, -np.inf, np.float32)
        rays = np.empty((height * width, 3))
        for row in range(height):
            for column in range(width):
                x = back[0, 0] * (column + 0.5) + back[0, 1] * (row + 0.5) + back[0, 2]
                y = back[1, 1] * (row + 0.5) + back[1, 2]
                length = np.sqrt(x * x + y * y + 1)
                rays[row * width + column] = x / length, y / length, 1 / length
        for k in range(len(seen)):
            x, y, z = seen[k]
            column, row = (K[0, 0] * x + K[0, 1] * y + K[0, 2] * z) / z, (K[1, 1] * y + K[1, 2] * z) / z
            slope = (x * x + y * y) / (z * z)
            half = np.ceil(max(K[0, 0], K[1, 1]) * reach / (z - reach) * np.sqrt(1 + slope)) + 1
            squared = x * x + y * y + z * z
            for r in range(max(0, int(row - half)), min(height, int(row + half) + 1)):
                for c in range(max(0, int(column - half)), min(width, int(column + half) + 1)):
                    pixel = r * width + c
                    along = rays[pixel, 0] * x + rays[pixel, 1] * y + rays[pixel, 2] * z
                    room = reach * reach - squared + along * along
                    if room >= 0:
                        length = np.sqrt(room)
                        near[pixel] = min(near[pixel], max(along - length, 0.0))
                        far[pixel] = max(far[pixel], along + length)
        return near, far

    return near_and_far
