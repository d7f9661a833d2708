"""Depth order and lists of splats per tile, for the renderer on the CPU.

A tile's list names its splats by their rank in depth. Beside each rank stands a slot of its own for the gradient that
the tile adds to the splat; the slots of one splat are neighbours. So nothing is added up by two threads, and the sum
over a splat's slots is in the order of the tiles, however many threads there were.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ihbench.render.lanes import prefetch

TILE_WIDTH, TILE_HEIGHT = 64, 32  # px
SHIFT_X, SHIFT_Y = 6, 5
AHEAD = 16  # how many splats ahead a loop asks for what it will gather

f32, u64 = np.float32, np.uint64
OPEN = np.int32(2**31 - 1)  # a tile that takes splats of any rank
ZERO, HALF = f32(0), f32(0.5)


@njit(cache=True, nogil=True, error_model="numpy")
def in_sight(depth, order, keys):
    """The splats with a depth > 0, and the bits of their depth; how many, and the range of these bits."""
    m, lowest, highest = 0, np.uint32(0xFFFFFFFF), np.uint32(0)
    bits = depth.view(np.uint32)
    for i in range(len(depth)):
        if depth[i] > ZERO:
            key = bits[i]
            order[m], keys[m] = i, key
            m += 1
            lowest, highest = min(lowest, key), max(highest, key)
    return m, lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def depth_order(order, keys, lowest, highest):
    """[M] int32: the splats `order` [M] sorted by `keys` [M] uint32 in lowest..highest, equal ones as they came.

    The bits of positive float32 depths are ordered as the depths are. Radix sort with as few passes as the spread
    needs; the input is overwritten.
    """
    m = len(order)
    bits = 0
    while bits < 32 and np.uint32(highest - lowest) >> np.uint32(bits):
        bits += 1
    passes = (bits + 11) // 12
    width = np.uint32((bits + passes - 1) // max(passes, 1))
    mask, shift = np.uint32((1 << width) - 1), np.uint32(0)
    other_order, other_keys = np.empty_like(order), np.empty_like(keys)
    start = np.empty(4096, np.int32)
    for _ in range(passes):
        start[:] = 0
        for i in range(m):
            start[((keys[i] - lowest) >> shift) & mask] += 1
        before = 0
        for digit in range(mask + 1):
            count = start[digit]
            start[digit] = before
            before += count
        for i in range(m):
            digit = ((keys[i] - lowest) >> shift) & mask
            at = start[digit]
            start[digit] = at + 1
            other_order[at], other_keys[at] = order[i], keys[i]
        order, other_order, keys, other_keys = other_order, order, other_keys, keys
        shift += width
    return order


@njit(cache=True, nogil=True, error_model="numpy")
def ranks_of(order, n):
    """[n] int32: the place of each splat in `order` [M], -1 for those not in it."""
    ranks = np.full(n, -1, np.int32)
    for rank in range(u64(len(order))):
        ranks[u64(order[rank])] = rank
    return ranks


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def fetch_slots(slots, rank_of, slot_start, packed, i):
    """Ask for what the gradient of splat i + AHEAD is made of."""
    if i + 2 * AHEAD < len(rank_of):
        prefetch(slot_start, u64(max(rank_of[u64(i + 2 * AHEAD)], 0)))
        rank = u64(max(rank_of[u64(i + AHEAD)], 0))
        prefetch(packed, rank * u64(packed.shape[1]))
        prefetch(slots, u64(slot_start[rank]) * u64(slots.shape[1]))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def count_tiles(rank, x, y, half_x, half_y, height, width, boxes, counts, closed):
    """How many tiles that take splats of this rank have a pixel centre within half_x, half_y px of (x, y).

    Keeps their range in boxes[rank] = first and last column, first and last row, and counts each in counts[tile + 1].
    Truncation instead of floor: numba calls a library for that one. Most splats lie in one tile.
    """
    x0 = np.int32(max(x - half_x + HALF, ZERO)) >> SHIFT_X
    x1 = np.int32(min(max(x + half_x - HALF, f32(-1)), f32(width - 1))) >> SHIFT_X
    y0 = np.int32(max(y - half_y + HALF, ZERO)) >> SHIFT_Y
    y1 = np.int32(min(max(y + half_y - HALF, f32(-1)), f32(height - 1))) >> SHIFT_Y
    box = boxes[u64(rank)]
    box[0], box[1], box[2], box[3] = x0, x1, y0, y1
    tiles_x = u64((width + TILE_WIDTH - 1) // TILE_WIDTH)
    if x0 == x1 and y0 == y1:
        tile = u64(y0) * tiles_x + u64(x0)
        listed = rank < closed[tile]
        counts[tile + u64(1)] += listed
        return np.int64(listed)
    found = np.int64(0)
    for ty in range(y0, y1 + 1):
        for tx in range(x0, x1 + 1):
            tile = u64(ty) * tiles_x + u64(tx)
            listed = rank < closed[tile]
            counts[tile + u64(1)] += listed
            found += listed
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def close_tiles(
    rank, x, y, shear, sharp_x, sharp_y, log2_opacity, alpha_min, alpha_max, t_stop, width, boxes, let_through, closed
):
    """Close the tiles behind this splat that it and those in front cover whole and leave less than `t_stop` of.

    Without it a few thousand huge splats would fill the memory. `let_through` [tiles] is the most that any pixel of a
    tile lets through. A footprint is smallest in a corner.
    """
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    for ty in range(boxes[rank, 2], boxes[rank, 3] + 1):
        for tx in range(boxes[rank, 0], boxes[rank, 1] + 1):
            tile = ty * tiles_x + tx
            if rank >= closed[tile]:
                continue
            exponent = 0.0
            for corner in range(4):
                dx = float(tx * TILE_WIDTH + corner % 2 * (TILE_WIDTH - 1) + 0.5 - x)
                dy = float(ty * TILE_HEIGHT + corner // 2 * (TILE_HEIGHT - 1) + 0.5 - y)
                across, down = (dx - shear * dy) * sharp_x, dy * sharp_y
                exponent = max(exponent, across * across + down * down)
            least = 2.0 ** (log2_opacity - exponent)
            if least > 2 * alpha_min:
                let_through[tile] *= max(1 - least, 1 - alpha_max)
                if let_through[tile] < t_stop:
                    closed[tile] = rank + 1


@njit(cache=True, nogil=True, error_model="numpy")
def fill_tiles(boxes, tiles_x, tile_start, closed, ranks, slots):
    """Counts [tiles + 1] -> where each tile's list starts, in place; `ranks` and `slots` [entries] tile by tile."""
    for tile in range(len(closed)):
        tile_start[tile + 1] += tile_start[tile]
    cursor = tile_start[:-1].copy()
    slot = 0
    for rank in range(len(boxes)):
        box = boxes[u64(rank)]
        x0, x1, y0, y1 = box[0], box[1], box[2], box[3]
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                tile = u64(ty * tiles_x + tx)
                if rank < closed[tile]:
                    at = cursor[tile]
                    cursor[tile] = at + 1
                    ranks[u64(at)], slots[u64(at)] = rank, slot
                    slot += 1
