"""General Gaussians for the renderer on the CPU: records, row segments, and the way back to the covariance.

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
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, f32, fetch_slots, u64

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


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def ellipse_record(record, x, y, xx, both, yy, opacity, alpha_min, height, width):
    """Fill all but the colour of `record` [ELLIPSE]; returns whether the ellipse can reach a pixel.

    It cannot with an opacity under `alpha_min`, without an inverse covariance, or where no pixel centre lies in its
    box.
    """
    determinant = xx * yy - both * both
    if not opacity >= alpha_min or not determinant > 0:
        return False
    log2_opacity = math.log2(opacity)
    # rounding of the level must not lose a pixel: the alpha threshold decides in the end
    level = max(log2_opacity - math.log2(alpha_min), 0.0) * 1.0001 + 1e-5
    half_x, half_y = math.sqrt(level * LOG_4 * xx) * 1.00001, math.sqrt(level * LOG_4 * yy) * 1.00001
    beside_x, beside_y = max(0.5 - x, x - (width - 0.5)), max(0.5 - y, y - (height - 0.5))
    if beside_x > half_x or beside_y > half_y:
        return False
    record[0], record[1] = x, y
    across = determinant / yy  # the variance within a row
    record[2], record[3] = math.sqrt(HALF_LOG2_E / across), math.sqrt(HALF_LOG2_E / yy)
    record[4], record[5], record[6] = both / yy, log2_opacity, level
    record[7], record[8] = min(half_x, FARTHEST), min(half_y, FARTHEST)
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def ellipse_records(xy, covariance, opacity, colors, alpha_min, height, width, records, depth, part, parts):
    """Fill one part of `records` [N, ELLIPSE] from projected ellipses; the depth of those out of sight becomes 0."""
    n, channels = len(xy), min(colors.shape[1], 3)
    for i in range(n * part // parts, n * (part + 1) // parts):
        if not ellipse_record(
            records[i], xy[i, 0], xy[i, 1], covariance[i, 0], covariance[i, 1], covariance[i, 2], opacity[i],
            alpha_min, height, width,
        ):  # fmt: skip
            depth[i] = ZERO
        for c in range(channels):
            records[i, ELLIPSE_COLOR + c] = colors[i, c]


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
        if not alive:
            alive = column_end - column > 16 or not hidden(dead, column, column_end - 1, q, q + rows - 1)
        for shift in range(0, widest, 16):
            at = smaller(start + f32(shift), right)
            store(prepared, n * SEGMENT, at)
            store(prepared, n * SEGMENT + 16, packed[rank, 5] - down)
            store(prepared, n * SEGMENT + 32, at - ridge)
            segment = segments[u64(n)]
            segment[1], segment[2], segment[3], segment[4] = q, rows, rank, position
            n += 1
    return n if alive else before


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def ellipse_sums(slots, begin, end, packed):
    """A splat's slots -> gradients along its centre (x, y), covariance (xx, xy, yy) and ln opacity, and its colour.

    With K the inverse covariance and s the slope along ln alpha at a pixel d px away: sum(s) K d along the centre,
    sum(s) K d dᵀ K / 2 along the covariance, of which the off-diagonal entry stands for two.
    """
    s0 = st = su = stt = stu = suu = r = g = b = 0.0
    for k in range(begin, end):
        e = slots[u64(k)]
        s0, st, su = s0 + e[0], st + e[1], su + e[2]
        stt, stu, suu = stt + e[3], stu + e[4], suu + e[5]
        r, g, b = r + e[6], g + e[7], b + e[8]
    # (t, u) = (sharp_x (dx - shear dy), sharp_y dy), and 2 ln 2 sharp² is one over the variance
    across, down, shear = LOG_4 * packed[2], LOG_4 * packed[3], np.float64(packed[4])
    x = across * st
    xx, xy, yy = across * across * stt / 2, across * down * stu / 2, down * down * suu / 2
    covariance = xx, 2 * (xy - shear * xx), yy - 2 * shear * xy + shear * shear * xx
    return (x, down * su - shear * x), covariance, s0, (r, g, b)


@njit(cache=True, nogil=True, error_model="numpy")
def ellipse_gradients(
    slots, rank_of, slot_start, packed, opacity, first, last, grad_xy, grad_covariance, grad_opacity, grad_colors,
    part, parts,
):  # fmt: skip
    """Slots -> one part of the gradient of colors [N, C] from channel `first` on, and with `last` of xy [N, 2],
    covariance [N, 3] and opacity [N], for which the slots have been added up over all channels."""
    n, channels = len(rank_of), min(grad_colors.shape[1] - first, 3)
    for i in range(n * part // parts, n * (part + 1) // parts):
        fetch_slots(slots, rank_of, slot_start, packed, i)
        if rank_of[i] < 0:
            continue
        rank = u64(rank_of[i])
        center, covariance, s0, color = ellipse_sums(slots, slot_start[rank], slot_start[rank + u64(1)], packed[rank])
        for c in range(channels):
            grad_colors[i, first + c] = color[c]
        if last:
            grad_xy[i, 0], grad_xy[i, 1] = center
            grad_covariance[i, 0], grad_covariance[i, 1], grad_covariance[i, 2] = covariance
            grad_opacity[i] = s0 / opacity[i]
