"""The splat renderer on the CPU: numba, tiles of 64×32 px, explicit 16-lane vectors, analytic backward pass.

`splat_gaussians` and `splat_circles` project, `splat_tiles` and `splat_packing` order the splats and list them per
tile, `splat_ellipses` and `splat_circles` cut them, `splat_compositing` draws the tiles; `README.md` beside them has
what was tried and what it took. Gaussians go from the world to the picture and back in one piece
(`draw_gaussians`, and `draw_isotropic` for opaque circles); `composite` takes projected ones.

Early stop: where no pixel of a 16×16 px cell lets through `T_STOP`, splats under such cells alone are left out. That
changes a colour by less than T_STOP times the range of colours, and the gradient of an alpha by less than
T_STOP / (1 - alpha) times that range.

Nothing depends on the number of threads: a tile's list is in depth order, each of its entries has a slot of its own
for its gradient, and a splat's slots are added up in the order of the tiles. The threads are Python's (the kernels
release the lock), not numba's: numba's OpenMP threads and torch's wait for work by spinning, and on a busy machine
each kept the other from its core, which made an iteration up to twenty times slower.

Nothing is shared by two calls: what the backward pass needs belongs to its own graph.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from math import log
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from ihbench.camera import Camera
from ihbench.render import lanes, splat_compositing, splat_plain
from ihbench.render.splat_circles import (
    CIRCLE,
    CIRCLE_COLOR,
    CIRCLE_GRADIENT,
    circle_gradients,
    project_circles,
)  # fmt: skip
from ihbench.render.splat_ellipses import (
    ELLIPSE,
    ELLIPSE_COLOR,
    ELLIPSE_GRADIENT,
    ellipse_gradients,
    ellipse_records,
)  # fmt: skip
from ihbench.render.splat_gaussians import gaussian_gradients, project_gaussians
from ihbench.render.splat_packing import pack_splats
from ihbench.render.splat_projection import clamped_directions, intrinsics
from ihbench.render.splat_tiles import OPEN, TILE_HEIGHT, TILE_WIDTH, depth_order, fill_tiles, in_sight, ranks_of
from ihbench.render.splats import PRESETS, Ellipses, Preset, Splats, as_ellipses

if TYPE_CHECKING:
    from ihbench.render.splats import Screen

T_STOP = 1e-5  # a transmittance below it counts as none
T_LEAST = 1e-10  # what a preset that never stops stops at, against underflow
PARTS = 32  # the work of several threads is dealt into as many hands, and who is free takes the next
CHANNELS = 3  # colour channels of one pass; other counts are drawn in several

f32 = np.float32


def composite(
    splats: Splats | Ellipses, height: int, width: int, background: Tensor, preset: Preset | None = None
) -> tuple[Tensor, Tensor]:
    """Projected splats and background [C] -> rgb [H, W, C], alpha [H, W], float32. Conventions:
    `ihbench.render.splat`."""
    s = as_ellipses(splats)
    inputs = (s.xy, s.covariance, s.opacity, s.colors)
    # autograd switches the grad mode off inside a Function, so whether to keep anything is decided here
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    return _composite_ellipses(*inputs, s.depth, height, width, background, preset or PRESETS["opaque"], keep)


def draw_gaussians(
    means: Tensor,
    shapes: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor,
    preset: Preset,
    quaternions: Tensor | None = None,
    opacities: Tensor | None = None,
    screen: Screen | None = None,
) -> tuple[Tensor, Tensor]:
    """General Gaussians in the world -> rgb [H, W, C], alpha [H, W], float32; see `render_gaussians`.

    Fills in the radius of `screen`, and its gradient in every backward pass. Gaussians that are not finite are left
    out and get a zero gradient.
    """
    opacities = means.new_ones(len(means)) if opacities is None else opacities
    inputs = (means, shapes, quaternions, opacities, colors)
    keep = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
    return _composite_gaussians(*inputs, camera, background, preset, keep, screen)


def draw_isotropic(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Tensor,
    preset: Preset,
    screen: Screen | None = None,
) -> tuple[Tensor, Tensor]:
    """Opaque isotropic Gaussians in the world as circles; otherwise as `draw_gaussians`."""
    if not vectors():
        raise RuntimeError("circles are drawn with explicit vectors only")
    keep = torch.is_grad_enabled() and any(x.requires_grad for x in (means, scales, colors))
    return _composite_circles(means, scales, colors, camera, background, preset, keep, screen)


def vectors() -> bool:
    """Whether the kernels with explicit vectors are used: on processors that are worth it."""
    return lanes.wide()


# ----------------------------------------------------------------------------------------------------
# One pass of three channels


@dataclass(frozen=True)
class _Pass:
    """What is drawn in one pass, and what its backward pass needs."""

    kernels: ModuleType
    elliptic: bool | None
    packed: NDArray[np.float32]
    ranks: NDArray[np.int32]  # [entries] tile by tile, in the order of depth
    slots: NDArray[np.int32]  # [entries]
    slot_start: NDArray[np.int32]  # [M + 1]
    tile_start: NDArray[np.int64]  # [tiles + 1]
    tile_order: NDArray[np.int64]  # [tiles] busiest first
    drawn: NDArray[np.int64]  # [tiles] entries of a tile that were drawn
    limits: tuple[np.float32, np.float32]  # smallest and largest alpha
    background: NDArray[np.float32]  # [3]
    state: NDArray[np.float32]  # transmittance and last splat of each pixel; empty where nothing is kept
    size: tuple[int, int]  # height, width


def _draw(
    elliptic: bool | None,
    records: NDArray[np.float32],
    order: NDArray[np.int32],
    preset: Preset,
    background: NDArray[np.float32],
    size: tuple[int, int],
    keep: bool,
    rgb: NDArray[np.float32],
    alpha: NDArray[np.float32],
) -> _Pass:
    """Pack the splats of this order, list them per tile, and draw the tiles into rgb [H, W, 3], alpha [H, W]."""
    height, width = size
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    tiles = tiles_x * tiles_y
    count = len(order)
    packed = np.empty((count, records.shape[1]), f32)
    boxes, slot_start = np.empty((count, 4), np.int32), np.empty(count + 1, np.int32)
    tile_start, closed, let_through = (
        np.zeros(tiles + 1, np.int64),
        np.full(tiles, OPEN, np.int32),
        np.ones(tiles, f32),
    )
    limits = preset.alpha_min, preset.alpha_max, T_STOP, height, width
    entries = pack_splats(
        elliptic, records, order, *limits, packed, boxes, tile_start, closed, let_through, slot_start
    )
    if entries > np.iinfo(np.int32).max:
        raise MemoryError(f"splats: {entries} pairs of splat and tile, more than this back end can index")
    ranks, slots = np.empty(entries, np.int32), np.empty(entries, np.int32)
    load = np.argsort(-tile_start[1:], kind="stable")
    fill_tiles(boxes, tiles_x, tile_start, closed, ranks, slots)
    kernels = splat_compositing if vectors() else splat_plain
    drawn = np.zeros(tiles, np.int64)
    state = np.empty(2 * tiles * TILE_WIDTH * TILE_HEIGHT if keep else 0, f32)
    alphas = f32(preset.alpha_min), f32(preset.alpha_max)
    _run(
        kernels.composite_tiles, elliptic, packed, ranks, slots, tile_start, load, drawn, height, width, *alphas,
        f32(max(preset.stop, T_LEAST)), f32(T_STOP), background, rgb, alpha, keep, state,
    )  # fmt: skip
    return _Pass(
        kernels, elliptic, packed, ranks, slots, slot_start, tile_start, load, drawn, alphas, background, state, size
    )


def _draw_all(
    elliptic: bool | None,
    records: NDArray[np.float32],
    depth: NDArray[np.float32],
    colors: NDArray[np.float32],
    size: tuple[int, int],
    background: Tensor,
    preset: Preset,
    keep: bool,
) -> tuple[_Groups, _Drawn]:
    """Splats with a depth > 0, whose `records` have the first three colours, in every channel."""
    _keep_memory()
    n, channels = colors.shape
    order, keys = np.empty(n, np.int32), np.empty(n, np.uint32)
    m, lowest, highest = in_sight(depth, order, keys)
    order = depth_order(order[:m], keys[:m], np.uint32(lowest), np.uint32(highest))
    groups, passes = _Groups(*size, channels, background), []
    at = ELLIPSE_COLOR if elliptic else CIRCLE_COLOR
    for first, bg, rgb, alpha in groups.each():
        if first:
            here = colors[:, first : first + CHANNELS]
            records[:, at : at + CHANNELS] = 0
            records[:, at : at + here.shape[1]] = here
        passes.append(_draw(elliptic, records, order, preset, bg, size, keep, rgb, alpha))
    return groups, _Drawn(passes, ranks_of(order, n) if keep else np.empty(0, np.int32), channels)


@cache
def _keep_memory() -> None:
    """glibc gives the system back what is free beyond twice the largest block that it has ever seen freed (32 MB at
    most), and to fault in anew what a picture needs takes longer than to draw it. So one block is freed that nobody
    has touched."""
    np.empty(31 << 20, np.uint8)


@dataclass(frozen=True)
class _Drawn:
    """A picture's passes, and what their backward pass needs."""

    passes: list[_Pass]
    rank_of: NDArray[np.int32]  # [N] a splat's place in depth, -1 where it is not drawn
    channels: int

    def backward(self, pulls: tuple[Tensor, Tensor], kernel: Callable[..., None], inputs: Any, grads: Any) -> None:
        """Add up the slots of every pass, and let kernel(slots, …, *inputs, first channel, last, *grads) make
        gradients of them: of three channels' colours each time, of all else the last time."""
        elliptic = self.passes[0].elliptic
        # the same in every pass, since the footprints are
        slots = np.zeros((len(self.passes[0].slots), ELLIPSE_GRADIENT if elliptic else CIRCLE_GRADIENT), f32)
        for k, (of, (grad_rgb, grad_alpha)) in enumerate(zip(self.passes, _pulls(*pulls), strict=True)):
            if k:
                slots[:, 6 if elliptic else 3 :] = 0  # another three colours
            _run(
                of.kernels.composite_tiles_backward, elliptic, of.packed, of.ranks, of.slots, of.tile_start,
                of.tile_order, of.drawn, *of.size, *of.limits, of.background, grad_rgb, grad_alpha, of.state, slots,
            )  # fmt: skip
            last = k == len(self.passes) - 1
            _run(kernel, slots, self.rank_of, of.slot_start, of.packed, *inputs, k * CHANNELS, last, *grads)


