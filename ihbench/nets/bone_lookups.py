"""Where a posed point lies in the T-pose: each bone takes it there, says how much it wants it, and they average.

Backward warp of HumanNeRF (core/nets/human_nerf/network.py:205-255): x_i = F_i x, w_i = the trilinear value of bone
i's weights at x_i (0 outside the lattice), f = Σ w_i, x_can = Σ w_i x_i / max(f, 1e-4). f is the likelihood that the
point is of the person at all; where two limbs are close it may exceed 1, since they look at different places.

`located_by_torch` is that with `grid_sample`, on any device and in any float type. On the CPU in float32 kernels do
it, forward and back, and look only where a bone's weights are not negligible: inside the box that holds all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ihbench.render.volumes.rays import Rays

SMALLEST = 1e-4  # of the sum of weights, by which the mean place is divided


@dataclass(frozen=True)
class BoneWeights:
    """Weights of the bones in the T-pose, for a frame."""

    volume: Tensor  # [J or more, D, H, W]; a channel beyond the maps' number (the background) is not looked at
    low: Tensor  # [3] m, corners of the lattice, whose outermost points lie on its faces
    high: Tensor  # [3] m
    maps: Tensor  # [J, 3, 4] from the posed frame to the T-pose
    _boxes: dict[float, Tensor] = field(default_factory=dict, repr=False, compare=False)  # found so far, by `least`

    def boxes(self, least: float = 0.0) -> Tensor:
        """[J, 2, 3] lattice coordinates x, y, z: the box outside which each bone's trilinear weight is at most
        `least`; of a bone without any larger one it is empty. Found once: a picture asks for them many times."""
        if least not in self._boxes:
            self._boxes[least] = self._found_boxes(least)
        return self._boxes[least]

    def _found_boxes(self, least: float) -> Tensor:
        volume = self.volume.detach()[: len(self.maps)]
        ends = []
        for axis in (3, 2, 1):  # x, y, z
            others = tuple(k for k in (1, 2, 3) if k != axis)
            filled = volume.amax(others) > least  # [J, side]
            number = torch.arange(filled.shape[1], device=filled.device).expand_as(filled)
            first = torch.where(filled, number, filled.shape[1] + 1).amin(1)
            last = torch.where(filled, number, -3).amax(1)
            ends.append(torch.stack([first - 1, last + 1], 1))
        return torch.stack(ends, 2).to(volume.dtype)

    def located(
        self,
        points: Tensor,  # [M, 3] m, posed frame; no gradient goes to them
        least: float = 0.0,  # see `boxes`: an error of at most this for each bone
    ) -> tuple[Tensor, Tensor]:
        """f [M] and x_can [M, 3] m. Differentiable in the volume and the maps."""
        if points.device.type == "cpu" and points.dtype == torch.float32:
            scale = self._scale()
            total, moment = _Located.apply(self.volume, self.maps, points, self.low, scale, self.boxes(least))
        else:
            total, moment = self._sums_by_torch(points)
        return total, moment / total.clamp(min=SMALLEST)[:, None]

    def located_by_torch(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The same, always by `grid_sample`."""
        total, moment = self._sums_by_torch(points)
        return total, moment / total.clamp(min=SMALLEST)[:, None]

    @torch.no_grad()
    def likelihood(
        self,
        rays: Rays,
        depths: Tensor,  # [N, S] m, rising along each ray
        least: float = 0.0,
    ) -> Tensor:
        """f [N, S] along rays. A bone is asked only between where the ray enters its box and where it leaves it: rays
        are straight in each bone's own T-pose, too."""
        if depths.device.type != "cpu" or depths.dtype != torch.float32:
            flat = rays.points(depths).flatten(0, 1)
            return torch.cat([self._sums_by_torch(part)[0] for part in flat.split(65_536)]).view_as(depths)
        out = torch.zeros_like(depths)
        volume, maps, low, scale, boxes = _arrays(self.volume, self.maps, self.low, self._scale(), self.boxes(least))
        origins, directions, at = _arrays(rays.origins, rays.directions, depths)
        _along_rays(volume, maps, origins, directions, at, low, scale, boxes, out.numpy())
        return out

    def _scale(self) -> Tensor:
        """[3] lattice steps in a metre along x, y, z."""
        sides = self.volume.shape[:0:-1]
        return (self.low.new_tensor(sides) - 1) / (self.high - self.low)

    def _sums_by_torch(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Σ w_i [M] and Σ w_i x_i [M, 3]."""
        joints = len(self.maps)
        places = points @ self.maps[:, :, :3].mT + self.maps[:, None, :, 3]  # [J, M, 3]
        low, high = self.low.to(places), self.high.to(places)
        at = (2 * (places - low) / (high - low) - 1)[:, :, None, None]  # [J, M, 1, 1, 3] x, y, z
        volume = self.volume[:joints, None].to(places)
        weights = F.grid_sample(volume, at, "bilinear", "zeros", align_corners=True)[:, 0, :, 0, 0]
        return weights.sum(0), (weights[..., None] * places).sum(0)


class _Located(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, volume, maps, points, low, scale, boxes) -> Any:
        ctx.save_for_backward(volume, maps, points, low, scale, boxes)
        total, moment = points.new_zeros(len(points)), points.new_zeros(len(points), 3)
        weights, bones, where, corner, steps, ends = _arrays(volume, maps, points, low, scale, boxes)
        _at_points(weights, bones, where, corner, steps, ends, total.numpy(), moment.numpy())
        return total, moment

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        volume, maps, points, low, scale, boxes = _arrays(*ctx.saved_tensors)
        of_total, of_moment = _arrays(*grad_outputs)
        of_volume, of_maps = np.zeros_like(volume), np.zeros(maps.shape)
        _pull_back(volume, maps, points, low, scale, boxes, of_total, of_moment, of_volume, of_maps)
        return torch.from_numpy(of_volume), torch.from_numpy(of_maps).float(), None, None, None, None


def _arrays(*tensors: Tensor) -> list[NDArray]:
    return [each.detach().contiguous().numpy() for each in tensors]


# --- kernels: a volume is read with zeros around it, as `grid_sample` does ---


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _value(volume, j, x, y, z):
    """Trilinear, lattice coordinates."""
    i, k, m = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
    depth, height, width = volume.shape[1], volume.shape[2], volume.shape[3]
    fx, fy, fz = x - np.float32(i), y - np.float32(k), z - np.float32(m)
    if 0 <= i < width - 1 and 0 <= k < height - 1 and 0 <= m < depth - 1:
        gx = np.float32(1) - fx
        a = gx * volume[j, m, k, i] + fx * volume[j, m, k, i + 1]
        b = gx * volume[j, m, k + 1, i] + fx * volume[j, m, k + 1, i + 1]
        c = gx * volume[j, m + 1, k, i] + fx * volume[j, m + 1, k, i + 1]
        d = gx * volume[j, m + 1, k + 1, i] + fx * volume[j, m + 1, k + 1, i + 1]
        gy = np.float32(1) - fy
        return (np.float32(1) - fz) * (gy * a + fy * b) + fz * (gy * c + fy * d)
    total = np.float32(0)
    for c in range(8):
        cx, cy, cz = i + (c & 1), k + ((c >> 1) & 1), m + (c >> 2)
        if 0 <= cx < width and 0 <= cy < height and 0 <= cz < depth:
            wx = fx if c & 1 else np.float32(1) - fx
            wy = fy if (c >> 1) & 1 else np.float32(1) - fy
            wz = fz if c >> 2 else np.float32(1) - fz
            total += wx * wy * wz * volume[j, cz, cy, cx]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _along_rays(volume, maps, origins, directions, depths, low, scale, boxes, out) -> None:
    """Weights of all bones at all samples, added to `out` [N, S]."""
    samples = depths.shape[1]
    start, step = np.empty(3, np.float32), np.empty(3, np.float32)
    for n in range(len(origins)):
        for j in range(len(maps)):
            near, far = np.float32(-np.inf), np.float32(np.inf)
            for a in range(3):
                o = maps[j, a, 3]
                d = np.float32(0)
                for b in range(3):
                    o += maps[j, a, b] * origins[n, b]
                    d += maps[j, a, b] * directions[n, b]
                o, d = (o - low[a]) * scale[a], d * scale[a]
                start[a], step[a] = o, d
                if abs(d) < np.float32(1e-9):
                    if o < boxes[j, 0, a] or o > boxes[j, 1, a]:
                        far = np.float32(-np.inf)
                    continue
                first, second = (boxes[j, 0, a] - o) / d, (boxes[j, 1, a] - o) / d
                near, far = max(near, min(first, second)), min(far, max(first, second))
            if not near < far or far < depths[n, 0] or near > depths[n, samples - 1]:
                continue
            s = np.searchsorted(depths[n], near)
            while s < samples and depths[n, s] <= far:
                t = depths[n, s]
                out[n, s] += _value(volume, j, start[0] + t * step[0], start[1] + t * step[1], start[2] + t * step[2])
                s += 1


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _place(maps, j, points, n, a):
    """m, component a of where bone j takes a point."""
    return maps[j, a, 0] * points[n, 0] + maps[j, a, 1] * points[n, 1] + maps[j, a, 2] * points[n, 2] + maps[j, a, 3]


@njit(cache=True, nogil=True, error_model="numpy")
def _at_points(volume, maps, points, low, scale, boxes, total, moment) -> None:
    for j in range(len(maps)):
        for n in range(len(points)):
            px, py, pz = (_place(maps, j, points, n, 0), _place(maps, j, points, n, 1), _place(maps, j, points, n, 2))
            x, y, z = (px - low[0]) * scale[0], (py - low[1]) * scale[1], (pz - low[2]) * scale[2]
            if not (
                boxes[j, 0, 0] < x < boxes[j, 1, 0]
                and boxes[j, 0, 1] < y < boxes[j, 1, 1]
                and boxes[j, 0, 2] < z < boxes[j, 1, 2]
            ):
                continue
            w = _value(volume, j, x, y, z)
            total[n] += w
            moment[n, 0] += w * px
            moment[n, 1] += w * py
            moment[n, 2] += w * pz


@njit(cache=True, nogil=True, error_model="numpy")
def _pull_back(volume, maps, points, low, scale, boxes, of_total, of_moment, of_volume, of_maps) -> None:
    """Gradients of volume and maps, added to."""
    depth, height, width = volume.shape[1], volume.shape[2], volume.shape[3]
    for j in range(len(maps)):
        for n in range(len(points)):
            px, py, pz = (_place(maps, j, points, n, 0), _place(maps, j, points, n, 1), _place(maps, j, points, n, 2))
            x, y, z = (px - low[0]) * scale[0], (py - low[1]) * scale[1], (pz - low[2]) * scale[2]
            if not (
                boxes[j, 0, 0] < x < boxes[j, 1, 0]
                and boxes[j, 0, 1] < y < boxes[j, 1, 1]
                and boxes[j, 0, 2] < z < boxes[j, 1, 2]
            ):
                continue
            pull = of_total[n] + of_moment[n, 0] * px + of_moment[n, 1] * py + of_moment[n, 2] * pz
            i, k, m = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            fx, fy, fz = x - np.float32(i), y - np.float32(k), z - np.float32(m)
            w, sx, sy, sz = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
            for c in range(8):
                cx, cy, cz = i + (c & 1), k + ((c >> 1) & 1), m + (c >> 2)
                if not (0 <= cx < width and 0 <= cy < height and 0 <= cz < depth):
                    continue
                wx = fx if c & 1 else np.float32(1) - fx
                wy = fy if (c >> 1) & 1 else np.float32(1) - fy
                wz = fz if c >> 2 else np.float32(1) - fz
                v = volume[j, cz, cy, cx]
                of_volume[j, cz, cy, cx] += pull * wx * wy * wz
                w += v * wx * wy * wz
                sx += (v if c & 1 else -v) * wy * wz
                sy += (v if (c >> 1) & 1 else -v) * wx * wz
                sz += (v if c >> 2 else -v) * wx * wy
            # of the place: what the moment has of it, and how the weight changes with it
            gx = w * of_moment[n, 0] + pull * sx * scale[0]
            gy = w * of_moment[n, 1] + pull * sy * scale[1]
            gz = w * of_moment[n, 2] + pull * sz * scale[2]
            for b in range(3):
                of_maps[j, 0, b] += gx * points[n, b]
                of_maps[j, 1, b] += gy * points[n, b]
                of_maps[j, 2, b] += gz * points[n, b]
            of_maps[j, 0, 3] += gx
            of_maps[j, 1, 3] += gy
            of_maps[j, 2, 3] += gz
