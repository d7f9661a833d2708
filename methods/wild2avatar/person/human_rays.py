"""The person along rays: where to look, signed distances, the colours where they count, composited."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ihbench.methods.wild2avatar.person.human_field import HumanField
from ihbench.methods.wild2avatar.person.inverse_skinning import PosedBody
from ihbench.methods.wild2avatar.person.near_body import REACH
from ihbench.methods.wild2avatar.person.ray_samples import SampleCounts, ray_samples
from ihbench.methods.wild2avatar.person.sdf_network import SdfNetwork
from ihbench.render.volumes.compositing import ray_weights, scattered_composite
from ihbench.render.volumes.density_laws import laplace_density, opacity
from ihbench.render.volumes.rays import Rays

BEYOND = 4.0  # m: the distance of what is farther than `REACH` from the posed body
BESIDE = 0.05  # m: a ray that never comes nearer to the surface passes beside it


@dataclass(frozen=True)
class HumanRays:
    """What rays show of the person."""

    rgb: Tensor  # [N, 3] premultiplied
    alpha: Tensor  # [N]
    beside: Tensor  # [N] bool: asked of, and no sample is within `BESIDE` of the surface of `outline`


@dataclass(frozen=True)
class HumanMarch:
    """How the person's rays are taken."""

    counts: SampleCounts
    least: float = 0.0  # samples whose weight is below this share of their ray's largest have no colour, no gradient
    cut: bool = True  # what is beyond `REACH` of the posed body is empty
    generator: torch.Generator | None = None  # None: samples not at random
    outline: SdfNetwork | None = None  # whose surface `beside` is about
    asked: Tensor | None = None  # [N] bool, the rays that `beside` is asked of; None for all


def march_human(
    field: HumanField,
    posed: PosedBody,
    rays: Rays,  # world, unit directions
    near: Tensor,  # [N] m
    far: Tensor,  # [N] m; not beyond `near` for rays that see nothing
    pose: Tensor | None,  # [69] rad that shape and colour follow; None for none
    how: HumanMarch,
) -> HumanRays:
    """Differentiable in the field's parameters and in the bones of `posed`."""
    met = (near < far).nonzero()[:, 0]
    rgb, alpha = near.new_zeros(len(near), 3), near.new_zeros(len(near))
    beside = torch.zeros_like(near, dtype=torch.bool)
    if not len(met):
        return HumanRays(rgb, alpha, beside)
    rays = rays[met]
    spread = field.spread

    def distance_at(t: Tensor) -> Tensor:
        own = posed.to_canonical(rays.points(t).flatten(0, 1))
        distance = field.sdf(own.points, pose)[0]
        if how.cut:
            distance = torch.where(own.away > REACH, BEYOND, distance)
        return distance.view_as(t)

    with torch.no_grad():
        t = ray_samples(distance_at, near[met], far[met], spread.item(), how.counts, how.generator)
        lengths = torch.cat([t.diff(dim=1), torch.zeros_like(t[:, :1])], 1)
        places = rays.points(t)
        canonical = posed.to_canonical(places.flatten(0, 1))
        distance = field.sdf(canonical.points, pose)[0].view_as(t)
        empty = (canonical.away > REACH).view_as(t) & how.cut
        opacities = opacity(laplace_density(torch.where(empty, BEYOND, distance), spread), lengths)
        weights = ray_weights(opacities)[0]
        active = weights >= how.least * weights.amax(1, keepdim=True)
        active &= ~empty
        if how.outline is not None:
            asked = torch.ones_like(met, dtype=torch.bool) if how.asked is None else how.asked[met]
            points = canonical.points.view(*t.shape, 3)[asked].flatten(0, 1)
            outline = how.outline(points, None)[0].view(-1, t.shape[1])
            beside[met[asked]] = outline.amin(1) > BESIDE
    own = posed.to_canonical(places[active])
    value, features, gradient = field.sdf.with_gradient(own.points, pose)
    normals = F.normalize((gradient[:, None] @ own.back)[:, 0], dim=1)
    colours = field.colour(own.points, normals, features, pose)
    alphas = opacities.masked_scatter(active, opacity(laplace_density(value, spread), lengths[active]))
    shown = scattered_composite(alphas, colours, t, active)
    return HumanRays(rgb.index_copy(0, met, shown.rgb), alpha.index_copy(0, met, shown.alpha), beside)
