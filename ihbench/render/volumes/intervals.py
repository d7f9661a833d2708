"""Where along a ray samples are taken: between the faces of a box, on a lattice, or where that met something."""

from __future__ import annotations

import torch
from torch import Tensor

from ihbench.render.volumes.rays import Rays

PARALLEL = 1e-12  # a direction's component below this counts as this: rays along a face meet it far away


def box_interval(
    rays: Rays,
    low: Tensor,  # [..., 3] m, broadcast against the rays' [N, 3]
    high: Tensor,  # [..., 3] m
) -> tuple[Tensor, Tensor]:
    """Depths [...] at which rays enter and leave a box; entered at or after left where they do not meet it, or only
    behind the camera. None is negative."""
    direction = rays.directions
    direction = torch.where(direction.abs() < PARALLEL, PARALLEL, direction)
    first, second = (low - rays.origins) / direction, (high - rays.origins) / direction
    near = torch.minimum(first, second).amax(-1).clamp(min=0)
    far = torch.maximum(first, second).amin(-1).clamp(min=0)
    return near, far


def even_depths(
    near: Tensor,  # [N]
    far: Tensor,  # [N]
    samples: int,
    within: Tensor | None = None,  # [N, S] in [0, 1): stratified; None: at the lattice's points, both ends included
) -> Tensor:
    """[N, S] depths, even between near and far.

    Stratified as in NeRF's released code, and HumanNeRF's: each sample anywhere between the middles towards its
    neighbours, the outermost two between the end and the middle.
    """
    share = torch.linspace(0, 1, samples, dtype=near.dtype, device=near.device)
    depths = near[:, None] * (1 - share) + far[:, None] * share
    if within is None:
        return depths
    middles = (depths[:, 1:] + depths[:, :-1]) / 2
    lower = torch.cat([depths[:, :1], middles], 1)
    upper = torch.cat([middles, depths[:, -1:]], 1)
    return lower + (upper - lower) * within


def segment_lengths(
    depths: Tensor,  # [N, S]
    lengths: Tensor,  # [N] m for each metre of depth
    last: float | None = None,  # m: of the last sample; None: as long as the one before it
) -> Tensor:
    """[N, S] m from each sample to the next. The released systems give the last one 1e10."""
    steps = depths.diff(dim=1)
    ending = steps[:, -1:] if last is None else torch.full_like(depths[:, :1], last)
    steps = steps * lengths[:, None]
    return torch.cat([steps, ending * lengths[:, None] if last is None else ending], 1)


def active_interval(
    depths: Tensor,  # [N, S] of a lattice
    active: Tensor,  # [N, S] bool
) -> tuple[Tensor, Tensor]:
    """Depths [N] between which a second pass places its samples: from the lattice's point before the first active
    sample to the one after the last. Both are 0 where none is active."""
    count = depths.shape[1]
    number = torch.arange(count, device=depths.device).expand_as(active)
    first = torch.where(active, number, count).amin(1)
    last = torch.where(active, number, -1).amax(1)
    ends = [depths.gather(1, k.clamp(0, count - 1)[:, None])[:, 0] for k in (first - 1, last + 1)]
    some = active.any(1)
    near, far = (torch.where(some, end, 0.0) for end in ends)
    return near, far
