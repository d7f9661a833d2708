"""The splat renderer on the CPU: numba, 16×16 px tiles, analytic backward pass, every core.

Three facts make it fast. An isotropic footprint is separable, so a splat costs 32 exponentials per tile instead of 256.
A tile row has 16 pixels, one 512-bit register: every row is drawn whole, without a branch, and columns outside the
footprint fall under the alpha threshold. And opacity is 1, so a tile saturates after a few layers and the rest of its
list is never looked at.

The backward pass needs no division and no subtraction of large sums. With T_k the transmittance in front of splat k,
g the gradient of a pixel and `seen_k` = g · (the colour composited from everything behind k, as if k were not there):

    dL/d alpha_k = T_k (g · c_k - seen_k),     seen_{k-1} = seen_k + alpha_k (g · c_k - seen_k),

which is a back-to-front compositing and stays accurate where 1 - alpha is 1/1000. T_k is recomputed front to back in
chunks of `CHUNK` splats from the transmittances that the forward pass stored at the start of every chunk.

Early stop: rows of pixels are left alone, at the granularity of a chunk, once no pixel above or below lets through
`T_STOP`. What is cut off changes a colour by less than T_STOP times the range of colours.

Nothing depends on the number of threads: a tile's list is in depth order however it was filled, and the gradients of a
splat are added up tile after tile.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from torch import Tensor
from torch.autograd.function import once_differentiable

from ihbench.render.splat import ALPHA_MAX, ALPHA_MIN, Splats

TILE = 16  # px
CHUNK = 32  # splats between two stored transmittances
T_STOP = 1e-5
CHANNELS = 3  # colour channels of one pass; other counts are drawn in several

f32 = np.float32
# Loop bounds and offsets are unsigned so that numba leaves out its test for negative indices, which would hide from the
# compiler that the accesses of a row are consecutive.
u64 = np.uint64
LANES = u64(TILE)
ROW = u64(4 * TILE)  # one tile row of four interleaved planes
PLANE_1, PLANE_2, PLANE_3, PLANE_4, PLANE_5 = (u64(k * TILE) for k in range(1, 6))
SPLAT = 8  # floats of a packed splat: x, y, sharpness, reach², colour, padding
GRADIENT = 6  # floats of a gradient entry: sums over dx, dy, d², colour

# reassociation and fused multiply-add only: no assumption that values are finite
_FAST = {"contract", "reassoc", "nsz", "arcp"}


def composite(
    splats: Splats,
    height: int,
    width: int,
    background: Tensor,  # [C]
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float32. `Splats` and the conventions: `ihbench.render.splat`."""
    channels = splats.colors.shape[1]
    images, alpha = [], None
    for start in range(0, channels, CHANNELS):
        colors = splats.colors[:, start : start + CHANNELS]
        bg = background[start : start + CHANNELS]
        missing = CHANNELS - colors.shape[1]
        if missing:
            colors = torch.nn.functional.pad(colors, (0, missing))
            bg = torch.nn.functional.pad(bg, (0, missing))
        rgb, group_alpha = _Composite.apply(splats.xy, splats.variance, colors, splats.depth, height, width, bg)
        images.append(rgb[..., : CHANNELS - missing] if missing else rgb)
        alpha = group_alpha if alpha is None else alpha
    return (images[0] if len(images) == 1 else torch.cat(images, -1)), alpha


