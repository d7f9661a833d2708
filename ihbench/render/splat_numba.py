"""The splat renderer on the CPU: numba, 16×16 px tiles, analytic backward pass, every core.

Three facts make it fast. An isotropic footprint is separable, so a splat costs 32 exponentials per tile instead of
256. A tile row has 16 pixels, one 512-bit register: every row is drawn whole, without a branch, and columns outside
the footprint fall under the alpha threshold. And opacity is 1, so a tile saturates after a few layers and the rest of
its list is never looked at.

The backward pass needs no division and no subtraction of large sums. With T_k the transmittance in front of splat k,
g the gradient of a pixel and `seen_k` = g · (the colour composited from everything behind k, as if alone):

    dL/d alpha_k = T_k (g · c_k - seen_k),     seen_{k-1} = seen_k + alpha_k (g · c_k - seen_k),

which is a back-to-front compositing and stays accurate where 1 - alpha is 1/1000. T_k is recomputed front to back in
chunks of `CHUNK` splats from the transmittances that the forward pass stored at the start of every chunk.

Early stop: at the start of a chunk the outer rows of a tile in which no pixel lets through `T_STOP` are left out of
it, and the tile ends when all are. That changes a colour by less than T_STOP times the range of colours, and the
gradient of an alpha by less than T_STOP / (1 - alpha) times that range.

Nothing depends on the number of threads: a tile's list is in depth order however it was filled, and the gradients of
a splat are added up tile after tile. The threads are Python's (the kernels release the lock), not numba's: numba's
OpenMP threads and torch's wait for work by spinning, and on a busy machine each kept the other from its core, which
made an iteration up to twenty times slower.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, Splats

TILE = 16  # px
CHUNK = 32  # splats between two stored transmittances
T_STOP = 1e-5  # a transmittance below it counts as none
PARTS = 32  # the tiles are dealt into as many hands, and the threads take one hand after the other
SHARES = 8  # parts of the splats that are binned side by side; fixed, so that the threads cannot change the lists
CHANNELS = 3  # colour channels of one pass; other counts are drawn in several

f32 = np.float32
# Two things keep the loops over a row vector instructions. Offsets and bounds are unsigned, so that numba leaves out
# its test for negative indices, which hides that the accesses are consecutive. And where the body is small, the count
# of lanes is an argument: a constant would make LLVM unroll the loop into scalars before it looks for vectors.
u64 = np.uint64
LANES = u64(TILE)
AREA = u64(TILE * TILE)
ROW = u64(4 * TILE)  # one tile row of four interleaved planes
PLANE_1, PLANE_2, PLANE_3, PLANE_4, PLANE_5 = (u64(k * TILE) for k in range(1, 6))
LOG_CUTOFF = 2 * math.log(1 / ALPHA_MIN)  # reach² / variance
LOG2_E = math.log2(math.e)
SPLAT = 8  # floats of a packed splat: x, y, sharpness, reach², colour, padding
GRADIENT = 6  # floats of a gradient entry: sums over dx, dy, d², colour

# No assumption that values are finite. And no reassociation: the process that compiles a kernel and those that load
# it from the cache summed in different orders, so that a first run differed from its repetition in the last bit.
_FAST = {"contract", "nsz", "arcp"}


def composite(
    splats: Splats,
    height: int,
    width: int,
    background: Tensor,  # [C]
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float32. `Splats` and the conventions: `ihbench.render.splat`."""
    xy, variance, depth, colors = splats.xy, splats.variance, splats.depth, splats.colors
    # autograd switches the grad mode off inside a Function, so whether to keep anything is decided here
    keep = torch.is_grad_enabled() and (xy.requires_grad or variance.requires_grad or colors.requires_grad)
    channels = colors.shape[1]
    if channels == CHANNELS:
        return _composite(xy, variance, colors, depth, height, width, background, keep)
    padding = (0, -channels % CHANNELS)
    groups = [
        _composite(xy, variance, c, depth, height, width, bg, keep)
        for c, bg in zip(
            torch.nn.functional.pad(colors, padding).split(CHANNELS, 1),
            torch.nn.functional.pad(background, padding).split(CHANNELS),
            strict=True,
        )
    ]
    return torch.cat([rgb for rgb, _ in groups], -1)[..., :channels], groups[0][1]


