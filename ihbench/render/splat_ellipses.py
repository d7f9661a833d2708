"""General Gaussians for the renderer on the CPU: packing, row segments, and the way back to the covariance.

The exponent of a footprint is written as two squares, (dx - shear dy)² / Var(x | y) + dy² / Var(y) with
shear = Cov(x, y) / Var(y). Each is exact to float32 however thin a needle is, where the inverse covariance's
A dx² + 2 B dx dy + C dy² is the small difference of large numbers. Moments for the gradient are kept in the same
coordinates, divided by the standard deviations, for the same reason.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ihbench.render.lanes import (
    at_least,
    broadcast,
    floor,
    lanes,
    larger,
    largest,
    root,
    select,
    smaller,
    store,
    zeros,
)
from ihbench.render.splat_circles import SEGMENT, hidden
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, close_tiles, count_tiles, f32, u64

# floats of a packed ellipse: x, y, sharpness across a row and down, shear, log2 opacity, level (the exponent where
# alpha ends), half width, half height, colour, padding
ELLIPSE = 16
ELLIPSE_COLOR = 9
ELLIPSE_GRADIENT = 12  # floats of a slot: sums of slope × (1, t, u, t², t u, u²), colour, padding

_FAST = {"contract", "nsz", "arcp"}
HALF_LOG2_E = 0.5 / math.log(2)
LOG_4 = 2 * math.log(2)
FARTHEST = 1e18  # px; a reach that float32 can square
ZERO, ONE = f32(0), f32(1)


@njit(cache=True, nogil=True, error_model="numpy")
def visible_ellipses(xy, covariance, opacity, depth, alpha_min, height, width, order, keys):
    """The splats whose footprint's box can hold a pixel centre, and the bits of their depth; how many, and the range.

    Left out are those with an opacity under `alpha_min`, and where the covariance has no inverse.
    """
    m, lowest, highest = 0, np.uint32(0xFFFFFFFF), np.uint32(0)
    bits = depth.view(np.uint32)
    for i in range(len(depth)):
        order[m] = i
        key = bits[i]
        keys[m] = key
        xx, both, yy = covariance[i, 0], covariance[i, 1], covariance[i, 2]
        if not opacity[i] >= alpha_min or not xx * yy - both * both > 0:
            continue
        cut = 2 * math.log(opacity[i] / alpha_min) * 1.0001 + 1e-5
        dx = max(0.5 - xy[i, 0], xy[i, 0] - (width - 0.5), 0.0)
        dy = max(0.5 - xy[i, 1], xy[i, 1] - (height - 0.5), 0.0)
        if dx * dx <= xx * cut and dy * dy <= yy * cut:
            m += 1
            lowest, highest = min(lowest, key), max(highest, key)
    return m, lowest, highest


@njit(cache=True, nogil=True, error_model="numpy")
def pack_ellipses(
    xy, covariance, opacity, colors, first, order, alpha_min, alpha_max, t_stop, height, width,
    packed, boxes, counts, closed, let_through, slot_start,
):  # fmt: skip
    """Fill `packed` [M, ELLIPSE] in depth order and what `splat_tiles` wants; returns the number of entries.

    `packed` comes with colours of 0; they are channel `first` and the two after it.
    """
    entries = 0
    channels = min(colors.shape[1] - first, 3)
    log2_min = math.log2(alpha_min)
    for rank in range(len(order)):
        i, p = u64(order[rank]), packed[u64(rank)]
        xx, both, yy = covariance[i, 0], covariance[i, 1], covariance[i, 2]
        across = (xx * yy - both * both) / yy  # the variance within a row
        log2_opacity = math.log2(opacity[i])
        # rounding of the level must not lose a pixel: the alpha threshold decides in the end
        level = max(log2_opacity - log2_min, 0.0) * 1.0001 + 1e-5
        half_x, half_y = math.sqrt(level * LOG_4 * xx) * 1.00001, math.sqrt(level * LOG_4 * yy) * 1.00001
        p[0], p[1] = xy[i, 0], xy[i, 1]
        p[2], p[3] = math.sqrt(HALF_LOG2_E / across), math.sqrt(HALF_LOG2_E / yy)
        p[4], p[5], p[6] = both / yy, log2_opacity, level
        p[7], p[8] = min(half_x, FARTHEST), min(half_y, FARTHEST)
        for c in range(channels):
            p[ELLIPSE_COLOR + c] = colors[i, first + c]
        slot_start[rank] = entries
        entries += count_tiles(rank, p[0], p[1], p[7], p[8], height, width, boxes, counts, closed)
        if p[7] > f32(TILE_WIDTH / 2) and p[8] > f32(TILE_HEIGHT / 2):  # a smaller ellipse hides no tile
            close_tiles(
                rank, p[0], p[1], p[4], p[2], p[3], p[5], alpha_min, alpha_max, t_stop, width, boxes, let_through,
                closed,
            )  # fmt: skip
    slot_start[len(order)] = entries
    return entries


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def ellipse_segments(packed, rank, position, x0, y0, dead, test, prepared, segments, n):
    """Cut an ellipse's part of a tile, whose first pixel centre is (x0, y0), into up to 16 rows of 16 px each.

    Every row has a start of its own: `prepared` gets per row the first column, the exponent at the ridge, and how far
    the first column lies from the ridge, px; segments[n] 0, first row, rows, rank, position in the list. Returns n,
    advanced; with `test` not advanced where all of the splat is hidden. Whole splats only: the backward pass undoes
    each of its segments and could not know of one left out.
    """
    x, y, half_y, right = packed[rank, 0] - x0, packed[rank, 1] - y0, packed[rank, 8], broadcast(f32(TILE_WIDTH))
    row = np.int32(max(y - half_y + ONE, ZERO))
    row_end = np.int32(min(max(y + half_y + ONE, ZERO), f32(TILE_HEIGHT)))
    before, alive = n, not test
    for q in range(row, row_end, 16):
        rows = min(row_end - q, 16)
        dy = lanes() + (f32(q) - y)
        down = dy * packed[rank, 3]
        down = down * down
        ridge = dy * packed[rank, 4] + x
        half = root(larger(packed[rank, 6] - down, zeros())) / packed[rank, 2] + f32(1e-3)
        start = floor(smaller(larger(ridge - half + ONE, zeros()), right))
        end = floor(smaller(larger(ridge + half + ONE, zeros()), right))
        inside = at_least(broadcast(f32(rows) - f32(0.5)), lanes())
        widest = np.int32(largest(select(inside, end - start, zeros())))
        if widest <= 0:
            continue
        column = np.int32(-largest(select(inside, zeros() - start, zeros() - right)))
        column_end = np.int32(largest(select(inside, end, zeros())))
        alive |= column_end - column > 16 or not hidden(dead, column, column_end - 1, q, q + rows - 1)
        for shift in range(0, widest, 16):
            at = smaller(start + f32(shift), right)
            store(prepared, n * SEGMENT, at)
            store(prepared, n * SEGMENT + 16, packed[rank, 5] - down)
            store(prepared, n * SEGMENT + 32, at - ridge)
            segments[n, 1], segments[n, 2], segments[n, 3], segments[n, 4] = q, rows, rank, position
            n += 1
    return n if alive else before


@njit(cache=True, nogil=True, error_model="numpy")
def ellipse_gradients(
    slots, order, slot_start, packed, opacity, first, grad_xy, grad_covariance, grad_opacity, grad_colors, part, parts
):
    """Slots -> one part of the gradients of xy [N, 2], covariance [N, 3], opacity [N], colors [N, C]; added to all
    but the last.

    With K the inverse covariance and s the slope along ln alpha at a pixel d px away: sum(s) K d along the centre,
    sum(s) K d dᵀ K / 2 along the covariance, of which the off-diagonal entry stands for two.
    """
    m = len(order)
    channels = min(grad_colors.shape[1] - first, 3)
    for rank in range(m * part // parts, m * (part + 1) // parts):
        i = u64(order[rank])
        s0 = st = su = stt = stu = suu = r = g = b = 0.0
        for k in range(slot_start[rank], slot_start[rank + 1]):
            e = slots[k]
            s0, st, su = s0 + e[0], st + e[1], su + e[2]
            stt, stu, suu = stt + e[3], stu + e[4], suu + e[5]
            r, g, b = r + e[6], g + e[7], b + e[8]
        # (t, u) = (sharp_x (dx - shear dy), sharp_y dy), and 2 ln 2 sharp² is one over the variance
        across, down, shear = LOG_4 * packed[rank, 2], LOG_4 * packed[rank, 3], np.float64(packed[rank, 4])
        gx = across * st
        grad_xy[i, 0] += gx
        grad_xy[i, 1] += down * su - shear * gx
        xx, xy, yy = across * across * stt / 2, across * down * stu / 2, down * down * suu / 2
        grad_covariance[i, 0] += xx
        grad_covariance[i, 1] += 2 * (xy - shear * xx)
        grad_covariance[i, 2] += yy - 2 * shear * xy + shear * shear * xx
        grad_opacity[i] += s0 / opacity[i]
        grad_colors[i, first] = r
        if channels > 1:
            grad_colors[i, first + 1] = g
        if channels > 2:
            grad_colors[i, first + 2] = b
