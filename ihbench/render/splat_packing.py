"""Splats packed in the order of their depth, and lists of them per tile, for the renderer on the CPU.

A tile's list names its splats by their rank in depth. Beside each rank stands a slot of its own for the gradient that
the tile adds to the splat; the slots of one splat are neighbours. So nothing is added up by two threads, and the sum
over a splat's slots is in the order of the tiles, however many threads there were.

Threads share the ranks: every part counts what it puts into each tile, and from the sums over parts and tiles each
knows where its own entries begin.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ihbench.render.splat_circles import CIRCLE
from ihbench.render.splat_ellipses import ELLIPSE
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, f32, u64

SHIFT_X, SHIFT_Y = 6, 5
BLOCK = 64  # splats gathered together
OPEN = np.int32(2**31 - 1)  # a tile that takes splats of any rank
ZERO, HALF = f32(0), f32(0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def pack_splats(elliptic, records, order, height, width, packed, boxes, rank_of, counts, large, part, parts):
    """Gather one part of the `records` in `order` [M] into `packed` [M, …].

    Fills in the tiles that each can reach, boxes [M, 4] (first and last column, first and last row), how many of the
    part reach each tile, counts[part] [tiles], whether one is large enough to cover a tile, large[part], and the rank
    of each splat, rank_of [N], unless that is empty.

    Truncation instead of floor: numba calls a library for that one. Most splats lie in one tile.
    """
    floats, half = (CIRCLE, 3) if elliptic is None else (ELLIPSE, 7)
    counts, tiles_x = counts[part], u64((width + TILE_WIDTH - 1) // TILE_WIDTH)
    first, past = len(order) * part // parts, len(order) * (part + 1) // parts
    for block in range(first, past, BLOCK):
        end = min(block + BLOCK, past)
        for rank in range(u64(block), u64(end)):
            i, p = u64(order[rank]), packed[rank]
            for c in range(u64(floats)):
                p[c] = records[i, c]
            if len(rank_of):
                rank_of[i] = rank
        for rank in range(u64(block), u64(end)):
            p, box = packed[rank], boxes[rank]
            x, y, half_x = p[0], p[1], p[half]
            half_y = half_x if elliptic is None else p[8]
            large[part] |= (half_x > f32(TILE_WIDTH / 2)) & (half_y > f32(TILE_HEIGHT / 2))
            x0 = np.int32(max(x - half_x + HALF, ZERO)) >> SHIFT_X
            x1 = np.int32(min(max(x + half_x - HALF, f32(-1)), f32(width - 1))) >> SHIFT_X
            y0 = np.int32(max(y - half_y + HALF, ZERO)) >> SHIFT_Y
            y1 = np.int32(min(max(y + half_y - HALF, f32(-1)), f32(height - 1))) >> SHIFT_Y
            box[0], box[1], box[2], box[3] = x0, x1, y0, y1
            if x0 == x1 and y0 == y1:
                counts[u64(y0) * tiles_x + u64(x0)] += 1
                continue
            for ty in range(y0, y1 + 1):
                for tx in range(x0, x1 + 1):
                    counts[u64(ty) * tiles_x + u64(tx)] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def count_again(boxes, tiles_x, closed, counts, part, parts):
    """`counts` without what lies behind closed tiles: closed[tile] is the first rank that a tile does not take."""
    counts = counts[part]
    counts[:] = 0
    for rank in range(len(boxes) * part // parts, len(boxes) * (part + 1) // parts):
        for ty in range(boxes[rank, 2], boxes[rank, 3] + 1):
            for tx in range(boxes[rank, 0], boxes[rank, 1] + 1):
                counts[ty * tiles_x + tx] += rank < closed[ty * tiles_x + tx]


@njit(cache=True, nogil=True, error_model="numpy")
def close_tiles(elliptic, packed, boxes, tiles_x, alpha_min, alpha_max, t_stop, closed):
    """Close the tiles behind splats that, with those in front, cover them whole and leave less than `t_stop` of them.

    Without it a few thousand huge splats would fill the memory. A footprint is smallest in a corner.
    """
    let_through = np.ones(len(closed), np.float32)  # the most that any pixel of a tile lets through
    for rank in range(len(packed)):
        p = packed[rank]
        if elliptic is None:
            half_x, half_y, sharp_y, shear, log2_opacity = p[3], p[3], p[2], ZERO, ZERO
        else:
            half_x, half_y, sharp_y, shear, log2_opacity = p[7], p[8], p[3], p[4], p[5]
        if not (half_x > f32(TILE_WIDTH / 2) and half_y > f32(TILE_HEIGHT / 2)):
            continue
        for ty in range(boxes[rank, 2], boxes[rank, 3] + 1):
            for tx in range(boxes[rank, 0], boxes[rank, 1] + 1):
                tile = ty * tiles_x + tx
                if rank >= closed[tile]:
                    continue
                exponent = 0.0
                for corner in range(4):
                    dx = float(tx * TILE_WIDTH + corner % 2 * (TILE_WIDTH - 1) + 0.5 - p[0])
                    dy = float(ty * TILE_HEIGHT + corner // 2 * (TILE_HEIGHT - 1) + 0.5 - p[1])
                    across, down = (dx - shear * dy) * p[2], dy * sharp_y
                    exponent = max(exponent, across * across + down * down)
                least = 2.0 ** (log2_opacity - exponent)
                if least > 2 * alpha_min:
                    let_through[tile] *= max(1 - least, 1 - alpha_max)
                    if let_through[tile] < t_stop:
                        closed[tile] = rank + 1


@njit(cache=True, nogil=True, error_model="numpy")
def fill_tiles(boxes, tiles_x, closed, starts, first_slots, ranks, slots, slot_start, part, parts):
    """One part's entries into `ranks` and `slots` [entries], from starts[tile, part] and first_slots[part] on, and
    where the slots of each splat begin, slot_start [M]."""
    cursor, slot = starts[:, part].copy(), first_slots[part]
    for rank in range(len(boxes) * part // parts, len(boxes) * (part + 1) // parts):
        box = boxes[u64(rank)]
        x0, x1, y0, y1 = box[0], box[1], box[2], box[3]
        slot_start[u64(rank)] = slot
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                tile = u64(ty * tiles_x + tx)
                if rank < closed[tile]:
                    at = cursor[tile]
                    cursor[tile] = at + 1
                    ranks[u64(at)], slots[u64(at)] = rank, slot
                    slot += 1