class _Composite(torch.autograd.Function):
    """xy [M, 2], variance [M], colors [M, 3] -> rgb [H, W, 3], alpha [H, W]."""

    @staticmethod
    def forward(ctx: Any, xy, variance, colors, depth, height, width, background, keep) -> Any:
        xy, variance = xy.detach().double().contiguous().numpy(), variance.detach().double().contiguous().numpy()
        colors = colors.detach().float().contiguous().numpy()
        depth = depth.detach().float().contiguous().numpy()
        background = background.float().contiguous().numpy()
        order = _depth_order(xy, variance, depth.view(np.uint32), height, width, LOG_CUTOFF)
        packed = _pack(xy, variance, colors, order, LOG_CUTOFF)
        tiles = -(-height // TILE) * -(-width // TILE)
        cursor, splat_start = np.zeros((SHARES, tiles), np.int64), np.zeros(len(order) + 1, np.int64)
        nothing = np.empty((0, SPLAT), f32), np.empty(0, np.int32)
        limits = ALPHA_MIN, ALPHA_MAX, T_STOP
        _run(_bin, SHARES, packed, height, width, *limits, False, cursor, splat_start, *nothing)
        tile_start, chunk_start = _offsets(cursor, splat_start)
        total = tile_start[-1]
        if total > np.iinfo(np.int32).max:
            raise MemoryError(f"splats: {total} pairs of splat and tile, more than this back end can index")
        entries, positions = np.empty((total, SPLAT), f32), np.empty(total, np.int32)
        _run(_bin, SHARES, packed, height, width, *limits, True, cursor, splat_start, entries, positions)

        rgb, alpha = torch.empty(height, width, CHANNELS), torch.empty(height, width)
        stored = np.empty((chunk_start[-1] if keep else 0, TILE * TILE), f32)
        stop = np.zeros(tiles, np.int64)
        tile_order = _busiest_first(tile_start)
        limits = f32(ALPHA_MIN), f32(ALPHA_MAX), f32(T_STOP)
        _run(
            _draw, PARTS, entries, tile_start, chunk_start, tile_order, background, *limits, LANES,
            keep, stored, stop, rgb.numpy(), alpha.numpy(),
        )  # fmt: skip
        if keep:
            ctx.saved = (
                order, entries, positions, tile_start, splat_start, chunk_start, tile_order, stored, stop,
                background, variance,
            )  # fmt: skip
        return rgb, alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        grad_rgb, grad_alpha = grad_outputs
        (
            order, entries, positions, tile_start, splat_start, chunk_start, tile_order, stored, stop,
            background, variance,
        ) = ctx.saved  # fmt: skip
        gradients = np.empty((len(entries), GRADIENT), f32)
        _run(
            _draw_backward, PARTS, entries, tile_start, chunk_start, tile_order, stored, stop, background,
            grad_rgb.float().contiguous().numpy(), grad_alpha.float().contiguous().numpy(),
            f32(ALPHA_MIN), f32(ALPHA_MAX), f32(T_STOP), LANES, gradients,
        )  # fmt: skip
        n = len(variance)
        grad_xy, grad_variance, grad_colors = np.zeros((n, 2)), np.zeros(n), np.zeros((n, CHANNELS), f32)
        _run(
            _sum_gradients, PARTS, gradients, positions, order, splat_start, variance,
            grad_xy, grad_variance, grad_colors,
        )  # fmt: skip
        return (
            torch.from_numpy(grad_xy), torch.from_numpy(grad_variance), torch.from_numpy(grad_colors),
            None, None, None, None, None,
        )  # fmt: skip


_composite: Callable[..., tuple[Tensor, Tensor]] = _Composite.apply


def _run(kernel: Callable[..., None], parts: int, *args: Any) -> None:
    """kernel(*args, part) for every part, on as many threads as torch uses; who is free takes the next part."""
    left = iter(range(parts))

    def work() -> None:
        for part in left:
            kernel(*args, part)

    helpers = min(torch.get_num_threads(), parts) - 1
    futures = [_pool(helpers).submit(work) for _ in range(helpers)]
    work()
    for future in futures:
        if not future.cancel():  # a helper that has not begun yet is not needed any more
            future.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="splat")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


