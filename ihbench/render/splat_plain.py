"""Compositing of packed ellipses pixel by pixel: what `splat_compositing` does, for processors without wide vectors.

Same lists, same order, same rule for the end of a pixel; T and last are kept per pixel of the tile. No explicit
vectors, nothing but scalar float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ihbench.render.splat_ellipses import ELLIPSE_COLOR
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, f32, u64

BATCH = 32  # splats between two looks whether a pixel of the tile still lets light through

_FAST = {"contract", "nsz", "arcp"}
ZERO, ONE, HALF = f32(0), f32(1), f32(0.5)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _reach(down, level, size):
    """First and one past the last row of `size` that a half height reaches around a place."""
    return np.int32(max(down - level + ONE, ZERO)), np.int32(min(max(down + level + ONE, ZERO), f32(size)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _row(packed, rank, x, dy):
    """Of an ellipse dy px below its centre: first column, one past the last, exponent at the ridge, ridge."""
    u = dy * packed[rank, 3]
    down = u * u
    ridge = x + dy * packed[rank, 4]
    half = f32(math.sqrt(max(packed[rank, 6] - down, ZERO))) / packed[rank, 2] + f32(1e-3)
    start, end = _reach(ridge, half, TILE_WIDTH)
    return start, end, packed[rank, 5] - down, ridge


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def composite_tiles(
    elliptic, packed, ranks, slots, tile_start, tile_order, drawn, height, width, alpha_min, alpha_max, stop, t_stop,
    background, rgb, alpha, keep, state, part, parts,
):  # fmt: skip
    """See `splat_compositing.composite_tiles`; ellipses only."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    area = TILE_WIDTH * TILE_HEIGHT
    T, last, color = np.empty(area, np.float32), np.empty(area, np.float32), np.empty((area, 3), np.float32)
    for turn in range(part, len(tile_order), parts):
        t = tile_order[turn]
        begin, end = tile_start[t], tile_start[t + 1]
        x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
        rows, columns = min(TILE_HEIGHT, height - y0), min(TILE_WIDTH, width - x0)
        T[:], last[:], color[:] = ZERO, f32(-1), ZERO
        for q in range(rows):
            T[q * TILE_WIDTH : q * TILE_WIDTH + columns] = ONE
        live = 0
        for k in range(begin, end):
            if (k - begin) % BATCH == 0 and T.max() < t_stop:
                break
            rank = u64(ranks[k])
            live = k - begin + 1
            x, y = packed[rank, 0] - f32(x0) - HALF, packed[rank, 1] - f32(y0) - HALF
            r, g, b = packed[rank, ELLIPSE_COLOR], packed[rank, ELLIPSE_COLOR + 1], packed[rank, ELLIPSE_COLOR + 2]
            first, past = _reach(y, packed[rank, 8], TILE_HEIGHT)
            for q in range(first, past):
                start, stop_at, exponent, ridge = _row(packed, rank, x, f32(q) - y)
                for j in range(start, stop_at):
                    o = u64(q * TILE_WIDTH + j)
                    if T[o] <= ZERO:  # over: kept with the sign turned
                        continue
                    off = (f32(j) - ridge) * packed[rank, 2]
                    a = min(f32(2) ** (exponent - off * off), alpha_max)
                    if a < alpha_min:
                        continue
                    behind = T[o] * (ONE - a)
                    if behind <= stop:
                        T[o] = -T[o]
                        continue
                    weight = a * T[o]
                    color[o, 0] += weight * r
                    color[o, 1] += weight * g
                    color[o, 2] += weight * b
                    T[o] = behind
                    last[o] = f32(k - begin)
        drawn[t] = live
        for q in range(rows):
            for j in range(columns):
                o = q * TILE_WIDTH + j
                left = abs(T[o])
                alpha[y0 + q, x0 + j] = ONE - left
                for c in range(3):
                    rgb[y0 + q, x0 + j, c] = color[o, c] + left * background[c]
        if keep:
            for o in range(area):
                state[t * 2 * area + o] = abs(T[o])
                state[(t * 2 + 1) * area + o] = last[o]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def composite_tiles_backward(
    elliptic, packed, ranks, slots, tile_start, tile_order, drawn, height, width, alpha_min, alpha_max,
    background, grad_rgb, grad_alpha, state, gradients, part, parts,
):  # fmt: skip
    """See `splat_compositing.composite_tiles_backward`; ellipses only."""
    tiles_x = (width + TILE_WIDTH - 1) // TILE_WIDTH
    area = TILE_WIDTH * TILE_HEIGHT
    seen, pull = np.empty(area, np.float32), np.empty((area, 3), np.float32)
    for turn in range(part, len(tile_order), parts):
        t = tile_order[turn]
        begin = tile_start[t]
        x0, y0 = t % tiles_x * TILE_WIDTH, t // tiles_x * TILE_HEIGHT
        T, last = state[t * 2 * area : (t * 2 + 1) * area].copy(), state[(t * 2 + 1) * area : (t * 2 + 2) * area]
        seen[:], pull[:] = ZERO, ZERO
        for q in range(min(TILE_HEIGHT, height - y0)):
            for j in range(min(TILE_WIDTH, width - x0)):
                o, through = q * TILE_WIDTH + j, ZERO
                for c in range(3):
                    pull[o, c] = grad_rgb[y0 + q, x0 + j, c]
                    through += pull[o, c] * background[c]
                seen[o] = through - grad_alpha[y0 + q, x0 + j]
        for k in range(drawn[t] - 1, -1, -1):
            rank = u64(ranks[begin + k])
            x, y = packed[rank, 0] - f32(x0) - HALF, packed[rank, 1] - f32(y0) - HALF
            r, g, b = packed[rank, ELLIPSE_COLOR], packed[rank, ELLIPSE_COLOR + 1], packed[rank, ELLIPSE_COLOR + 2]
            first, past = _reach(y, packed[rank, 8], TILE_HEIGHT)
            s0 = sx = sy = sxx = sxy = syy = sr = sg = sb = ZERO
            for q in range(first, past):
                start, stop_at, exponent, ridge = _row(packed, rank, x, f32(q) - y)
                u = (f32(q) - y) * packed[rank, 3]
                for j in range(start, stop_at):
                    o = u64(q * TILE_WIDTH + j)
                    if last[o] < f32(k):
                        continue
                    off = (f32(j) - ridge) * packed[rank, 2]
                    footprint = f32(2) ** (exponent - off * off)
                    a = min(footprint, alpha_max)
                    if a < alpha_min:
                        continue
                    T[o] /= ONE - a
                    weight = a * T[o]
                    gr, gg, gb = pull[o, 0], pull[o, 1], pull[o, 2]
                    change = gr * r + gg * g + gb * b - seen[o]
                    seen[o] += a * change
                    sr, sg, sb = sr + weight * gr, sg + weight * gg, sb + weight * gb
                    if footprint <= alpha_max:
                        slope = weight * change
                        s0 += slope
                        sx += slope * off
                        sy += slope * u
                        sxx += slope * off * off
                        sxy += slope * off * u
                        syy += slope * u * u
            e = gradients[u64(slots[begin + k])]
            e[0], e[1], e[2], e[3], e[4], e[5] = s0, sx, sy, sxx, sxy, syy
            e[6], e[7], e[8] = sr, sg, sb
