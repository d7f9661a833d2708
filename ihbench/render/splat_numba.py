"""The splat renderer on the CPU: numba, tiles of 64×32 px, explicit 16-lane vectors, analytic backward pass.

`splat_gaussians` and `splat_circles` project, `splat_tiles` orders the splats and lists them per tile,
`splat_ellipses` and `splat_circles` pack and cut them, `splat_compositing` draws the tiles; `README.md` beside them
has what was tried and what it took. Gaussians go from the world to the picture and back in one piece
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
from ihbench.render.splat_circles import CIRCLE, CIRCLE_GRADIENT, circle_gradients, pack_circles, project_circles
from ihbench.render.splat_ellipses import (
    ELLIPSE,
    ELLIPSE_GRADIENT,
    ellipse_gradients,
    pack_ellipses,
    visible_ellipses,
)  # fmt: skip
from ihbench.render.splat_gaussians import gaussian_gradients, project_gaussians
from ihbench.render.splat_projection import clamped_directions, intrinsics, radii
from ihbench.render.splat_tiles import OPEN, TILE_HEIGHT, TILE_WIDTH, depth_order, fill_tiles
from ihbench.render.splats import PRESETS, Ellipses, Preset, Splats, as_ellipses

if TYPE_CHECKING:
    from ihbench.render.splat import Screen

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
    pack: Callable[..., int],
    inputs: tuple[Any, ...],
    count: int,
    preset: Preset,
    background: NDArray[np.float32],
    size: tuple[int, int],
    keep: bool,
    rgb: NDArray[np.float32],
    alpha: NDArray[np.float32],
) -> _Pass:
    """Pack `count` splats in depth order, list them per tile, and draw the tiles into rgb [H, W, 3], alpha [H, W]."""
    height, width = size
    tiles_x, tiles_y = -(-width // TILE_WIDTH), -(-height // TILE_HEIGHT)
    tiles = tiles_x * tiles_y
    packed = np.zeros((count, ELLIPSE if elliptic else CIRCLE), f32)
    boxes, slot_start = np.empty((count, 4), np.int32), np.empty(count + 1, np.int32)
    tile_start, closed, let_through = (
        np.zeros(tiles + 1, np.int64),
        np.full(tiles, OPEN, np.int32),
        np.ones(tiles, f32),
    )
    limits = preset.alpha_min, preset.alpha_max, T_STOP, height, width
    entries = pack(*inputs, *limits, packed, boxes, tile_start, closed, let_through, slot_start)
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


def _draw_backward(of: _Pass, grad_rgb: NDArray[np.float32], grad_alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """[entries, …] what each entry of each tile adds to the gradient of its splat."""
    slots = np.zeros((len(of.slots), ELLIPSE_GRADIENT if of.elliptic else CIRCLE_GRADIENT), f32)
    _run(
        of.kernels.composite_tiles_backward, of.elliptic, of.packed, of.ranks, of.slots, of.tile_start, of.tile_order,
        of.drawn, *of.size, *of.limits, of.background, grad_rgb, grad_alpha, of.state, slots,
    )  # fmt: skip
    return slots


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
        log_cut = -2 * log(preset.alpha_min)
        xy, variance, depth = np.empty((n, 2), f32), np.empty(n, f32), np.empty(n, f32)
        order, keys = np.empty(n + 1, np.int32), np.empty(n + 1, np.uint32)
        m, lowest, highest = project_circles(
            means, scales, colors, to_pixels, offset, focal2, preset.low_pass, f32(preset.near), log_cut, height,
            width, xy, variance, depth, order, keys,
        )  # fmt: skip
        order = depth_order(order[:m], keys[:m], np.uint32(lowest), np.uint32(highest))
        groups = _Groups(height, width, colors.shape[1], background)
        passes = [
            _draw(None, pack_circles, (xy, variance, colors, first, order, f32(log_cut)), m, preset, bg,
                  (height, width), keep, rgb, alpha)
            for first, bg, rgb, alpha in groups.each()
        ]  # fmt: skip
        if screen is not None:
            circles = (torch.from_numpy(x) for x in (xy, variance, depth, colors))
            screen.radius = radii(as_ellipses(Splats(*circles)), height, width, preset).to(ctx.dtypes[0])
        if keep:
            ctx.saved = passes, order, xy, variance, depth, scales, to_pixels, focal2, colors.shape[1], screen
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        passes, order, xy, variance, depth, scales, to_pixels, focal2, channels, screen = ctx.saved
        n = len(scales)
        grads = np.zeros((n, 3), scales.dtype), np.zeros(n, scales.dtype), np.zeros((n, channels), f32)
        grad_xy = np.zeros((0 if screen is None else n, 2), scales.dtype)
        for k, (of, pull) in enumerate(zip(passes, _pulls(*grad_outputs), strict=True)):
            slots = _draw_backward(of, *pull)
            _run(
                circle_gradients, slots, order, of.slot_start, xy, variance, depth, scales, to_pixels, focal2,
                k * CHANNELS, *grads, grad_xy,
            )  # fmt: skip
        if screen is not None and ctx.needs_input_grad[0]:
            screen.add(torch.from_numpy(grad_xy).to(ctx.dtypes[0]))
        return *_tensors(grads, ctx.dtypes), *[None] * 5


_composite_circles: Callable[..., tuple[Tensor, Tensor]] = _Circles.apply


# ----------------------------------------------------------------------------------------------------
# Ellipses


@dataclass(frozen=True)
class _Drawn:
    """Ellipses of a picture, and what its backward pass needs."""

    passes: list[_Pass]
    order: NDArray[np.int32]  # [M] indices of what is drawn, by depth
    opacity: NDArray[np.float64]  # [N]
    channels: int

    def gradients(self, grad_rgb: Tensor, grad_alpha: Tensor) -> tuple[NDArray[Any], ...]:
        """Of xy [N, 2], covariance [N, 3], opacity [N] and colors [N, C]."""
        n = len(self.opacity)
        grads = np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, self.channels), f32)
        for k, (of, pull) in enumerate(zip(self.passes, _pulls(grad_rgb, grad_alpha), strict=True)):
            slots = _draw_backward(of, *pull)
            _run(ellipse_gradients, slots, self.order, of.slot_start, of.packed, self.opacity, k * CHANNELS, *grads)
        return grads


def _draw_ellipses(
    xy: NDArray[np.float64],
    covariance: NDArray[np.float64],
    opacity: NDArray[np.float64],
    colors: NDArray[np.float32],
    depth: NDArray[np.float32],
    size: tuple[int, int],
    background: Tensor,
    preset: Preset,
    keep: bool,
) -> tuple[_Groups, _Drawn]:
    n = len(xy)
    order, keys = np.empty(n + 1, np.int32), np.empty(n + 1, np.uint32)
    m, lowest, highest = visible_ellipses(xy, covariance, opacity, depth, preset.alpha_min, *size, order, keys)
    order = depth_order(order[:m], keys[:m], np.uint32(lowest), np.uint32(highest))
    groups = _Groups(*size, colors.shape[1], background)
    passes = [
        _draw(True, pack_ellipses, (xy, covariance, opacity, colors, first, order), m, preset, bg, size, keep, rgb,
              alpha)
        for first, bg, rgb, alpha in groups.each()
    ]  # fmt: skip
    return groups, _Drawn(passes, order, opacity, colors.shape[1])


class _Ellipses(torch.autograd.Function):
    """xy [M, 2], covariance [M, 3], opacity [M], colors [M, C], depth [M] -> rgb [H, W, C], alpha [H, W]."""

    @staticmethod
    def forward(ctx: Any, xy, covariance, opacity, colors, depth, height, width, background, preset, keep) -> Any:
        ctx.dtypes = xy.dtype, covariance.dtype, opacity.dtype, colors.dtype
        xy, covariance, opacity = (_array(x.double()) for x in (xy, covariance, opacity))
        colors, depth = (_array(x.float()) for x in (colors, depth))
        groups, drawn = _draw_ellipses(
            xy, covariance, opacity, colors, depth, (height, width), background, preset, keep
        )
        if keep:
            ctx.drawn = drawn
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        grads = ctx.drawn.gradients(*grad_outputs)
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
        world = tuple(_array(x.double()) for x in (means, flat, turns))
        opacity, colors = _array(opacities.double()), _array(colors.float())
        view = _view(camera, preset)
        xy, covariance, depth = np.empty((n, 2)), np.empty((n, 3)), np.empty(n, f32)
        _run(
            project_gaussians,
            *world,
            opacity,
            colors,
            *view,
            preset.low_pass,
            f32(preset.near),
            xy,
            covariance,
            depth,
        )
        groups, drawn = _draw_ellipses(xy, covariance, opacity, colors, depth, size, background, preset, keep)
        if screen is not None:
            ellipses = Ellipses(*(torch.from_numpy(x) for x in (xy, covariance, opacity, depth, colors)))
            screen.radius = radii(ellipses, *size, preset).to(means.dtype)
        if keep:
            ctx.saved = drawn, world, view, screen
        return groups.picture(), groups.alpha

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        drawn, world, view, screen = ctx.saved
        grad_xy, grad_covariance, *of_splats = drawn.gradients(*grad_outputs)
        of_world = tuple(np.zeros_like(x) for x in world)
        _run(gaussian_gradients, grad_xy, grad_covariance, *world, *view, *of_world)
        if screen is not None and ctx.needs_input_grad[0]:
            screen.add(torch.from_numpy(grad_xy).to(ctx.like[0][1]))
        grads = [
            None if like is None else torch.from_numpy(g).reshape(like[0]).to(like[1])
            for g, like in zip((*of_world, *of_splats), ctx.like, strict=True)
        ]
        return *grads, *[None] * 5


def _view(camera: Camera, preset: Preset) -> tuple[NDArray[np.float64], ...]:
    """K, R, t, K R, and the least and greatest slope x / z, y / z up to which the off-axis terms grow."""
    K = intrinsics(camera)
    low, high = clamped_directions(camera, preset)
    R, t = (np.ascontiguousarray(x, np.float64) for x in (camera.R, camera.t))
    return K, R, t, K @ R, low, high


_composite_gaussians: Callable[..., tuple[Tensor, Tensor]] = _Gaussians.apply


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