# ----------------------------------------------------------------------------------------------------
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
        packed[rank, 2] = math.sqrt(LOG2_E / (2 * variance[i]))
        packed[rank, 3] = min(variance[i] * log_cutoff, 1e37)
        packed[rank, 4] = colors[i, 0]
        packed[rank, 5] = colors[i, 1]
        packed[rank, 6] = colors[i, 2]
        packed[rank, 7] = 0.0
    return packed


# ----------------------------------------------------------------------------------------------------
# Lists of splats per tile


@njit(cache=True, nogil=True, forceinline=True)
def _band(center, half, size):
    """First and one past the last tile of an axis of `size` px with a pixel centre within `half` px of `center`."""
    tiles = (size + TILE - 1) // TILE
    first = math.ceil((center - half - (TILE - 0.5)) / TILE)
    last = math.floor((center + half - 0.5) / TILE)
    return int(min(max(first, 0.0), tiles)), int(min(max(last, -1.0), tiles - 1)) + 1


@njit(cache=True, nogil=True)
def _bin(packed, height, width, alpha_min, alpha_max, t_stop, fill, cursor, splat_start, entries, positions, share):
    """Visit one share's (splat, tile) pair whose circle reaches a pixel centre of the tile.

    First call (`fill` false): counts the pairs into `cursor` [SHARES, tiles] and `splat_start` [M + 1]. Second call:
    with both turned into offsets by `_offsets`, writes the tiles' lists `entries` [E, SPLAT] and, splat by splat,
    where its entries lie, `positions` [E].

    The lists hold copies of the splats, because a tile reads its list in order and looking the splats up instead
    would miss the cache at every one. A pair is left out where splats in front that cover the whole tile let through
    less than `t_stop`; without that, a few thousand huge splats would fill the memory.
    """
    m = len(packed)
    tiles_x = (width + TILE - 1) // TILE
    let_through = np.ones(cursor.shape[1], np.float32)  # at most, per tile, by this share's splats so far
    for rank in range(m * share // SHARES, m * (share + 1) // SHARES):
        # float32 rounding of the reach must not lose a pixel: the alpha threshold decides in the end
        x, y, reach_squared = float(packed[rank, 0]), float(packed[rank, 1]), float(packed[rank, 3]) * 1.0001
        reach = math.sqrt(reach_squared)
        covers = reach > 4 * TILE  # a smaller splat hides no tile
        y0, y1 = _band(y, reach, height)
        touched = 0
        for ty in range(y0, y1):
            top = ty * TILE + 0.5
            dy = max(top - y, y - (top + TILE - 1), 0.0)
            half = reach
            if dy > 0:
                half = math.sqrt(max(reach_squared - dy * dy, 0.0))
            x0, x1 = _band(x, half, width)
            for tx in range(x0, x1):
                t = ty * tiles_x + tx
                if let_through[t] < t_stop:
                    continue
                if covers:
                    left = tx * TILE + 0.5
                    far_x, far_y = max(x - left, left + TILE - 1 - x), max(y - top, top + TILE - 1 - y)
                    exponent = (far_x * far_x + far_y * far_y) * float(packed[rank, 2]) ** 2
                    least = math.exp(-exponent / LOG2_E)  # alpha in the corner that is farthest away
                    if least > 2 * alpha_min:
                        let_through[t] *= max(1 - least, 1 - alpha_max)
                at = cursor[share, t]
                cursor[share, t] = at + 1
                if fill:
                    for k in range(SPLAT):
                        entries[at, k] = packed[rank, k]
                    positions[splat_start[rank] + touched] = at
                touched += 1
        if not fill:
            splat_start[rank] = touched


@njit(cache=True, nogil=True)
def _offsets(cursor, splat_start):
    """Counts -> offsets, in place: where each share writes in each tile's list, where each splat's positions start.

    Returns where each tile's list starts, and the index of its first stored transmittance.
    """
    shares, tiles = cursor.shape
    tile_start = np.empty(tiles + 1, np.int64)
    chunk_start = np.empty(tiles + 1, np.int64)
    total = chunks = 0
    for t in range(tiles):
        tile_start[t] = total
        chunk_start[t] = chunks
        for share in range(shares):
            count = cursor[share, t]
            cursor[share, t] = total
            total += count
        chunks += (total - tile_start[t] + CHUNK - 1) // CHUNK
    tile_start[tiles] = total
    chunk_start[tiles] = chunks
    start = 0
    for rank in range(len(splat_start)):
        count = splat_start[rank]
        splat_start[rank] = start
        start += count
    return tile_start, chunk_start


# ----------------------------------------------------------------------------------------------------
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
def _profiles(sharpness, x, y, out, at):
    """out[at : at + 16] and the next 16: the footprint across and down a tile, at the pixel centres 0 … 15."""
    for j in range(LANES):
        d = sharpness * (f32(j) - x)
        out[at + j] = _power_of_half(d * d)
    for j in range(LANES):
        d = sharpness * (f32(j) - y)
        out[at + LANES + j] = _power_of_half(d * d)


@njit(cache=True, nogil=True)
def _rows_reached(x, y, reach_squared, first, last):
    """Rows [first, last) of a tile narrowed to those a splat at (x, y), relative to its centres, can reach."""
    dx = max(-x, x - f32(TILE - 1), f32(0.0))
    half = math.sqrt(max(reach_squared * f32(1.0001) - dx * dx, f32(0.0)))
    a = max(math.ceil(y - half), f32(first))
    b = min(math.floor(y + half), f32(last) - f32(1.0)) + f32(1.0)
    return u64(a), u64(max(a, b))


@njit(cache=True, nogil=True, fastmath=_FAST)
def _blend(tile, profiles, first, last, r, g, b, alpha_min, alpha_max):
    """Composite one splat over the rows [first, last) of a tile; planes T, r, g, b."""
    for q in range(first, last):
        down = profiles[LANES + q]
        at = q * ROW
        for j in range(LANES):
            alpha = min(profiles[j] * down, alpha_max)
            alpha = alpha if alpha >= alpha_min else f32(0.0)
            T = tile[at + j]
            weight = alpha * T
            tile[at + j] = T - weight
            tile[at + PLANE_1 + j] += weight * r
            tile[at + PLANE_2 + j] += weight * g
            tile[at + PLANE_3 + j] += weight * b


@njit(cache=True, nogil=True, fastmath=_FAST)
def _live_rows(T, stride, t_stop, lanes):
    """Rows [first, last) between the outermost ones with a pixel that still lets light through."""
    first, last = u64(TILE), u64(0)
    for q in range(LANES):
        alive = 0
        for j in range(lanes):
            alive += T[q * stride + j] >= t_stop
        if alive:
            first = min(first, q)
            last = q + u64(1)
    return first, last


def _busiest_first(tile_start: NDArray[np.int64]) -> NDArray[np.int64]:
    """Tiles with work, the longest list first: dealt round in this order, the hands come out even."""
    load = np.diff(tile_start)
    order = np.argsort(-load, kind="stable")
    return order[: np.count_nonzero(load)]


@njit(cache=True, nogil=True)
def _draw(
    entries, tile_start, chunk_start, tile_order, background, alpha_min, alpha_max, t_stop, lanes,
    store, stored, stop, rgb, alpha, part,
):  # fmt: skip
    """Fill one part of rgb [H, W, 3] and alpha [H, W], and of `stop`: how many entries of a tile were composited."""
    height, width = alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    for t in range(part, len(stop), PARTS):
        if tile_start[t] == tile_start[t + 1]:
            for y in range(t // tiles_x * TILE, min(t // tiles_x * TILE + TILE, height)):
                for x in range(t % tiles_x * TILE, min(t % tiles_x * TILE + TILE, width)):
                    alpha[y, x] = 0.0
                    for c in range(CHANNELS):
                        rgb[y, x, c] = background[c]
    tile = np.empty(TILE * ROW, np.float32)
    profiles = np.empty(2 * TILE, np.float32)
    for turn in range(part, len(tile_order), PARTS):
        t = tile_order[turn]
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
                first, last = _live_rows(tile, ROW, t_stop, lanes)
                if first >= last:
                    drawn = k
                    break
                if store:
                    chunk = chunk_start[t] + k // CHUNK
                    for q in range(TILE):
                        for j in range(TILE):
                            stored[chunk, q * TILE + j] = tile[q * ROW + j]
            splat = entries[tile_start[t] + k]
            x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
            _profiles(splat[2], x, y, profiles, u64(0))
            ya, yb = _rows_reached(x, y, splat[3], first, last)
            _blend(tile, profiles, ya, yb, splat[4], splat[5], splat[6], alpha_min, alpha_max)
        stop[t] = drawn
        for q in range(inside_y):
            for j in range(inside_x):
                T = tile[q * ROW + j]
                alpha[y0 + q, x0 + j] = f32(1.0) - T
                for c in range(CHANNELS):
                    rgb[y0 + q, x0 + j, c] = tile[q * ROW + (c + 1) * TILE + j] + T * background[c]


# ----------------------------------------------------------------------------------------------------
# The gradient


@njit(cache=True, nogil=True, fastmath=_FAST)
def _weigh(T, profiles, at, first, last, weights, weights_at, alpha_min, alpha_max, lanes):
    """Front to back: the weights alpha T of one splat on the rows [first, last), and the transmittance behind it."""
    for q in range(first, last):
        down = profiles[at + LANES + q]
        row = q * LANES
        for j in range(lanes):
            alpha = min(profiles[at + j] * down, alpha_max)
            alpha = alpha if alpha >= alpha_min else f32(0.0)
            before = T[row + j]
            weight = alpha * before
            T[row + j] = before - weight
            weights[weights_at + row + j] = weight


@njit(cache=True, nogil=True, fastmath=_FAST)
def _gradient(
    tile, profiles, at, first, last, weights, weights_at, x, y, r, g, b, alpha_min, alpha_max, sums, gradients, e
):
    """Back to front: one splat's gradients from the rows [first, last); planes seen, gradient of r, g, b."""
    sums[:] = f32(0.0)
    for q in range(first, last):
        down = profiles[at + LANES + q]
        dy = f32(q) - y
        row = q * ROW
        weights_row = weights_at + q * LANES
        for j in range(LANES):
            footprint = profiles[at + j] * down
            alpha = min(footprint, alpha_max)
            alpha = alpha if alpha >= alpha_min else f32(0.0)
            weight = weights[weights_row + j]
            gr, gg, gb = tile[row + PLANE_1 + j], tile[row + PLANE_2 + j], tile[row + PLANE_3 + j]
            seen = tile[row + j]
            change = r * gr + g * gg + b * gb - seen
            tile[row + j] = seen + alpha * change
            # d footprint / d parameter is a multiple of the footprint, hence the weight; none where it is cut off
            slope = weight * change if footprint <= alpha_max else f32(0.0)
            sums[j] += slope
            sums[PLANE_1 + j] += slope * dy
            sums[PLANE_2 + j] += slope * (dy * dy)
            sums[PLANE_3 + j] += weight * gr
            sums[PLANE_4 + j] += weight * gg
            sums[PLANE_5 + j] += weight * gb
    gx = gy = gs = sum_r = sum_g = sum_b = f32(0.0)
    for j in range(LANES):
        dx = f32(j) - x
        gx += sums[j] * dx
        gy += sums[PLANE_1 + j]
        gs += sums[j] * (dx * dx) + sums[PLANE_2 + j]
        sum_r += sums[PLANE_3 + j]
        sum_g += sums[PLANE_4 + j]
        sum_b += sums[PLANE_5 + j]
    gradients[e, 0] = gx
    gradients[e, 1] = gy
    gradients[e, 2] = gs
    gradients[e, 3] = sum_r
    gradients[e, 4] = sum_g
    gradients[e, 5] = sum_b


@njit(cache=True, nogil=True)
def _draw_backward(
    entries, tile_start, chunk_start, tile_order, stored, stop, background, grad_rgb, grad_alpha,
    alpha_min, alpha_max, t_stop, lanes, gradients, part,
):  # fmt: skip
    """Fill one part of `gradients` [E, GRADIENT]: what each entry of each tile adds to the gradient of its splat."""
    height, width = grad_alpha.shape
    tiles_x = (width + TILE - 1) // TILE
    tile = np.empty(TILE * ROW, np.float32)
    T = np.empty(TILE * TILE, np.float32)
    weights = np.empty(CHUNK * TILE * TILE, np.float32)
    profiles = np.empty(CHUNK * 2 * TILE, np.float32)
    rows = np.empty((CHUNK, 2), np.uint64)
    sums = np.empty(6 * TILE, np.float32)
    for turn in range(part, len(tile_order), PARTS):
        t = tile_order[turn]
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
        gradients[tile_start[t] + stop[t] : tile_start[t + 1]] = 0.0
        chunks = (stop[t] + CHUNK - 1) // CHUNK
        for chunk in range(chunks - 1, -1, -1):
            for p in range(TILE * TILE):
                T[p] = stored[chunk_start[t] + chunk, p]
            first, last = _live_rows(T, LANES, t_stop, lanes)
            begin = tile_start[t] + chunk * CHUNK
            size = min(CHUNK, stop[t] - chunk * CHUNK)
            for k in range(size):
                splat = entries[begin + k]
                x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
                _profiles(splat[2], x, y, profiles, u64(k) * PLANE_2)
                ya, yb = _rows_reached(x, y, splat[3], first, last)
                rows[k, 0], rows[k, 1] = ya, yb
                _weigh(T, profiles, u64(k) * PLANE_2, ya, yb, weights, u64(k) * AREA, alpha_min, alpha_max, lanes)
            for k in range(size - 1, -1, -1):
                splat = entries[begin + k]
                x, y = splat[0] - f32(x0) - f32(0.5), splat[1] - f32(y0) - f32(0.5)
                _gradient(
                    tile, profiles, u64(k) * PLANE_2, rows[k, 0], rows[k, 1], weights, u64(k) * AREA, x, y,
                    splat[4], splat[5], splat[6], alpha_min, alpha_max, sums, gradients, begin + k,
                )  # fmt: skip


@njit(cache=True, nogil=True)
def _sum_gradients(
    gradients, positions, order, splat_start, variance, grad_xy, grad_variance, grad_colors, part
):  # fmt: skip
    """Entries -> one part of the gradients of xy [N, 2], variance [N], colors [N, 3]."""
    m = len(order)
    for rank in range(m * part // PARTS, m * (part + 1) // PARTS):
        i = order[rank]
        gx = gy = gs = r = g = b = 0.0
        for k in range(splat_start[rank], splat_start[rank + 1]):
            e = positions[k]
            gx += gradients[e, 0]
            gy += gradients[e, 1]
            gs += gradients[e, 2]
            r += gradients[e, 3]
            g += gradients[e, 4]
            b += gradients[e, 5]
        grad_xy[i, 0] = gx / variance[i]
        grad_xy[i, 1] = gy / variance[i]
        grad_variance[i] = gs / variance[i] / variance[i] / 2
        grad_colors[i, 0] = r
        grad_colors[i, 1] = g
        grad_colors[i, 2] = b
