"""How often each vertex was seen to end a ray, and how much a vertex lends to a place by that.

As released (tiangexiang/OccNeRF 1cb1ef3, canonical_mlps/occnerf_mlp.py:86-126, network.py:501-517). Counters start
at 1. Scaled counters of a place's neighbours lie in (0, 1], so the most seen one weighs at most e times as much as
the least seen.
"""

from __future__ import annotations

import torch
from torch import Tensor

NEAREST_DEPTH = 0.5  # m of expected depth (weights times depths, unnormalised), above which a ray ends somewhere


def neighbour_weights(
    counters: Tensor,  # [M, k] of each place's neighbours
) -> tuple[Tensor, Tensor]:
    """Weights [M, k] that sum to 1, and the unbiased variance [M] of the scaled counters. Without gradient."""
    if not len(counters):
        return counters.clone(), counters.new_zeros(0)
    above = counters - counters.amin(1, keepdim=True) + 1
    scaled = above / above.amax(1, keepdim=True)
    return scaled.softmax(1), scaled.var(1)


def ends_of_rays(
    alpha: Tensor,  # [R, S] of each sample
    weights: Tensor,  # [R, S] alpha times transmittance
    depths: Tensor,  # [R, S] m
) -> tuple[Tensor, Tensor]:
    """Whether each ray ends somewhere [R], and at which sample [R] int64: that of the largest alpha, as released, not
    of the largest weight."""
    return (weights * depths).sum(1) > NEAREST_DEPTH, alpha.argmax(1)


def count_seen(
    counters: Tensor,  # [V], changed in place
    vertices: Tensor,  # [N, 10] int64 that end rays
) -> None:
    """One more for every vertex among these, however often it is."""
    seen = torch.zeros_like(counters, dtype=torch.bool)
    seen[vertices.flatten()] = True
    counters += seen.to(counters)