class _Groups:
    """A picture of any number of channels as pictures of three; alpha is the first one's."""

    def __init__(self, height: int, width: int, channels: int, background: Tensor) -> None:
        self.channels = channels
        self.rgb = [torch.empty(height, width, CHANNELS) for _ in range(0, channels, CHANNELS)]
        self.alpha = torch.empty(height, width)
        padded = torch.nn.functional.pad(background.float(), (0, -channels % CHANNELS))
        self.backgrounds = padded.contiguous().numpy().reshape(-1, CHANNELS)

    def each(self) -> list[tuple[int, NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]]:
        """First channel, background [3], rgb [H, W, 3] and alpha [H, W] of every group; the first alpha counts."""
        return [
            (
                k * CHANNELS,
                self.backgrounds[k],
                rgb.numpy(),
                (torch.empty_like(self.alpha) if k else self.alpha).numpy(),
            )
            for k, rgb in enumerate(self.rgb)
        ]

    def picture(self) -> Tensor:
        """[H, W, C]."""
        whole = self.rgb[0] if len(self.rgb) == 1 else torch.cat(self.rgb, -1)
        return whole if self.channels == whole.shape[-1] else whole[..., : self.channels].contiguous()


def _pulls(grad_rgb: Tensor, grad_alpha: Tensor) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """Gradients of rgb [H, W, 3] and alpha [H, W] for every group of channels; alpha's goes to the first."""
    channels = grad_rgb.shape[-1]
    if channels != CHANNELS:
        grad_rgb = torch.nn.functional.pad(grad_rgb, (0, -channels % CHANNELS))
    groups = [g.float().contiguous().numpy() for g in grad_rgb.split(CHANNELS, -1)]
    alpha = grad_alpha.float().contiguous().numpy()
    return [(g, np.zeros_like(alpha) if k else alpha) for k, g in enumerate(groups)]


