"""Multi-resolution hash grid: a position's features from tables of lattice corners (Müller et al. 2022).

Level l has a lattice of `scale_l = coarsest * growth^l - 1` cells along a side, read at `scale_l p + 1/2`; the
features of a cell's eight corners are blended trilinearly. A lattice that fits into 2^`log2_size` rows has a row for
each corner, finer ones share rows by a hash and leave collisions to training. Rows, offsets and hash are those of
tiny-cuda-nn (include/tiny-cuda-nn/encodings/grid.h: linear interpolation), so the number of parameters is, too;
without its half precision.

On the CPU in float32 compiled loops go level by level, so that a level's table stays in the cache, and the gradient
of the table is added in one fixed order. Anything else (CUDA, float64) takes `features_by_torch`, which the loops are
tested against.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

PRIMES = (1, 2_654_435_761, 805_459_861, 3_674_653_429)  # of the axes; the fourth as in torch-ngp
LARGEST_START = 1e-4  # of the first values, as in tiny-cuda-nn
ROWS_ALIGNED = 8  # a dense level's rows are a multiple of this

u64, f32 = np.uint64, np.float32


class HashGrid(nn.Module):
    """[N, 3] in 0..1 → [N, levels · features]. Positions outside are moved onto the border and get no gradient
    there; one that is not a number counts as 0."""

    dimensions = 3
    spare_corners = 0  # along a side of each lattice, that no position reaches

    scales: Tensor  # [L] float32 cells along a side
    sides: Tensor  # [L] int64 corners along a side
    starts: Tensor  # [L + 1] int64 first row of each level
    table: nn.Parameter  # [R, F]

    def __init__(
        self,
        generator: torch.Generator,
        *,
        levels: int = 16,
        features: int = 2,
        log2_size: int = 16,
        coarsest: int = 16,
        finest: int = 2048,
    ):
        """Values start uniform in ±1e-4. Raises `ValueError` for sizes that make no grid."""
        super().__init__()
        if not (levels >= 1 and features >= 1 and 1 <= coarsest <= finest and 0 <= log2_size <= 28):
            raise ValueError(
                f"hash grid: expected levels and features of at least 1, coarsest <= finest and log2_size up to 28, "
                f"got {levels}, {features}, {coarsest}, {finest}, {log2_size}"
            )
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        scales = np.array([coarsest * growth**level - 1 for level in range(levels)], np.float32)
        sides = np.ceil(scales).astype(np.int64) + 1 + self.spare_corners
        most = 2**log2_size
        corners = np.minimum(sides.astype(float) ** self.dimensions, 2.0**31).astype(np.int64)
        rows = np.minimum(-(-corners // ROWS_ALIGNED) * ROWS_ALIGNED, most)
        starts = np.concatenate([[0], np.cumsum(rows)])
        for name, value in (("scales", scales), ("sides", sides), ("starts", starts)):
            self.register_buffer(name, torch.from_numpy(value), persistent=False)
        first = torch.rand(int(starts[-1]), features, generator=generator)
        self.table = nn.Parameter((2 * first - 1) * LARGEST_START)

    @property
    def width(self) -> int:
        """Of the output."""
        return len(self.sides) * self.table.shape[1]

    def forward(
        self,
        points: Tensor,  # [N, 3] in 0..1
    ) -> Tensor:
        """[N, levels · features], coarsest level first; differentiable in the points and the table."""
        compiled = self.table.device.type == "cpu" and self.table.dtype == points.dtype == torch.float32
        if compiled:
            return _Read.apply(points, self.table, self.scales, self.sides, self.starts)
        return features_by_torch(points, self.table, self.scales, self.sides, self.starts)


def features_by_torch(
    points: Tensor,  # [N, D] in 0..1
    table: Tensor,  # [R, F]
    scales: Tensor,  # [L]
    sides: Tensor,  # [L]
    starts: Tensor,  # [L + 1]
) -> Tensor:
    """[N, L F] in the table's dtype, for D up to four: what the compiled loops do, as tensors."""
    places, axes = points.nan_to_num(nan=0.0).clamp(0, 1), range(points.shape[1])
    corners = torch.tensor([[k >> axis & 1 for axis in axes] for k in range(2 ** len(axes))], device=points.device)
    levels = []
    for level, side in enumerate(sides.tolist()):
        start, end = starts[level].item(), starts[level + 1].item()
        lattice = places * scales[level].to(places.dtype) + 0.5
        cell = lattice.detach().floor()
        share = (lattice - cell)[:, None, :]
        corner = cell.long()[:, None, :] + corners  # [N, 2^D, D]
        dense, row = side ** len(axes) <= end - start, torch.zeros_like(corner[..., 0])
        for axis in axes:
            row = row + corner[..., axis] * side**axis if dense else row ^ (corner[..., axis] * PRIMES[axis])
        weight = torch.where(corners > 0, share, 1 - share).prod(-1)  # [N, 2^D]
        levels.append((table[start + row % (end - start)] * weight[..., None].to(table.dtype)).sum(1))
    return torch.cat(levels, 1)


