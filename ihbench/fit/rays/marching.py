"""Pixels of a training view through a field, and what they should look like."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ihbench.fit.rays.ray_target import PosedBox, RayTarget
from ihbench.fit.rays.sampling import Pixels
from ihbench.render.volumes.fast import Marched, march
from ihbench.render.volumes.field import Field
from ihbench.render.volumes.intervals import (
    active_interval,
    box_interval,
    even_depths,
    segment_lengths,
)
from ihbench.render.volumes.rays import Rays, pixel_rays

Device = torch.device | str


@dataclass(frozen=True)
class MarchedPixels:
    """What pixels show. Those whose ray does not meet the box show the background."""

    rgb: Tensor  # [..., 3] on the background
    alpha: Tensor  # [...]
    depths: Tensor  # [N, S] m of the samples on the rays that meet the box
    rays: Rays  # [N]
    marched: Marched  # of them
    met: Tensor  # [N] int64 which of the pixels, counted in order, they are


def march_pixels(
    field: Field,
    target: RayTarget,
    pixels: Pixels,  # [...]
    samples: int,
    background: Tensor,  # [3]
    rng: np.random.Generator | None = None,  # for stratified samples; None: on the lattice
    least: float = 1e-3,  # likelihood under which a sample is empty
    inside: int = 0,  # samples of a second pass between the first and last that are not empty; 0: no second pass
) -> MarchedPixels:
    """Differentiable in the field's parameters. The background gives type and device."""
    shape, frame = pixels.rows.shape, target.box.frame
    rays = pixel_rays(
        target.camera, pixels.rows.ravel(), pixels.columns.ravel(), frame, background.dtype, background.device
    )
    near, far = box_interval(rays, *_ends(target.box, background))
    met = (near < far).nonzero()[:, 0]
    rays, near, far = rays[met], near[met], far[met]
    if inside:
        with torch.no_grad():
            coarse = even_depths(near, far, samples)
            near, far = active_interval(coarse, field.likelihood(rays, coarse) > least)
            some = near < far
            rays, near, far, met, samples = rays[some], near[some], far[some], met[some], inside
    within = None if rng is None else _uniform(rng, len(rays), samples, background)
    depths = even_depths(near, far, samples, within)
    marched = march(field, rays, depths, segment_lengths(depths, rays.lengths), least)
    count = int(np.prod(shape))
    rgb = background.expand(count, 3).index_copy(0, met, marched.composited.on(background))
    alpha = background.new_zeros(count).index_copy(0, met, marched.composited.alpha)
    return MarchedPixels(rgb.view(*shape, 3), alpha.view(shape), depths, rays, marched, met)


def wanted_colors(
    target: RayTarget,
    pixels: Pixels,  # [...]
    background: Tensor,  # [3]
) -> tuple[Tensor, Tensor]:
    """[..., 3] the image where the person is seen, elsewhere the background, through the mask: edges keep no rim of
    the colour that the image was made on. And [...] bool, pixels that are not compared."""
    rows, columns = pixels.rows, pixels.columns
    person = torch.from_numpy(target.person[rows, columns]).to(background.device)
    image = torch.from_numpy(target.image[rows, columns]).to(background)
    unknown = torch.from_numpy(target.unknown[rows, columns]).to(background.device)
    return torch.where(person[..., None], image, background), unknown


def _ends(box: PosedBox, like: Tensor) -> tuple[Tensor, Tensor]:
    return box.ends(like.dtype, like.device)


def _uniform(rng: np.random.Generator, rays: int, samples: int, like: Tensor) -> Tensor:
    return torch.from_numpy(rng.random((rays, samples), np.float32)).to(like)