class _Composite(torch.autograd.Function):
    """xy [M, 2], variance [M], colors [M, 3] -> rgb [H, W, 3], alpha [H, W]."""

    @staticmethod
    def forward(ctx, xy, variance, colors, depth, height, width, background):
        needs_gradient = any(ctx.needs_input_grad)
        xy, variance = xy.detach().double().contiguous().numpy(), variance.detach().double().contiguous().numpy()
        colors = colors.detach().float().contiguous().numpy()
        depth = depth.detach().float().contiguous().numpy()
        background = background.float().contiguous().numpy()
        workers = get_num_threads()

        order = _depth_order(xy, variance, depth.view(np.uint32), height, width, _LOG_CUTOFF)
        packed = _pack(xy, variance, colors, order, _LOG_CUTOFF)
        counts = _count_tiles(packed, height, width, workers)
        tile_start, splat_start, fill_at = _offsets(*counts)
        if tile_start[-1] > np.iinfo(np.int32).max:
            raise MemoryError(f"splats: {tile_start[-1]} pairs of splat and tile, more than this back end can index")
        ranks, slots = _fill_tiles(packed, splat_start, fill_at, tile_start[-1], height, width, workers)

        rgb, alpha = torch.empty(height, width, CHANNELS), torch.empty(height, width)
        chunk_start = _chunk_offsets(tile_start)
        stored = np.empty((chunk_start[-1] if needs_gradient else 0, TILE * TILE), f32)
        stop = _draw(
            packed, ranks, tile_start, chunk_start, background, f32(ALPHA_MIN), f32(ALPHA_MAX), f32(T_STOP),
            needs_gradient, stored, rgb.numpy(), alpha.numpy(), workers,
        )  # fmt: skip
        if needs_gradient:
            ctx.saved = (
                packed, order, ranks, slots, tile_start, splat_start, chunk_start, stored, stop, background, variance
            )  # fmt: skip
        return rgb, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx, grad_rgb, grad_alpha):
        packed, order, ranks, slots, tile_start, splat_start, chunk_start, stored, stop, background, variance = ctx.saved
        grad_rgb, grad_alpha = grad_rgb.float().contiguous().numpy(), grad_alpha.float().contiguous().numpy()
        workers = get_num_threads()
        entries = _draw_backward(
            packed, ranks, slots, tile_start, chunk_start, stored, stop, background, grad_rgb, grad_alpha,
            f32(ALPHA_MIN), f32(ALPHA_MAX), f32(T_STOP), workers,
        )  # fmt: skip
        grad_xy, grad_variance, grad_colors = _sum_gradients(entries, order, splat_start, variance)
        return (
            torch.from_numpy(grad_xy), torch.from_numpy(grad_variance), torch.from_numpy(grad_colors),
            None, None, None, None,
        )  # fmt: skip


_LOG_CUTOFF = 2 * math.log(1 / ALPHA_MIN)  # reach² / variance
_LOG2_E = math.log2(math.e)


# ---------------------------------------------------------------------------------------------------------------------
# Depth order and packing


@njit(cache=True, nogil=True)
def _depth_order(xy, variance, depth_bits, height, width, log_cutoff):
    """[M] int32: the splats that can reach a pixel centre, nearest first, equal depths by index.

    Radix sort of the bits of the float32 depths, which are positive and therefore ordered like integers.
    """
    n = len(depth_bits)
    order = np.empty(n, np.int32)
    keys = np.empty(n, np.uint32)
    m = 0
    lowest, highest = np.uint32(0xFFFFFFFF), np.uint32(0)
    for i in range(n):
        x, y = xy[i, 0], xy[i, 1]
        dx = max(0.5 - x, x - (width - 0.5), 0.0)
        dy = max(0.5 - y, y - (height - 0.5), 0.0)
        order[m] = i
        key = depth_bits[i]
        keys[m] = key
        if dx * dx + dy * dy <= variance[i] * log_cutoff:
            m += 1
            lowest = min(lowest, key)
            highest = max(highest, key)
    order, keys = order[:m], keys[:m]
    if m < 2:
        return order
    other_order, other_keys = np.empty_like(order), np.empty_like(keys)
    count = np.empty(2049, np.int64)
    spread = highest - lowest
    shift = np.uint32(0)
    while spread >> shift:
        count[:] = 0
        for i in range(m):
            count[((keys[i] - lowest) >> shift & np.uint32(2047)) + 1] += 1
        for k in range(2048):
            count[k + 1] += count[k]
        for i in range(m):
            digit = (keys[i] - lowest) >> shift & np.uint32(2047)
            at = count[digit]
            count[digit] = at + 1
            other_order[at] = order[i]
            other_keys[at] = keys[i]
        order, other_order = other_order, order
        keys, other_keys = other_keys, keys
        shift += np.uint32(11)
        if shift > 31:
            break
    return order


@njit(cache=True, nogil=True)
def _pack(xy, variance, colors, order, log_cutoff):
    """[M, SPLAT] float32 in depth order: everything that a tile reads about a splat, in half a cache line.

    Sharpness s is such that alpha = 2^-(s d)²: the exponent of a huge splat far outside the image cannot overflow.
    """
    packed = np.empty((len(order), SPLAT), np.float32)
    for rank in range(len(order)):
        i = order[rank]
        packed[rank, 0] = xy[i, 0]
        packed[rank, 1] = xy[i, 1]
        packed[rank, 2] = math.sqrt(_LOG2_E / (2 * variance[i]))
        packed[rank, 3] = min(variance[i] * log_cutoff, 1e37)
        packed[rank, 4] = colors[i, 0]
        packed[rank, 5] = colors[i, 1]
        packed[rank, 6] = colors[i, 2]
        packed[rank, 7] = 0.0
    return packed


