"""Opaque isotropic Gaussians for the renderer on the CPU: projection, row segments, and the way back.

A circle's footprint is the product of one across and one down: 32 exponentials for a block of 256 pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ihbench.render.lanes import exp2, lanes, store, zeros
from ihbench.render.splat_tiles import TILE_HEIGHT, TILE_WIDTH, f32, fetch_slots, u64

CIRCLE = 8  # floats of a packed circle: x, y, sharpness, reach, colour, padding
CIRCLE_GRADIENT = 8  # floats of a slot: sums over dx, dy, d², colour, padding
CIRCLE_COLOR = 4  # where the colour of a packed circle begins
SEGMENT = 48  # floats prepared for a segment; a circle takes 32

_FAST = {"contract", "nsz", "arcp"}
HALF_LOG2_E = 0.5 / math.log(2)
ZERO, ONE = f32(0), f32(1)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def project_circles(
    means, scales, colors, to_pixels, offset, focal2, low_pass, near, log_cut, height, width,
    records, depth, radius, part, parts,
):  # fmt: skip
    """World Gaussians -> one part of `records` [N, CIRCLE], depth [N] float32, and the radius where asked for, [N].

    A depth of 0 marks what is not drawn: what is out of sight, behind the near plane, or has a value that is not
    finite in float32. Sharpness s is such that alpha = 2^-(s d)²: the exponent of a huge circle far outside the image
    cannot overflow.
    """
    R, t, n = to_pixels, offset, len(means)
    for at in range(n * part // parts, n * (part + 1) // parts):
        i = u64(at)
        X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        inverse = 1.0 / z
        s = np.float64(scales[i]) * inverse
        x = f32((R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) * inverse)
        y = f32((R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) * inverse)
        v, distance = f32(s * s * focal2 + low_pass), f32(z)
        bad = x - x + (y - y) + (v - v) + (distance - distance)  # NaN where one is not finite
        for c in range(u64(colors.shape[1])):
            bad += colors[i, c] - colors[i, c]
        depth[i] = ZERO
        if not (bad == ZERO and distance > near):
            continue
        dx = max(0.5 - np.float64(x), np.float64(x) - (width - 0.5), 0.0)
        dy = max(0.5 - np.float64(y), np.float64(y) - (height - 0.5), 0.0)
        cut = v * log_cut
        if len(radius) and dx * dx <= cut and dy * dy <= cut:
            radius[i] = math.sqrt(cut)
        if dx * dx + dy * dy > cut:
            continue
        depth[i] = distance
        # rounding of the reach must not lose a pixel: the alpha threshold decides in the end
        reach = f32(math.sqrt(cut)) * f32(1.00005)
        p = records[i]
        p[0], p[1], p[2], p[3] = x, y, math.sqrt(f32(HALF_LOG2_E) / v), reach
        for c in range(u64(3)):
            p[u64(CIRCLE_COLOR) + c] = colors[i, c] if c < u64(colors.shape[1]) else ZERO


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def hidden(dead, column, last_column, row, last_row):
    """Whether the 16×16 px cells under the corners of a block of at most that size let nothing through."""
    stride = TILE_WIDTH // 16 + 1
    left, right = u64(column // 16), u64(last_column // 16)
    top, bottom = u64(row // 16 * stride), u64(last_row // 16 * stride)
    return dead[top + left] & dead[top + right] & dead[bottom + left] & dead[bottom + right]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def circle_segments(packed, rank, position, x0, y0, dead, test, prepared, segments, n):
    """Cut a circle's part of a tile, whose first pixel centre is (x0, y0), into blocks of at most 16×16 px.

    `prepared` gets 16 factors across and 16 down, segments[n] first column, first row, rows, rank, position in the
    list. Returns n, advanced; with `test` not advanced where all of the splat is hidden. Whole splats only: the
    backward pass undoes each of its blocks and could not know of one left out.
    """
    x, y, sharp, reach = packed[rank, 0] - x0, packed[rank, 1] - y0, packed[rank, 2], packed[rank, 3]
    column = np.int32(max(x - reach + ONE, ZERO))
    column_end = np.int32(min(max(x + reach + ONE, ZERO), f32(TILE_WIDTH)))
    row = np.int32(max(y - reach + ONE, ZERO))
    row_end = np.int32(min(max(y + reach + ONE, ZERO), f32(TILE_HEIGHT)))
    before, alive = n, not test
    for c in range(column, column_end, 16):
        dx = (lanes() + (f32(c) - x)) * sharp
        across = exp2(zeros() - dx * dx)
        for q in range(row, row_end, 16):
            rows = min(row_end - q, 16)
            if not alive:
                alive = not hidden(dead, c, min(c + 15, column_end - 1), q, q + rows - 1)
            dy = (lanes() + (f32(q) - y)) * sharp
            store(prepared, n * SEGMENT, across)
            store(prepared, n * SEGMENT + 16, exp2(zeros() - dy * dy))
            segment = segments[u64(n)]
            segment[0], segment[1], segment[2], segment[3], segment[4] = c, q, rows, rank, position
            n += 1
    return n if alive else before


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def circle_gradients(
    slots, rank_of, slot_start, packed, depth, scales, to_pixels, focal2, first, last,
    grad_means, grad_scales, grad_colors, grad_xy, part, parts,
):  # fmt: skip
    """Slots -> one part of the gradient of colors [N, C] from channel `first` on, and with `last` of means [N, 3] and
    scales [N], for which the slots have been added up over all channels; of the centres [N, 2] px where grad_xy is
    not empty."""
    R, n = to_pixels, len(rank_of)
    channels = min(grad_colors.shape[1] - first, 3)
    for at in range(n * part // parts, n * (part + 1) // parts):
        fetch_slots(slots, rank_of, slot_start, packed, at)
        i = u64(at)
        if rank_of[i] < 0:
            for c in range(channels):
                grad_colors[i, first + c] = ZERO
            if last:
                grad_scales[i] = grad_means[i, 0] = grad_means[i, 1] = grad_means[i, 2] = ZERO
            continue
        rank = u64(rank_of[i])
        sx = sy = sd = r = g = b = 0.0
        for k in range(slot_start[rank], slot_start[rank + u64(1)]):
            e = slots[u64(k)]
            sx, sy, sd = sx + e[0], sy + e[1], sd + e[2]
            r, g, b = r + e[3], g + e[4], b + e[5]
        grad_colors[i, first] = r
        if channels > 1:
            grad_colors[i, first + 1] = g
        if channels > 2:
            grad_colors[i, first + 2] = b
        if not last:
            continue
        sharp, inverse, s = np.float64(packed[rank, 2]), 1.0 / np.float64(depth[i]), np.float64(scales[i])
        per_variance = sharp * sharp / HALF_LOG2_E
        gx, gy = sx * per_variance, sy * per_variance  # along the centre
        gs = focal2 * s * inverse * inverse * (sd * per_variance * per_variance)  # along the scale
        grad_scales[i] = gs
        if len(grad_xy):
            grad_xy[i, 0], grad_xy[i, 1] = gx, gy
        px, py = gx * inverse, gy * inverse
        pz = -(gx * packed[rank, 0] + gy * packed[rank, 1] + gs * s) * inverse
        for c in range(3):
            grad_means[i, c] = R[0, c] * px + R[1, c] * py + R[2, c] * pz