def _tensors(arrays: Iterable[NDArray[Any]], dtypes: Iterable[torch.dtype]) -> list[Tensor]:
    return [torch.from_numpy(a).to(dtype) for a, dtype in zip(arrays, dtypes, strict=True)]


def _array(x: Tensor) -> NDArray[Any]:
    """Without a copy where it is float32 or float64 already."""
    x = x.detach()
    return (x if x.dtype == torch.float64 else x.float()).contiguous().numpy()


# ----------------------------------------------------------------------------------------------------
# Circles


class _Circles(torch.autograd.Function):
    """means [N, 3], scales [N], colors [N, C] -> rgb [H, W, C], alpha [H, W]."""

    @staticmethod
    def forward(ctx: Any, means, scales, colors, camera, background, preset, keep, screen) -> Any:
        n, height, width = len(means), camera.height, camera.width
        K = intrinsics(camera)
        to_pixels, offset, focal2 = K @ camera.R, K @ camera.t, K[0, 0] * K[1, 1]
        ctx.dtypes = means.dtype, scales.dtype, colors.dtype
        means, scales, colors = _array(means), _array(scales), _array(colors.float())
        records, depth = np.empty((n, CIRCLE), f32), np.empty(n, f32)
        radius = np.zeros(0 if screen is None else n)
        _run(
            project_circles, means, scales, colors, to_pixels, offset, focal2, preset.low_pass, f32(preset.near),
            f32(-2 * log(preset.alpha_min)), height, width, records, depth, radius,
        )  # fmt: skip
        groups, drawn = _draw_all(None, records, depth, colors, (height, width), background, preset, keep)
        if screen is not None:
            screen.radius = torch.from_numpy(radius).to(ctx.dtypes[0])
        if keep:
            ctx.saved = drawn, depth, scales, to_pixels, focal2, screen
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        drawn, depth, scales, to_pixels, focal2, screen = ctx.saved
        n = len(scales)
        grads = np.empty((n, 3), scales.dtype), np.empty(n, scales.dtype), np.empty((n, drawn.channels), f32)
        grad_xy = np.zeros((0 if screen is None else n, 2), scales.dtype)
        inputs = depth, scales, to_pixels, focal2
        drawn.backward(grad_outputs, circle_gradients, inputs, (*grads, grad_xy))
        if screen is not None and ctx.needs_input_grad[0]:
            screen.add(torch.from_numpy(grad_xy).to(ctx.dtypes[0]))
        return *_tensors(grads, ctx.dtypes), *[None] * 5