# ---------------------------------------------------------------------------------------------------------------------
# Lists of splats per tile


@njit(cache=True, nogil=True, inline="always")
def _band(center, half, size):
    """First and one past the last tile of `size` pixels whose pixel centres come within `half` px of `center`."""
    tiles = (size + TILE - 1) // TILE
    first = math.ceil((center - half - (TILE - 0.5)) / TILE)
    last = math.floor((center + half - 0.5) / TILE)
    return int(min(max(first, 0.0), tiles)), int(min(max(last, -1.0), tiles - 1)) + 1


@njit(cache=True, nogil=True, inline="always")
def _half_width(y, reach_squared, tile_row):
    """Half the width of a circle where it is widest within a row of tiles; -1 where it does not come there."""
    top = tile_row * TILE + 0.5
    dy = max(top - y, y - (top + TILE - 1), 0.0)
    rest = reach_squared - dy * dy
    return math.sqrt(rest) if rest >= 0 else -1.0


@njit(cache=True, nogil=True, parallel=True)
def _count_tiles(packed, height, width, workers):
    """How many entries each worker's share of the splats has in each tile, and how many tiles each splat touches."""
    m = len(packed)
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    per_tile = np.zeros((workers, tiles_x * tiles_y), np.int64)
    per_splat = np.empty(m, np.int64)
    for w in prange(workers):
        for rank in range(m * w // workers, m * (w + 1) // workers):
            x, y, reach_squared = float(packed[rank, 0]), float(packed[rank, 1]), float(packed[rank, 3]) * 1.0001
            y0, y1 = _band(y, math.sqrt(reach_squared), height)
            touched = 0
            for ty in range(y0, y1):
                half = _half_width(y, reach_squared, ty)
                if half >= 0:
                    x0, x1 = _band(x, half, width)
                    for tx in range(x0, x1):
                        per_tile[w, ty * tiles_x + tx] += 1
                    touched += max(x1 - x0, 0)
            per_splat[rank] = touched
    return per_tile, per_splat


@njit(cache=True, nogil=True)
def _offsets(per_tile, per_splat):
    """Where each tile's list starts, where each splat's gradients start, where each worker writes in each tile."""
    workers, tiles = per_tile.shape
    tile_start = np.empty(tiles + 1, np.int64)
    fill_at = np.empty((workers, tiles), np.int64)
    total = 0
    for t in range(tiles):
        tile_start[t] = total
        for w in range(workers):
            fill_at[w, t] = total
            total += per_tile[w, t]
    tile_start[tiles] = total
    splat_start = np.empty(len(per_splat) + 1, np.int64)
    splat_start[0] = 0
    for rank in range(len(per_splat)):
        splat_start[rank + 1] = splat_start[rank] + per_splat[rank]
    return tile_start, splat_start, fill_at


@njit(cache=True, nogil=True, parallel=True)
def _fill_tiles(packed, splat_start, fill_at, total, height, width, workers):
    """The tiles' lists: per entry the rank of its splat, and the slot of its gradients, which lie splat by splat."""
    m = len(packed)
    tiles_x = (width + TILE - 1) // TILE
    ranks = np.empty(total, np.int32)
    slots = np.empty(total, np.int32)
    for w in prange(workers):
        for rank in range(m * w // workers, m * (w + 1) // workers):
            x, y, reach_squared = float(packed[rank, 0]), float(packed[rank, 1]), float(packed[rank, 3]) * 1.0001
            y0, y1 = _band(y, math.sqrt(reach_squared), height)
            slot = splat_start[rank]
            for ty in range(y0, y1):
                half = _half_width(y, reach_squared, ty)
                if half >= 0:
                    x0, x1 = _band(x, half, width)
                    for tx in range(x0, x1):
                        t = ty * tiles_x + tx
                        at = fill_at[w, t]
                        fill_at[w, t] = at + 1
                        ranks[at] = rank
                        slots[at] = slot
                        slot += 1
    return ranks, slots


@njit(cache=True, nogil=True)
def _chunk_offsets(tile_start):
    """Index of each tile's first stored transmittance."""
    chunk_start = np.empty_like(tile_start)
    chunk_start[0] = 0
    for t in range(len(tile_start) - 1):
        chunk_start[t + 1] = chunk_start[t] + (tile_start[t + 1] - tile_start[t] + CHUNK - 1) // CHUNK
    return chunk_start


# ---------------------------------------------------------------------------------------------------------------------
# Drawing


@njit(cache=True, nogil=True, fastmath=_FAST, inline="always")
def _power_of_half(t):
    """2^-t for t >= 0, to 1e-7 of its value; 0 is not reached, t is cut at 20."""
    t = min(t, f32(20.0))
    whole = np.int32(t + f32(0.5))
    x = f32(whole) - t
    p = f32(1.535336188319500e-4)
    p = p * x + f32(1.339887440266574e-3)
    p = p * x + f32(9.618437357674640e-3)
    p = p * x + f32(5.550332471162809e-2)
    p = p * x + f32(2.402264791363012e-1)
    p = p * x + f32(6.931472028550421e-1)
    p = p * x + f32(1.0)
    return p * np.int32((np.int32(127) - whole) << np.int32(23)).view(np.float32)


@njit(cache=True, nogil=True, fastmath=_FAST)
def _profile(sharpness, center, out, at):
    """out[at : at + 16]: the footprint along one axis of a tile, at the pixel centres 0 … 15."""
    for j in range(LANES):
        d = sharpness * (f32(j) - center)
        out[at + j] = _power_of_half(d * d)


@njit(cache=True, nogil=True, inline="always")
def _rows_reached(x, y, reach_squared, first, last):
    """Rows [first, last) of a tile narrowed to those a splat at (x, y), relative to its centres, can reach."""
    dx = max(-x, x - f32(TILE - 1), f32(0.0))
    half = math.sqrt(max(reach_squared * f32(1.0001) - dx * dx, f32(0.0)))
    a = max(math.ceil(y - half), f32(first))
    b = min(math.floor(y + half), f32(last) - f32(1.0)) + f32(1.0)
    return u64(a), u64(max(a, b))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _blend_row(tile, at, across, across_at, down, r, g, b, alpha_min, alpha_max):
    """Composite one splat over one row of a tile; planes T, r, g, b."""
    for j in range(LANES):
        alpha = min(across[across_at + j] * down, alpha_max)
        alpha = alpha if alpha >= alpha_min else f32(0.0)
        T = tile[at + j]
        weight = alpha * T
        tile[at + j] = T - weight
        tile[at + PLANE_1 + j] += weight * r
        tile[at + PLANE_2 + j] += weight * g
        tile[at + PLANE_3 + j] += weight * b


@njit(cache=True, nogil=True)
def _live_rows(T, stride, t_stop):
    """Rows [first, last) between the outermost ones with a pixel that still lets light through."""
    first, last = u64(TILE), u64(0)
    for q in range(LANES):
        most = f32(0.0)
        for j in range(LANES):
            most = max(most, T[q * stride + j])
        if most >= t_stop:
            first = min(first, q)
            last = q + u64(1)
    return first, last


@njit(cache=True, nogil=True)
def _busiest_first(load):
    """Tiles with work, the longest list first: dealt round the workers in this order, the shares come out even."""
    busy = np.flatnonzero(load)
    return busy[np.argsort(-load[busy])]


@njit(cache=True, nogil=True, parallel=True)
def _draw(
    packed, ranks, tile_start, chunk_start, background, alpha_min, alpha_max, t_stop, store, stored, rgb, alpha, workers
):
    """Fill rgb [H, W, 3] and alpha [H, W]; returns how many entries of each tile were composited."""
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    tiles = len(tile_start) - 1
    stop = np.zeros(tiles, np.int64)
    order = _busiest_first(tile_start[1:] - tile_start[:-1])
    for w in prange(workers):
        for y in range(height * w // workers, height * (w + 1) // workers):
            for x in range(width):
                alpha[y, x] = 0.0
                for c in range(CHANNELS):
                    rgb[y, x, c] = background[c]
    for w in prange(workers):
        tile = np.empty(TILE * ROW, np.float32)
        across = np.empty(TILE, np.float32)
        down = np.empty(TILE, np.float32)
        for turn in range(w, len(order), workers):
            t = order[turn]
            x0, y0 = t % tiles_x * TILE, t // tiles_x * TILE
            inside_x, inside_y = min(TILE, width - x0), min(TILE, height - y0)
            tile[:] = 0.0
            for q in range(inside_y):
                for j in range(inside_x):
                    tile[q * ROW + j] = 1.0
            first, last = u64(0), LANES
            drawn = tile_start[t + 1] - tile_start[t]
            for k in range(drawn):
                if k % CHUNK == 0:
                    first, last = _live_rows(tile, ROW, t_stop)
                    if first >= last:
                        drawn = k
                        break
                    if store:
                        chunk = chunk_start[t] + k // CHUNK
                        for q in range(TILE):
                            for j in range(TILE):
                                stored[chunk, q * TILE + j] = tile[q * ROW + j]
                splat = packed[ranks[tile_start[t] + k]]
                x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
                _profile(splat[2], x, across, u64(0))
                _profile(splat[2], y, down, u64(0))
                ya, yb = _rows_reached(x, y, splat[3], first, last)
                for q in range(ya, yb):
                    _blend_row(
                        tile, q * ROW, across, u64(0), down[q], splat[4], splat[5], splat[6], alpha_min, alpha_max
                    )
            stop[t] = drawn
            for q in range(inside_y):
                for j in range(inside_x):
                    T = tile[q * ROW + j]
                    alpha[y0 + q, x0 + j] = f32(1.0) - T
                    for c in range(CHANNELS):
                        rgb[y0 + q, x0 + j, c] = tile[q * ROW + (c + 1) * TILE + j] + T * background[c]
    return stop


# ---------------------------------------------------------------------------------------------------------------------
# The gradient


@njit(cache=True, nogil=True, fastmath=_FAST)
def _weights_row(T, at, across, across_at, down, weights, weights_at, alpha_min, alpha_max):
    """Front to back: the weight alpha T of one splat along one row, and the transmittance behind it."""
    for j in range(LANES):
        alpha = min(across[across_at + j] * down, alpha_max)
        alpha = alpha if alpha >= alpha_min else f32(0.0)
        weight = alpha * T[at + j]
        weights[weights_at + j] = weight
        T[at + j] -= weight


@njit(cache=True, nogil=True, fastmath=_FAST)
def _gradient_row(
    tile, at, across, across_at, down, dy, weights, weights_at, r, g, b, alpha_min, alpha_max, sums
):
    """Back to front: add one splat's gradients along one row to `sums`; planes seen, gradient of r, g, b."""
    for j in range(LANES):
        footprint = across[across_at + j] * down
        alpha = min(footprint, alpha_max)
        alpha = alpha if alpha >= alpha_min else f32(0.0)
        weight = weights[weights_at + j]
        gr, gg, gb = tile[at + PLANE_1 + j], tile[at + PLANE_2 + j], tile[at + PLANE_3 + j]
        seen = tile[at + j]
        change = r * gr + g * gg + b * gb - seen
        tile[at + j] = seen + alpha * change
        # d footprint / d parameter is a multiple of the footprint itself, hence the weight; none where it is cut off
        slope = weight * change if footprint <= alpha_max else f32(0.0)
        sums[j] += slope
        sums[PLANE_1 + j] += slope * dy
        sums[PLANE_2 + j] += slope * (dy * dy)
        sums[PLANE_3 + j] += weight * gr
        sums[PLANE_4 + j] += weight * gg
        sums[PLANE_5 + j] += weight * gb


@njit(cache=True, nogil=True, fastmath=_FAST)
def _sum_columns(sums, x, entries, slot):
    """Add up the columns of a tile into one gradient entry."""
    dx_sum = dy_sum = square_sum = r_sum = g_sum = b_sum = f32(0.0)
    for j in range(LANES):
        dx = f32(j) - x
        dx_sum += sums[j] * dx
        dy_sum += sums[PLANE_1 + j]
        square_sum += sums[j] * (dx * dx) + sums[PLANE_2 + j]
        r_sum += sums[PLANE_3 + j]
        g_sum += sums[PLANE_4 + j]
        b_sum += sums[PLANE_5 + j]
    entries[slot, 0] = dx_sum
    entries[slot, 1] = dy_sum
    entries[slot, 2] = square_sum
    entries[slot, 3] = r_sum
    entries[slot, 4] = g_sum
    entries[slot, 5] = b_sum


@njit(cache=True, nogil=True, parallel=True)
def _draw_backward(
    packed, ranks, slots, tile_start, chunk_start, stored, stop, background, grad_rgb, grad_alpha,
    alpha_min, alpha_max, t_stop, workers,
):  # fmt: skip
    """Gradients per entry [E, GRADIENT], splat by splat: what each tile adds to each splat."""
    height, width = grad_alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    entries = np.zeros((len(ranks), GRADIENT), np.float32)
    order = _busiest_first(stop)
    for w in prange(workers):
        tile = np.empty(TILE * ROW, np.float32)
        T = np.empty(TILE * TILE, np.float32)
        weights = np.empty(CHUNK * TILE * TILE, np.float32)
        across = np.empty(CHUNK * TILE, np.float32)
        down = np.empty(CHUNK * TILE, np.float32)
        rows = np.empty((CHUNK, 2), np.uint64)
        sums = np.empty(6 * TILE, np.float32)
        for turn in range(w, len(order), workers):
            t = order[turn]
            x0, y0 = t % tiles_x * TILE, t // tiles_x * TILE
            tile[:] = 0.0
            for q in range(min(TILE, height - y0)):
                for j in range(min(TILE, width - x0)):
                    seen = -grad_alpha[y0 + q, x0 + j]
                    for c in range(CHANNELS):
                        gradient = grad_rgb[y0 + q, x0 + j, c]
                        tile[q * ROW + (c + 1) * TILE + j] = gradient
                        seen += gradient * background[c]
                    tile[q * ROW + j] = seen
            chunks = (stop[t] + CHUNK - 1) // CHUNK
            for chunk in range(chunks - 1, -1, -1):
                for p in range(TILE * TILE):
                    T[p] = stored[chunk_start[t] + chunk, p]
                first, last = _live_rows(T, LANES, t_stop)
                begin = tile_start[t] + chunk * CHUNK
                size = min(CHUNK, stop[t] - chunk * CHUNK)
                for k in range(size):
                    splat = packed[ranks[begin + k]]
                    x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
                    _profile(splat[2], x, across, u64(k) * LANES)
                    _profile(splat[2], y, down, u64(k) * LANES)
                    ya, yb = _rows_reached(x, y, splat[3], first, last)
                    rows[k, 0], rows[k, 1] = ya, yb
                    for q in range(ya, yb):
                        _weights_row(
                            T, q * LANES, across, u64(k) * LANES, down[u64(k) * LANES + q],
                            weights, (u64(k) * LANES + q) * LANES, alpha_min, alpha_max,
                        )  # fmt: skip
                for k in range(size - 1, -1, -1):
                    splat = packed[ranks[begin + k]]
                    x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
                    sums[:] = 0.0
                    for q in range(rows[k, 0], rows[k, 1]):
                        _gradient_row(
                            tile, q * ROW, across, u64(k) * LANES, down[u64(k) * LANES + q], f32(q) - y,
                            weights, (u64(k) * LANES + q) * LANES, splat[4], splat[5], splat[6],
                            alpha_min, alpha_max, sums,
                        )  # fmt: skip
                    _sum_columns(sums, x, entries, slots[begin + k])
    return entries


@njit(cache=True, nogil=True, parallel=True)
def _sum_gradients(entries, order, splat_start, variance):
    """Entries -> gradients of xy [N, 2], variance [N], colors [N, 3]; 0 for splats that no tile has."""
    n = len(variance)
    grad_xy = np.zeros((n, 2))
    grad_variance = np.zeros(n)
    grad_colors = np.zeros((n, CHANNELS), np.float32)
    for rank in prange(len(order)):
        i = order[rank]
        gx = gy = gs = r = g = b = 0.0
        for e in range(splat_start[rank], splat_start[rank + 1]):
            gx += entries[e, 0]
            gy += entries[e, 1]
            gs += entries[e, 2]
            r += entries[e, 3]
            g += entries[e, 4]
            b += entries[e, 5]
        grad_xy[i, 0] = gx / variance[i]
        grad_xy[i, 1] = gy / variance[i]
        grad_variance[i] = gs / variance[i] / variance[i] / 2
        grad_colors[i, 0] = r
        grad_colors[i, 1] = g
        grad_colors[i, 2] = b
    return grad_xy, grad_variance, grad_colors
