"""The hash grid over four coordinates: a place and a distance, as OccNeRF gives them to it.

Rows, offsets and hash are those of torch-ngp's `gridencoder` (gridencoder/grid.py, src/gridencoder.cu: linear
interpolation, corners not aligned): lattices as in `hash_grid`, with one corner more along a side, so the number of
parameters is, too. A position outside has features of zero instead of the border's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from ihbench.nets.hash_grid import HashGrid, features_by_torch

u64, f32 = np.uint64, np.float32


class HashGrid4d(HashGrid):
    """[N, 4] in 0..1 → [N, levels · features]. Positions outside in any coordinate, and those that are not numbers,
    have features of 0 and get no gradient."""

    dimensions = 4
    spare_corners = 1

    def forward(
        self,
        points: Tensor,  # [N, 4] in 0..1
    ) -> Tensor:
        """[N, levels · features], coarsest level first; differentiable in the points and the table."""
        compiled = self.table.device.type == "cpu" and self.table.dtype == points.dtype == torch.float32
        if compiled:
            return _Read.apply(points, self.table, self.scales, self.sides, self.starts)
        inside = ((points >= 0) & (points <= 1)).all(1, keepdim=True)
        return features_by_torch(points, self.table, self.scales, self.sides, self.starts) * inside


class _Read(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points, table, scales, sides, starts) -> Any:
        ctx.save_for_backward(points, table, scales, sides, starts)
        out = table.new_empty(len(points), len(sides), table.shape[1])
        lattices = scales.numpy(), sides.numpy(), starts.numpy()
        _read(points.detach().contiguous().numpy(), table.detach().contiguous().numpy(), *lattices, out.numpy())
        return out.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        points, table, scales, sides, starts = ctx.saved_tensors
        (pull,) = grad_outputs
        wanted = ctx.needs_input_grad[0]
        of_points = torch.zeros(len(points) if wanted else 0, 4)
        of_table = torch.zeros_like(table, memory_format=torch.contiguous_format)
        given = pull.float().reshape(len(points), len(sides), table.shape[1]).contiguous().numpy()
        lattices = scales.numpy(), sides.numpy(), starts.numpy()
        rows = table.detach().contiguous().numpy()
        at = points.detach().contiguous().numpy()
        _pull_back(at, rows, *lattices, given, of_points.numpy(), of_table.numpy(), wanted)
        return of_points if wanted else None, of_table, None, None, None


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _cell(value, scale):
    lattice = value * scale + f32(0.5)
    cell = u64(lattice)
    return cell, lattice - f32(cell)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _inside(points, n):
    """Comparisons with NaN are false."""
    x, y, z, d = points[n, 0], points[n, 1], points[n, 2], points[n, 3]
    low, high = f32(0), f32(1)
    return low <= x <= high and low <= y <= high and low <= z <= high and low <= d <= high


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _rows_of_cell(x, y, z, d, side, start, rows, dense, out):
    """The rows of the table at the cell's sixteen corners. Hashed levels have a power of two of rows."""
    for k in range(u64(16)):
        i, j = x + (k & u64(1)), y + ((k >> u64(1)) & u64(1))
        l, m = z + ((k >> u64(2)) & u64(1)), d + (k >> u64(3))
        if dense:
            out[k] = start + (i + side * (j + side * (l + side * m))) % rows
        else:
            mixed = i ^ (j * u64(2_654_435_761)) ^ (l * u64(805_459_861)) ^ (m * u64(3_674_653_429))
            out[k] = start + (mixed & (rows - u64(1)))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _weights_of_cell(fx, fy, fz, fd, out):
    for k in range(u64(16)):
        of_x = fx if k & u64(1) else f32(1) - fx
        of_y = fy if k & u64(2) else f32(1) - fy
        of_z = fz if k & u64(4) else f32(1) - fz
        out[k] = of_x * of_y * of_z * (fd if k & u64(8) else f32(1) - fd)


@njit(cache=True, nogil=True, error_model="numpy")
def _read(points, table, scales, sides, starts, out) -> None:
    one, features = u64(1), u64(table.shape[1])
    row, weight = np.empty(16, np.uint64), np.empty(16, np.float32)
    for level in range(u64(len(sides))):
        scale, side, start = scales[level], u64(sides[level]), u64(starts[level])
        rows = u64(starts[level + one]) - start
        dense = side * side * side * side <= rows
        for n in range(u64(len(points))):
            for f in range(features):
                out[n, level, f] = f32(0)
            if not _inside(points, n):
                continue
            x, fx = _cell(points[n, 0], scale)
            y, fy = _cell(points[n, 1], scale)
            z, fz = _cell(points[n, 2], scale)
            d, fd = _cell(points[n, 3], scale)
            _rows_of_cell(x, y, z, d, side, start, rows, dense, row)
            _weights_of_cell(fx, fy, fz, fd, weight)
            for k in range(u64(16)):
                for f in range(features):
                    out[n, level, f] += weight[k] * table[row[k], f]


@njit(cache=True, nogil=True, error_model="numpy")
def _pull_back(points, table, scales, sides, starts, pull, of_points, of_table, points_too):
    one, features = u64(1), u64(table.shape[1])
    row, weight = np.empty(16, np.uint64), np.empty(16, np.float32)
    for level in range(u64(len(sides))):
        scale, side, start = scales[level], u64(sides[level]), u64(starts[level])
        rows = u64(starts[level + one]) - start
        dense = side * side * side * side <= rows
        for n in range(u64(len(points))):
            if not _inside(points, n):
                continue
            x, fx = _cell(points[n, 0], scale)
            y, fy = _cell(points[n, 1], scale)
            z, fz = _cell(points[n, 2], scale)
            d, fd = _cell(points[n, 3], scale)
            _rows_of_cell(x, y, z, d, side, start, rows, dense, row)
            _weights_of_cell(fx, fy, fz, fd, weight)
            for k in range(u64(16)):
                for f in range(features):
                    of_table[row[k], f] += weight[k] * pull[n, level, f]
            if not points_too:
                continue
            gx, gy, gz, gd = f32(0), f32(0), f32(0), f32(0)
            for k in range(u64(16)):
                along = f32(0)
                for f in range(features):
                    along += table[row[k], f] * pull[n, level, f]
                wx, wy = fx if k & u64(1) else f32(1) - fx, fy if k & u64(2) else f32(1) - fy
                wz, wd = fz if k & u64(4) else f32(1) - fz, fd if k & u64(8) else f32(1) - fd
                gx += along * wy * wz * wd * (f32(1) if k & u64(1) else f32(-1))
                gy += along * wx * wz * wd * (f32(1) if k & u64(2) else f32(-1))
                gz += along * wx * wy * wd * (f32(1) if k & u64(4) else f32(-1))
                gd += along * wx * wy * wz * (f32(1) if k & u64(8) else f32(-1))
            of_points[n, 0] += scale * gx
            of_points[n, 1] += scale * gy
            of_points[n, 2] += scale * gz
            of_points[n, 3] += scale * gd
