"""Splats packed in the order of their depth, for the renderer on the CPU."""

from __future__ import annotations

from numba import njit

from ihbench.render.splat_circles import CIRCLE
from ihbench.render.splat_ellipses import ELLIPSE
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, close_tiles, count_tiles, f32, u64

BLOCK = 64  # splats gathered together

ZERO = f32(0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def pack_splats(
    elliptic, records, order, alpha_min, alpha_max, t_stop, height, width, packed, boxes, counts, closed, let_through,
    slot_start,
):  # fmt: skip
    """Fill `packed` [M, …] with the `records` in `order` and what `splat_tiles` wants; returns the number of entries.

    `elliptic` as in `splat_compositing`.
    """
    floats, half = (CIRCLE, 3) if elliptic is None else (ELLIPSE, 7)
    entries, count = 0, len(order)
    for block in range(0, count, BLOCK):
        end, largest = min(block + BLOCK, count), ZERO
        for rank in range(u64(block), u64(end)):
            i, p = u64(order[rank]), packed[rank]
            for c in range(u64(floats)):
                p[c] = records[i, c]
            half_y = p[half] if elliptic is None else p[8]
            largest = max(largest, min(p[half], half_y * f32(TILE_WIDTH / TILE_HEIGHT)))
        if largest <= f32(TILE_WIDTH / 2):  # they hide no tile, and without calls all stays in registers
            for rank in range(block, end):
                p = packed[u64(rank)]
                half_y = p[half] if elliptic is None else p[8]
                slot_start[u64(rank)] = entries
                entries += count_tiles(rank, p[0], p[1], p[half], half_y, height, width, boxes, counts, closed)
            continue
        for rank in range(block, end):
            p = packed[u64(rank)]
            half_y = p[half] if elliptic is None else p[8]
            slot_start[u64(rank)] = entries
            entries += count_tiles(rank, p[0], p[1], p[half], half_y, height, width, boxes, counts, closed)
            if p[half] > f32(TILE_WIDTH / 2) and half_y > f32(TILE_HEIGHT / 2):
                if elliptic is None:
                    sharp_y, shear, log2_opacity = p[2], ZERO, ZERO
                else:
                    sharp_y, shear, log2_opacity = p[3], p[4], p[5]
                close_tiles(
                    rank, p[0], p[1], shear, p[2], sharp_y, log2_opacity, alpha_min, alpha_max, t_stop, width, boxes,
                    let_through, closed,
                )  # fmt: skip
    slot_start[count] = entries
    return entries