_composite_circles: Callable[..., tuple[Tensor, Tensor]] = _Circles.apply


# ----------------------------------------------------------------------------------------------------
# Ellipses


class _Ellipses(torch.autograd.Function):
    """xy [M, 2], covariance [M, 3], opacity [M], colors [M, C], depth [M] -> rgb [H, W, C], alpha [H, W]."""

    @staticmethod
    def forward(ctx: Any, xy, covariance, opacity, colors, depth, height, width, background, preset, keep) -> Any:
        ctx.dtypes = xy.dtype, covariance.dtype, opacity.dtype, colors.dtype
        xy, covariance, opacity = (_array(x.double()) for x in (xy, covariance, opacity))
        colors, depth = (_array(x.float()) for x in (colors, depth))
        records, depth = np.zeros((len(xy), ELLIPSE), f32), depth.copy()
        _run(ellipse_records, xy, covariance, opacity, colors, preset.alpha_min, height, width, records, depth)
        groups, drawn = _draw_all(True, records, depth, colors, (height, width), background, preset, keep)
        if keep:
            ctx.saved = drawn, opacity
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        drawn, opacity = ctx.saved
        n = len(opacity)
        grads = np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, drawn.channels), f32)
        drawn.backward(grad_outputs, ellipse_gradients, (opacity,), grads)
        return *_tensors(grads, ctx.dtypes), *[None] * 6