class _Read(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points, table, scales, sides, starts) -> Any:
        ctx.save_for_backward(points, table, scales, sides, starts)
        out = table.new_empty(len(points), len(sides), table.shape[1])
        at, rows = _arrays(points, table)
        _read(at, rows, scales.numpy(), sides.numpy(), starts.numpy(), out.numpy())
        return out.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        points, table, scales, sides, starts = ctx.saved_tensors
        (pull,) = grad_outputs
        of_points, of_table = torch.zeros_like(points, memory_format=torch.contiguous_format), torch.zeros_like(table)
        given = pull.float().reshape(len(points), len(sides), table.shape[1])
        at, rows, along = _arrays(points, table, given)
        lattices = scales.numpy(), sides.numpy(), starts.numpy()
        _pull_back(at, rows, *lattices, along, of_points.numpy(), of_table.numpy())
        return of_points, of_table, None, None, None


def _arrays(*tensors: Tensor) -> list[NDArray]:
    """Without copies where they are contiguous."""
    return [each.detach().contiguous().numpy() for each in tensors]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _cell(value, scale):
    """Cell and place in it of a coordinate, and whether it is inside: comparisons with NaN are false."""
    inside = value >= f32(0) and value <= f32(1)
    value = value if value > f32(0) else f32(0)
    value = value if value < f32(1) else f32(1)
    lattice = value * scale + f32(0.5)
    cell = u64(lattice)
    return cell, lattice - f32(cell), inside


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _row(x, y, z, side, rows, dense):
    """The corner's row in its level. Hashed levels have a power of two of rows."""
    if dense:
        return (x + side * (y + side * z)) % rows
    return (x ^ (y * u64(2_654_435_761)) ^ (z * u64(805_459_861))) & (rows - u64(1))


@njit(cache=True, nogil=True, error_model="numpy")
def _read(points, table, scales, sides, starts, out) -> None:
    one = u64(1)
    features = u64(table.shape[1])
    for level in range(u64(len(sides))):
        scale, side, start = scales[level], u64(sides[level]), u64(starts[level])
        rows = u64(starts[level + one]) - start
        dense = side * side * side <= rows
        for n in range(u64(len(points))):
            x, fx, _ = _cell(points[n, 0], scale)
            y, fy, _ = _cell(points[n, 1], scale)
            z, fz, _ = _cell(points[n, 2], scale)
            for f in range(features):
                out[n, level, f] = f32(0)
            for k in range(u64(8)):
                right, up, deep = k & one, (k >> one) & one, k >> u64(2)
                weight = (fx if right else f32(1) - fx) * (fy if up else f32(1) - fy) * (fz if deep else f32(1) - fz)
                row = start + _row(x + right, y + up, z + deep, side, rows, dense)
                for f in range(features):
                    out[n, level, f] += weight * table[row, f]


@njit(cache=True, nogil=True, error_model="numpy")
def _pull_back(points, table, scales, sides, starts, pull, of_points, of_table):
    one = u64(1)
    features = u64(table.shape[1])
    for level in range(u64(len(sides))):
        scale, side, start = scales[level], u64(sides[level]), u64(starts[level])
        rows = u64(starts[level + one]) - start
        dense = side * side * side <= rows
        for n in range(u64(len(points))):
            x, fx, in_x = _cell(points[n, 0], scale)
            y, fy, in_y = _cell(points[n, 1], scale)
            z, fz, in_z = _cell(points[n, 2], scale)
            gx, gy, gz = f32(0), f32(0), f32(0)
            for k in range(u64(8)):
                right, up, deep = k & one, (k >> one) & one, k >> u64(2)
                wx, wy, wz = fx if right else f32(1) - fx, fy if up else f32(1) - fy, fz if deep else f32(1) - fz
                row = start + _row(x + right, y + up, z + deep, side, rows, dense)
                along, weight = f32(0), wx * wy * wz
                for f in range(features):
                    g = pull[n, level, f]
                    of_table[row, f] += weight * g
                    along += table[row, f] * g
                gx += along * wy * wz * (f32(1) if right else f32(-1))
                gy += along * wx * wz * (f32(1) if up else f32(-1))
                gz += along * wx * wy * (f32(1) if deep else f32(-1))
            if in_x:
                of_points[n, 0] += scale * gx
            if in_y:
                of_points[n, 1] += scale * gy
            if in_z:
                of_points[n, 2] += scale * gz
