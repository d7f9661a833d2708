"""Compositing of packed splats, tile by tile, and its gradient: the inner loops of the renderer on the CPU.

A tile of 64×32 px lies in the first-level cache as planes that are interleaved row by row: planes a multiple of 4 KiB
apart would evict each other. Splats are cut into row segments of 16 px, which may start at any column; 16 dead
columns follow a row, so that none needs a mask at its end.

The backward pass goes back to front. With T_k the transmittance in front of splat k, g the gradient of a pixel and
`seen_k` = g · (the colour composited from everything behind k, as if alone):

    dL/d alpha_k = T_k (g · c_k - seen_k),     seen_{k-1} = seen_k + alpha_k (g · c_k - seen_k).

T_k is the stored T_{k+1} divided by 1 - alpha_k, one rounding a splat; each pixel knows the last splat it drew.

One source for circles and ellipses: `elliptic` is None or True, and numba leaves out the branches of the other kind.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from ihbench.render.lanes import (
    above,
    absolute,
    any_of,
    at_least,
    both,
    broadcast,
    exp2,
    lanes,
    larger,
    load,
    select,
    smaller,
    store,
    store_where,
    total,
    zeros,
)  # fmt: skip
from ihbench.render.splat_circles import CIRCLE_COLOR, SEGMENT, circle_segments
from ihbench.render.splat_ellipses import ELLIPSE_COLOR, ellipse_segments
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, f32, u64

PLANE = TILE_WIDTH + 16
FORWARD_ROW = 5 * PLANE  # T, r, g, b, last: the position in the list of the last splat drawn
BACKWARD_ROW = 6 * PLANE  # T, last, seen, gradient of r, g, b
CELLS_X, CELLS_Y = TILE_WIDTH // 16, TILE_HEIGHT // 16
BATCH = 32  # splats prepared together; hidden cells are looked for between batches
SEGMENTS = 96  # room for the segments of a batch
MOST = 16  # more segments than one splat can have in a tile
T_LEAST = f32(1e-10)  # a circle's pixel ends here, against underflow only: ending at 1e-5 would spoil the gradient of
# an opaque splat, which takes T there from 1e-2 in one step

_FAST = {"contract", "nsz", "arcp"}
ZERO, ONE, HALF = f32(0), f32(1), f32(0.5)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def workspace(floats):
    """A tile of so many floats, room for what is prepared of its segments, and the segments: one block that begins
    with a page, so that how they lie to each other in the cache is no accident."""
    room = np.empty(floats + SEGMENTS * (SEGMENT + 8) + 1024, np.float32)
    start = (-room.ctypes.data % 4096) // 4
    tile = room[start : start + floats]
    start += floats
    prepared = room[start : start + SEGMENTS * SEGMENT]
    start += SEGMENTS * SEGMENT
    return tile, prepared, room[start : start + SEGMENTS * 8].view(np.int32).reshape(SEGMENTS, 8)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def find_dead(tile, t_stop, dead):
    """Mark the 16×16 px cells in which every pixel lets through less than `t_stop`; returns how many are left."""
    alive = 0
    for cell_y in range(CELLS_Y):
        for cell_x in range(CELLS_X):
            most = zeros()
            for q in range(cell_y * 16, cell_y * 16 + 16):
                most = larger(most, load(tile, q * FORWARD_ROW + cell_x * 16))
            over = not any_of(at_least(most, broadcast(t_stop)))
            dead[cell_y * (CELLS_X + 1) + cell_x] = over
            alive += not over
    return alive


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def fill_background(background, x0, y0, columns, rows, rgb, alpha):
    for y in range(y0, y0 + rows):
        for x in range(x0, x0 + columns):
            alpha[y, x] = ZERO
            rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = background[0], background[1], background[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def composite_tiles(
    elliptic, packed, ranks, slots, tile_start, tile_order, drawn, height, width, alpha_min, alpha_max, stop, t_stop,
    background, rgb, alpha, keep, state, part, parts,
):  # fmt: skip
    """Fill one part of rgb [H, W, 3] and alpha [H, W].

    A tile's list shrinks to the splats that are drawn, `drawn` [tiles] says how many. With `keep`, `state`
    [tiles · 2 · 32 · 64] gets what the backward pass needs of each pixel: T and last.
    """
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tile, prepared, segments = workspace(TILE_HEIGHT * FORWARD_ROW)
    dead = np.ones((CELLS_X + 1) * (CELLS_Y + 1), np.bool_)
    least, most, ends, one, nothing = (
        broadcast(alpha_min), broadcast(alpha_max), broadcast(stop), broadcast(ONE), zeros(),
    )  # fmt: skip
    color_at = CIRCLE_COLOR if elliptic is None else ELLIPSE_COLOR
    for turn in range(part, len(tile_order), parts):
        t = tile_order[turn]
        begin, end, live = tile_start[t], tile_start[t + 1], 0
        x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        drawn[t] = 0
        if begin == end:
            fill_background(background, x0, y0, columns, rows, rgb, alpha)
            continue
        tile[:] = ZERO
        for q in range(TILE_HEIGHT):
            for c in range(0, TILE_WIDTH, 16):
                store(tile, q * FORWARD_ROW + 4 * PLANE + c, broadcast(f32(-1)))
        for q in range(rows):
            for j in range(columns):
                tile[q * FORWARD_ROW + j] = ONE
        first_x, first_y = f32(x0) + HALF, f32(y0) + HALF
        k = begin
        while k < end:
            cells = find_dead(tile, t_stop, dead)
            if cells == 0:
                break
            some = cells < CELLS_X * CELLS_Y  # else nothing is hidden, and no splat is asked
            n, batch_end = 0, min(k + BATCH, end)
            while k < batch_end and n < SEGMENTS - MOST:
                rank = u64(ranks[u64(k)])
                if elliptic is None:
                    after = circle_segments(packed, rank, live, first_x, first_y, dead, some, prepared, segments, n)
                else:
                    after = ellipse_segments(packed, rank, live, first_x, first_y, dead, some, prepared, segments, n)
                ranks[u64(begin + live)], slots[u64(begin + live)] = ranks[u64(k)], slots[u64(k)]
                live += after > n
                n = after
                k += 1
            for i in range(n):
                s = u64(i)
                rank, at = u64(segments[s, 3]), s * u64(SEGMENT)
                r, g, b = (
                    broadcast(packed[rank, color_at]),
                    broadcast(packed[rank, color_at + 1]),
                    broadcast(packed[rank, color_at + 2]),
                )
                position = broadcast(f32(segments[s, 4]))
                row = segments[s, 1] * FORWARD_ROW
                across = sharp = nothing
                if elliptic is None:
                    across = load(prepared, at)
                else:
                    sharp = broadcast(packed[rank, 2])
                for j in range(at, at + u64(segments[s, 2])):
                    if elliptic is None:
                        o = row + segments[s, 0]
                        footprint = across * prepared[j + u64(16)]
                    else:
                        o = row + np.int64(prepared[j])
                        off = (lanes() + prepared[j + u64(32)]) * sharp
                        footprint = exp2(broadcast(prepared[j + u64(16)]) - off * off)
                    a, T = smaller(footprint, most), load(tile, o)
                    if elliptic is None:
                        on = both(at_least(a, least), at_least(T, broadcast(T_LEAST)))
                        a = select(on, a, nothing)
                        store(tile, o, T * (one - a))
                    else:
                        # a pixel that is over keeps its T with the sign turned
                        hit = both(at_least(a, least), above(T, nothing))
                        behind = T * (one - a)
                        on = both(hit, above(behind, ends))
                        store(tile, o, select(hit, select(on, behind, nothing - T), T))
                        a = select(on, a, nothing)
                    weight = a * T
                    store(tile, o + PLANE, load(tile, o + PLANE) + weight * r)
                    store(tile, o + 2 * PLANE, load(tile, o + 2 * PLANE) + weight * g)
                    store(tile, o + 3 * PLANE, load(tile, o + 3 * PLANE) + weight * b)
                    store_where(tile, o + 4 * PLANE, position, on)
                    row += FORWARD_ROW
        drawn[t] = live
        for q in range(rows):
            for j in range(columns):
                o = q * FORWARD_ROW + j
                left = abs(tile[o])
                alpha[y0 + q, x0 + j] = ONE - left
                for c in range(3):
                    rgb[y0 + q, x0 + j, c] = tile[o + (c + 1) * PLANE] + left * background[c]
        if keep:
            for q in range(TILE_HEIGHT):
                for c in range(0, TILE_WIDTH, 16):
                    to = (t * 2 * TILE_HEIGHT + q) * TILE_WIDTH + c
                    store(state, to, absolute(load(tile, q * FORWARD_ROW + c)))
                    store(state, to + TILE_HEIGHT * TILE_WIDTH, load(tile, q * FORWARD_ROW + 4 * PLANE + c))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def composite_tiles_backward(
    elliptic, packed, ranks, slots, tile_start, tile_order, drawn, height, width, alpha_min, alpha_max,
    background, grad_rgb, grad_alpha, state, gradients, part, parts,
):  # fmt: skip
    """Add one part of the tiles' gradients to `gradients` [entries, …], each at its slot; see `CIRCLE_GRADIENT`,
    `ELLIPSE_GRADIENT`."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    tile, prepared, segments = workspace(TILE_HEIGHT * BACKWARD_ROW)
    dead = np.ones(1, np.bool_)
    least, most, one, nothing = broadcast(alpha_min), broadcast(alpha_max), broadcast(ONE), zeros()
    color_at = CIRCLE_COLOR if elliptic is None else ELLIPSE_COLOR
    for turn in range(part, len(tile_order), parts):
        t = tile_order[turn]
        if drawn[t] == 0:
            continue
        begin, k = tile_start[t], drawn[t] - 1
        x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
        tile[:] = ZERO
        for q in range(TILE_HEIGHT):
            for c in range(0, TILE_WIDTH, 16):
                at = (t * 2 * TILE_HEIGHT + q) * TILE_WIDTH + c
                store(tile, q * BACKWARD_ROW + c, load(state, at))
                store(tile, q * BACKWARD_ROW + PLANE + c, load(state, at + TILE_HEIGHT * TILE_WIDTH))
            store(tile, q * BACKWARD_ROW + PLANE + TILE_WIDTH, broadcast(f32(-1)))
        for q in range(min(TILE_HEIGHT, height - y0)):
            for j in range(min(TILE_WIDTH, width - x0)):
                o, pull = q * BACKWARD_ROW + j, grad_rgb[y0 + q, x0 + j]
                tile[o + 3 * PLANE], tile[o + 4 * PLANE], tile[o + 5 * PLANE] = pull[0], pull[1], pull[2]
                through = pull[0] * background[0] + pull[1] * background[1] + pull[2] * background[2]
                tile[o + 2 * PLANE] = through - grad_alpha[y0 + q, x0 + j]
        first_x, first_y = f32(x0) + HALF, f32(y0) + HALF
        while k >= 0:
            n, batch_end = 0, max(k - BATCH, -1)
            while k > batch_end and n < SEGMENTS - MOST:
                rank = u64(ranks[u64(begin + k)])
                if elliptic is None:
                    n = circle_segments(packed, rank, k, first_x, first_y, dead, False, prepared, segments, n)
                else:
                    n = ellipse_segments(packed, rank, k, first_x, first_y, dead, False, prepared, segments, n)
                k -= 1
            for i in range(n):
                s = u64(i)
                rank, at = u64(segments[s, 3]), s * u64(SEGMENT)
                r, g, b = (
                    broadcast(packed[rank, color_at]),
                    broadcast(packed[rank, color_at + 1]),
                    broadcast(packed[rank, color_at + 2]),
                )
                position = broadcast(f32(segments[s, 4]))
                row = segments[s, 1] * BACKWARD_ROW
                dy = f32(segments[s, 1]) - (packed[rank, 1] - first_y)
                s0 = sx = sy = sxx = sxy = syy = sr = sg = sb = nothing
                across = sharp = off = nothing
                down = ONE
                if elliptic is None:
                    across = load(prepared, at)
                else:
                    sharp, down = broadcast(packed[rank, 2]), packed[rank, 3]
                for j in range(at, at + u64(segments[s, 2])):
                    if elliptic is None:
                        o = row + segments[s, 0]
                        footprint = across * prepared[j + u64(16)]
                    else:
                        o = row + np.int64(prepared[j])
                        off = (lanes() + prepared[j + u64(32)]) * sharp
                        footprint = exp2(broadcast(prepared[j + u64(16)]) - off * off)
                    a = smaller(footprint, most)
                    a = select(both(at_least(a, least), at_least(load(tile, o + PLANE), position)), a, nothing)
                    T = load(tile, o) / (one - a)
                    store(tile, o, T)
                    weight, seen = a * T, load(tile, o + 2 * PLANE)
                    gr, gg, gb = load(tile, o + 3 * PLANE), load(tile, o + 4 * PLANE), load(tile, o + 5 * PLANE)
                    change = gr * r + gg * g + gb * b - seen
                    store(tile, o + 2 * PLANE, seen + a * change)
                    # d footprint / d parameter is a multiple of the footprint, hence the weight; 0 where it is cut
                    slope = select(at_least(most, footprint), weight * change, nothing)
                    s0 = s0 + slope
                    if elliptic is None:
                        part_y = slope * dy
                        sy = sy + part_y
                        syy = syy + part_y * dy
                        dy += ONE
                    else:
                        part_x, u = slope * off, dy * down
                        sx = sx + part_x
                        sxx = sxx + part_x * off
                        sxy = sxy + part_x * u
                        part_y = slope * u
                        sy = sy + part_y
                        syy = syy + part_y * u
                        dy += ONE
                    sr, sg, sb = sr + weight * gr, sg + weight * gg, sb + weight * gb
                    row += BACKWARD_ROW
                e = gradients[u64(slots[u64(begin + segments[s, 4])])]
                if elliptic is None:
                    dx = lanes() + (f32(segments[s, 0]) - (packed[rank, 0] - first_x))  # the same in every row
                    sx = s0 * dx
                    e[0] += total(sx)
                    e[1] += total(sy)
                    e[2] += total(sx * dx + syy)
                    e[3] += total(sr)
                    e[4] += total(sg)
                    e[5] += total(sb)
                else:
                    e[0] += total(s0)
                    e[1] += total(sx)
                    e[2] += total(sy)
                    e[3] += total(sxx)
                    e[4] += total(sxy)
                    e[5] += total(syy)
                    e[6] += total(sr)
                    e[7] += total(sg)
                    e[8] += total(sb)