_composite_ellipses: Callable[..., tuple[Tensor, Tensor]] = _Ellipses.apply


class _Gaussians(torch.autograd.Function):
    """means [N, 3], shapes [N], [N, 3] or [N, 3, 3], quaternions [N, 4] or None, opacities [N], colors [N, C] ->
    rgb [H, W, C], alpha [H, W]."""

    @staticmethod
    def forward(
        ctx: Any, means, shapes, quaternions, opacities, colors, camera, background, preset, keep, screen
    ) -> Any:
        n, size = len(means), (camera.height, camera.width)
        ctx.like = [
            None if x is None else (x.shape, x.dtype) for x in (means, shapes, quaternions, opacities, colors)
        ]
        turns = means.new_zeros(0, 4) if quaternions is None else quaternions
        flat = shapes.reshape(n, 9 if shapes.ndim == 3 else 1 if shapes.ndim == 1 else 3)
        inputs = means, flat, turns, opacities
        # one dtype, so that numba compiles two variants and no more
        double = any(x.dtype == torch.float64 for x in inputs)
        world = tuple(_array(x.double() if double else x.float()) for x in inputs)
        colors, view = _array(colors.float()), _view(camera, preset)
        records, depth = np.zeros((n, ELLIPSE), f32), np.empty(n, f32)
        radius = np.zeros(0 if screen is None else n)
        _run(
            project_gaussians, *world, colors, *view, preset.low_pass, f32(preset.near), preset.alpha_min, *size,
            records, depth, radius,
        )  # fmt: skip
        groups, drawn = _draw_all(True, records, depth, colors, size, background, preset, keep)
        if screen is not None:
            screen.radius = torch.from_numpy(radius).to(means.dtype)
        if keep:
            ctx.saved = drawn, world, view, screen
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        drawn, world, view, screen = ctx.saved
        n, dtype = len(world[0]), world[0].dtype
        grads = *(np.zeros_like(x) for x in world), np.zeros((n, drawn.channels), f32)
        grad_xy = np.zeros((0 if screen is None else n, 2), dtype)
        drawn.backward(grad_outputs, gaussian_gradients, (*world, *view), (*grads, grad_xy))
        if screen is not None and ctx.needs_input_grad[0]:
            screen.add(torch.from_numpy(grad_xy).to(ctx.like[0][1]))
        given = [
            None if like is None else torch.from_numpy(g).reshape(like[0]).to(like[1])
            for g, like in zip(grads, ctx.like, strict=True)
        ]
        return *given, *[None] * 5


_composite_gaussians: Callable[..., tuple[Tensor, Tensor]] = _Gaussians.apply


def _view(camera: Camera, preset: Preset) -> tuple[NDArray[np.float64], ...]:
    """K, R, t, K R, and the least and greatest slope x / z, y / z up to which the off-axis terms grow."""
    K = intrinsics(camera)
    low, high = clamped_directions(camera, preset)
    R, t = (np.ascontiguousarray(x, np.float64) for x in (camera.R, camera.t))
    return K, R, t, K @ R, low, high


# ----------------------------------------------------------------------------------------------------
# Threads


def _run(kernel: Callable[..., None], *args: Any) -> None:
    """kernel(*args, part, parts) for every part, on as many threads as torch uses; who is free takes the next."""
    threads = torch.get_num_threads()
    if threads == 1:
        kernel(*args, 0, 1)
        return
    left = iter(range(PARTS))

    def work() -> None:
        for part in left:
            kernel(*args, part, PARTS)

    helpers = min(threads, PARTS) - 1
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
