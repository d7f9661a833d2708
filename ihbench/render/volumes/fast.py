"""Rays through a radiance field, with networks evaluated only where something may be.

Three things make it fast. The likelihood of all samples is looked up first, and only those above a threshold go to
the networks, gathered into one matrix: the error of a pixel is at most the sum of the likelihoods left out. When
drawing, samples go front to back in blocks, and a ray that lets through less than `stop` is done. Rays come in
portions, so that what is held does not grow with the picture. `reference.py` does none of this.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera
from ihbench.render.volumes.compositing import Composited, ray_weights, scattered_composite
from ihbench.render.volumes.density_laws import opacity
from ihbench.render.volumes.field import Field, FieldValues
from ihbench.render.volumes.intervals import box_interval, even_depths, segment_lengths
from ihbench.render.volumes.rays import Rays, pixel_rays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Skipping:
    """What the fast renderer leaves out."""

    least: float = 1e-3  # likelihood below which a sample is empty; 0: only what is exactly 0
    stop: float = 1e-3  # when drawing, a ray that lets through less than this is done; 0: none is
    block: int = 16  # samples between two looks at what is let through
    portion: int = 2048  # rays at a time: what their samples need in the networks stays near the processor


@dataclass(frozen=True)
class Marched:
    """What rays met, with everything that a loss may want."""

    composited: Composited
    alpha: Tensor  # [N, S] opacities of the samples
    active: Tensor  # [N, S] bool: which of them were evaluated
    values: FieldValues  # of those, row by row


def sample_opacity(values: FieldValues, lengths: Tensor) -> Tensor:  # [M] m
    """[M] opacities of samples."""
    alpha = opacity(values.density, lengths)
    return alpha if values.likelihood is None else alpha * values.likelihood


def march(
    field: Field,
    rays: Rays,
    depths: Tensor,  # [N, S] m
    lengths: Tensor,  # [N, S] m from each sample to the next
    least: float = 1e-3,
) -> Marched:
    """Rays through a field, differentiable in its parameters. No early stop: every sample may get a gradient."""
    active = field.likelihood(rays, depths) > least
    row, sample = active.nonzero().unbind(1)
    points = rays.origins[row] + depths[row, sample, None] * rays.directions[row]
    values = field.values(points)
    alpha = torch.zeros_like(depths).masked_scatter(active, sample_opacity(values, lengths[row, sample]))
    return Marched(scattered_composite(alpha, values.rgb, depths, active), alpha, active, values)


@torch.no_grad()
def draw_rays(
    field: Field,
    rays: Rays,
    depths: Tensor,  # [N, S] m
    lengths: Tensor,  # [N, S] m
    skipping: Skipping | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [N, 3] premultiplied, alpha [N], depth [N] (weights times depths) of rays, without gradients."""
    skipping = skipping or Skipping()
    active = field.likelihood(rays, depths) > skipping.least
    rgb, total, depth = depths.new_zeros(len(rays), 3), depths.new_zeros(len(rays)), depths.new_zeros(len(rays))
    through = torch.ones_like(total)
    for first in range(0, depths.shape[1], skipping.block):
        block = slice(first, first + skipping.block)
        meets = active[:, block].any(1)
        if skipping.stop > 0:
            meets &= through >= skipping.stop
        which = meets.nonzero()[:, 0]
        if not len(which):
            continue
        inside, at = active[which, block], depths[which, block]
        row, sample = inside.nonzero().unbind(1)
        some = which[row]
        values = field.values(rays.origins[some] + at[row, sample, None] * rays.directions[some])
        alpha = torch.zeros_like(at)
        alpha[inside] = sample_opacity(values, lengths[some, first + sample])
        weights, left = ray_weights(alpha, through[which])
        through[which] = left
        total[which] += weights.sum(1)
        depth[which] += (weights * at).sum(1)
        rgb.index_add_(0, some, weights[inside][:, None] * values.rgb)
    return rgb, total, depth


@dataclass(frozen=True)
class Drawn:
    """A picture of a field."""

    rgb: Tensor  # [H, W, 3] on the background
    alpha: Tensor  # [H, W]
    depth: Tensor  # [H, W] m, sum of weight times depth


@torch.no_grad()
def draw_image(
    field: Field,
    camera: Camera,
    box: tuple[Tensor, Tensor],  # low [3], high [3] m in the rays' frame: there is nothing outside
    samples: int,
    background: tuple[float, float, float],
    frame: tuple[Array, Array] | None = None,  # see `pixel_rays`
    skipping: Skipping | None = None,
) -> Drawn:
    """A whole picture, `samples` on each ray between the faces of the box. The box gives type and device."""
    skipping, low = skipping or Skipping(), box[0]
    height, width = camera.height, camera.width
    rgb = low.new_tensor(background).repeat(height * width, 1)
    alpha, depth = low.new_zeros(height * width), low.new_zeros(height * width)
    for pixels, rays, near, far in box_rays(camera, box, frame, skipping.portion):
        depths = even_depths(near, far, samples)
        own, total, far_off = draw_rays(field, rays, depths, segment_lengths(depths, rays.lengths), skipping)
        rgb[pixels] = own + (1 - total)[:, None] * rgb[pixels]
        alpha[pixels], depth[pixels] = total, far_off
    return Drawn(rgb.view(height, width, 3), alpha.view(height, width), depth.view(height, width))


def box_rays(
    camera: Camera,
    box: tuple[Tensor, Tensor],
    frame: tuple[Array, Array] | None = None,
    portion: int = 2048,
) -> Iterator[tuple[Tensor, Rays, Tensor, Tensor]]:
    """Rays of a picture that meet a box, in portions: numbers of the pixels [N], rays, near and far [N]."""
    low, high = box
    pixels = camera.height * camera.width
    for first in range(0, pixels, 4 * portion):
        number = np.arange(first, min(first + 4 * portion, pixels))
        rays = pixel_rays(camera, number // camera.width, number % camera.width, frame, low.dtype, low.device)
        near, far = box_interval(rays, low, high)
        met = (near < far).nonzero()[:, 0]
        for part in met.split(portion):
            yield part + first, rays[part], near[part], far[part]
