"""A place against the surface: its signed distance, and the point between the nearest vertices that stands for it.

As released (tiangexiang/OccNeRF 1cb1ef3, canonical_mlps/occnerf_mlp.py:142-176, network.py:263-284). The distance is
the mean of the distances to all neighbours, so it is never near 0: about 1.6 cm on the surface of a body of 8500
vertices, and jumps from minus that to plus that across it.
"""

from __future__ import annotations

import torch
from torch import Tensor

DISTANCE_SHIFT = 0.2  # m: the signed distance that is 0 for the hash grid
SAMPLE_SPAN, VERTEX_SPAN = 0.5, 0.8  # m that are 1 for it: of samples, and, as released, another of vertices
SMALLEST = 1e-8  # of a length or a sum of weights that is divided by


def signed_distance(
    apart: Tensor,  # [M, k, 3] m, from each neighbour to the place
    normals: Tensor,  # [M, k, 3] of the neighbours
) -> tuple[Tensor, Tensor]:
    """Signed distance [M] m, the mean distance to the neighbours, and whether the place is inside [M]: behind the
    tangent planes of more than half of them. A place on a vertex has no gradient there."""
    inside = ((apart * normals).sum(-1) < 0).sum(1) * 2 > apart.shape[1]
    mean = apart.square().sum(-1).clamp(min=SMALLEST**2).sqrt().mean(1)
    return torch.where(inside, -mean, mean), inside


def projected(
    apart: Tensor,  # [M, 3, 3] m, from each of the three nearest vertices to the place
    normals: Tensor,  # [M, 3, 3]
    vertices: Tensor,  # [M, 3, 3] m
) -> Tensor:
    """[M, 3] m: the mean of the three vertices, each weighted by |cos| of the angle at which the place lies over it;
    their plain mean where the place lies in all three tangent planes."""
    length = apart.square().sum(-1).clamp(min=SMALLEST**2).sqrt()
    weight = ((apart * normals).sum(-1) / length).abs() + SMALLEST
    return (weight[..., None] * vertices).sum(1) / weight.sum(1, keepdim=True)


def grid_place(
    point: Tensor,  # [M, 3] m, on the surface
    distance: Tensor,  # [M] m, signed
    bound: float,  # m
    span: float,  # m
) -> Tensor:
    """[M, 4] in 0..1: where the hash grid is read."""
    scaled = (point + bound) / (2 * bound)
    return torch.cat([scaled, ((distance + DISTANCE_SHIFT) / span).clamp(0, 1)[:, None]], 1)
