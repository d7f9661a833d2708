"""OccNeRF's radiance field in a pose, as the volume renderer asks for it.

A posed place is warped back to the T-pose by the motion weights; what it is there is read from features of the body's
surface alone. No gradient goes through the place: the motion weights learn from the likelihood by which opacities are
multiplied, and a deformation that moved the place (the released code has an idle one) would learn nothing at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ihbench.methods.occnerf.canonical_surface import NEIGHBOURS, OF_A_VERTEX, CanonicalSurface
from ihbench.methods.occnerf.config import OccNerfConfig
from ihbench.methods.occnerf.decoder import SurfaceDecoder
from ihbench.methods.occnerf.projection import (
    SAMPLE_SPAN,
    VERTEX_SPAN,
    grid_place,
    projected,
    signed_distance,
)
from ihbench.methods.occnerf.visibility import neighbour_weights
from ihbench.nets.bone_lookups import BoneWeights
from ihbench.nets.hash_grid_4d import HashGrid4d
from ihbench.nets.weighted_rows import weighted_rows
from ihbench.render.volumes.density_laws import softplus_density
from ihbench.render.volumes.field import FieldValues
from ihbench.render.volumes.rays import Rays


class OnSurface(Protocol):
    """What the field is made of: an avatar."""

    config: OccNerfConfig
    surface: CanonicalSurface
    grid: HashGrid4d
    decoder: SurfaceDecoder
    counters: Tensor  # [V]

    def displaced(self) -> Tensor:
        """[V, 3] m."""
        ...


@dataclass(frozen=True, kw_only=True)
class SurfaceValues(FieldValues):
    """With what the completeness prior and the visibility counter look at."""

    raw: Tensor  # [M] density before its law
    inside: Tensor  # [M] bool: of the body
    canonical: Tensor  # [M, 3] m


def vertex_features(avatar: OnSurface) -> Tensor:
    """[V, 35]: hash features of each displaced vertex against its three nearest base vertices, and where it is.
    Differentiable in the displacements, too."""
    surface, moved = avatar.surface, avatar.displaced()
    near = surface.nearest_three(moved).long()
    vertices, normals = surface.vertices[near], surface.normals[near]
    apart = moved[:, None] - vertices
    distance, _ = signed_distance(apart, normals)
    place = grid_place(projected(apart, normals, vertices), distance, surface.bound, VERTEX_SPAN)
    return torch.cat([avatar.grid(place), moved], 1)


@dataclass(frozen=True)
class Decoded:
    """The field at places of the T-pose."""

    raw: Tensor  # [M]
    rgb: Tensor  # [M, 3]
    inside: Tensor  # [M] bool


def decoded(
    avatar: OnSurface,
    features: Tensor,  # [V, 35]
    places: Tensor,  # [M, 3] m, canonical
) -> Decoded:
    """Differentiable in features, grid and networks, not in the places."""
    surface, places = avatar.surface, places.detach()
    near = surface.neighbours(places)
    with torch.no_grad():
        ten = near[:, :NEIGHBOURS]
        vertices, normals = surface.vertices[ten], surface.normals[ten]
        apart = places[:, None] - vertices
        distance, inside = signed_distance(apart, normals)
        # a cell's places share their neighbours, not the order of these
        three = apart.square().sum(-1).topk(OF_A_VERTEX, largest=False).indices[..., None].expand(-1, -1, 3)
        point = projected(*(each.gather(1, three) for each in (apart, normals, vertices)))
        place = grid_place(point, distance, surface.bound, SAMPLE_SPAN)
        weights, variance = neighbour_weights(avatar.counters[near])
    own = avatar.grid(place)
    everyone = torch.arange(len(places), device=places.device)
    lent = weighted_rows(features, near, weights, everyone)
    raw, rgb = avatar.decoder(lent, variance, own)
    return Decoded(raw, rgb, inside)


class PosedField:
    """The field as it is seen in one pose, in the root's frame; a `render.volumes.field.Field`."""

    def __init__(self, avatar: OnSurface, bones: BoneWeights, features: Tensor):
        self.avatar, self.bones, self.features = avatar, bones, features

    def likelihood(self, rays: Rays, depths: Tensor) -> Tensor:
        return self.bones.likelihood(rays, depths, self.avatar.config.least_weight)

    def values(self, points: Tensor) -> SurfaceValues:
        config = self.avatar.config
        likelihood, canonical = self.bones.located(points, config.least_weight)
        canonical = canonical.detach()
        found = decoded(self.avatar, self.features, canonical)
        return SurfaceValues(
            found.rgb,
            softplus_density(found.raw),
            likelihood.clamp(max=1) if config.clamp else likelihood,
            raw=found.raw,
            inside=found.inside,
            canonical=canonical,
        )
