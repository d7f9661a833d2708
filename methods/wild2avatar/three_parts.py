"""A ray in three parts: before, inside and beyond two spheres about the person (Wild2Avatar's project page).

With the frame's centre as origin, camera o, unit direction d, outer sphere Π of radius R and inner sphere π of
radius r: from the camera to the entry into π lies the occlusion, from there to the exit of Π the person, beyond Π the
background. Occlusion and background have the coordinates of an inverted sphere, (p/ρ, -1/ρ) and (p/ρ, 1/ρ) with
ρ = |p|, and one network: the sign of the fourth keeps them apart. Lengths are in units in which R = 3, as in
Vid2Avatar, whose camera is inside Π. The radius r and what a ray does that misses π are inferred; see METHOD.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

OUTER = 3.0  # R
FARTHEST_CAMERA = OUTER / 1.1  # distance of the farthest training camera from the person
INNER = 1.1  # r over the distance of the farthest vertex from the frame's centre [inferred]
INSIDE = 0.95  # r is at most this share of the camera's distance: the camera is outside π
LEAST_ROOT = 1e-12


@dataclass(frozen=True)
class ThreeParts:
    """Where rays cross the spheres."""

    origins: Tensor  # [N, 3] camera, frame-centred
    directions: Tensor  # [N, 3] unit
    enter: Tensor  # [N] t of the entry into π, of the closest approach for rays that miss it; at least 0
    leave: Tensor  # [N] t of the exit of Π; at least `enter`
    outer: float = OUTER

    def occlusion(self, shares: Tensor) -> tuple[Tensor, Tensor]:
        """Samples at these shares [S] or [N, S] of the way from the camera to the entry, even in 1/ρ: coordinates
        [N, S, 4], whose fourth falls from -1/|o| to -1/r, and lengths [N, S] in 1/ρ. The last length is an ordinary
        one: an endless one would make the layer opaque."""
        near = 1 / self.origins.norm(dim=1)
        entry = self.origins + self.enter[:, None] * self.directions
        far = 1 / entry.norm(dim=1).clamp(min=1e-6)
        inverse = near[:, None] + (far - near).clamp(min=0)[:, None] * shares
        step = inverse.diff(dim=1)
        last = step[:, -1:] if step.shape[1] else (far - near).clamp(min=0)[:, None]
        return torch.cat([self._directions(inverse, -1), -inverse[..., None]], -1), torch.cat([step, last], 1)

    def background(self, shares: Tensor) -> tuple[Tensor, Tensor]:
        """Samples at these shares [S] or [N, S] of the way from Π (0) to infinity (1), even in 1/ρ: coordinates
        [N, S, 4], whose fourth falls from 1/R to 0, and lengths [N, S] in 1/ρ, the last of which is endless."""
        near = 1 / torch.maximum(self._missed(), self.origins.new_tensor(self.outer))
        inverse = near[:, None] * (1 - shares.expand(len(near), -1))
        endless = torch.full_like(near, 1e10)[:, None]
        return torch.cat([self._directions(inverse, 1), inverse[..., None]], -1), torch.cat(
            [-inverse.diff(dim=1), endless], 1
        )

    def _missed(self) -> Tensor:
        """[N] distance between centre and line."""
        along = (self.origins * self.directions).sum(1)
        return (self.origins.square().sum(1) - along.square()).clamp(min=0).sqrt()

    def _directions(self, inverse: Tensor, side: int) -> Tensor:
        """[N, S, 3] p/ρ of the places with these 1/ρ [N, S] before (side -1) or behind (1) the closest approach. For
        1/ρ = 0 it is the direction."""
        along = (self.origins * self.directions).sum(1)[:, None]
        height = (inverse * self._missed()[:, None]).square()
        scaled = -along * inverse + side * (1 - height).clamp(min=0).sqrt()
        towards = self.origins[:, None] * inverse[..., None] + self.directions[:, None] * scaled[..., None]
        return towards / towards.norm(dim=-1, keepdim=True).clamp(min=1e-12)


def three_parts(
    origins: Tensor,  # [N, 3] frame-centred, in units of R / 3
    directions: Tensor,  # [N, 3] unit
    inner: float,
    outer: float = OUTER,
) -> ThreeParts:
    """Cut rays at both spheres. A ray that misses π is cut at its closest approach to the centre; one that misses Π,
    from a camera outside it, likewise, and has no part inside."""
    along = (origins * directions).sum(1)
    height = origins.square().sum(1) - along.square()
    enter = -along - (inner**2 - height).clamp(min=0).sqrt()
    leave = -along + (outer**2 - height).clamp(min=0).sqrt()
    enter = enter.clamp(min=0)
    return ThreeParts(origins, directions, enter, torch.maximum(leave, enter), outer)


def inner_radius(
    reach: float,  # of the farthest vertex from the frame's centre
    camera: float,  # its distance from there
) -> float:
    """r: the whole body is inside, the camera is not."""
    return min(INNER * reach, INSIDE * camera)
