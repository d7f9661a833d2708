"""Gaussians projected to one image, and the constants with which every back end composites them; see `splat.py`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEAR = 0.01  # m; a Gaussian whose centre is no farther than this from the camera plane is not drawn
LOW_PASS = 0.3  # px²; added to every footprint, so that a splat smaller than a pixel cannot fall between the centres
ALPHA_MAX = 0.999  # an opaque splat still lets 1/1000 through: the transmittance never reaches 0 in one step
ALPHA_MIN = 1 / 255  # an alpha below one grey level is dropped, which ends the footprint at 3.33 sigma
CLAMP = 0.3  # of half the image: how far beside it the off-axis terms of a footprint go on growing


@dataclass(frozen=True)
class Preset:
    """The constants of a renderer."""

    alpha_max: float = ALPHA_MAX
    alpha_min: float = ALPHA_MIN
    stop: float = 0.0  # a splat that would bring the transmittance to this or less ends its pixel and is not drawn
    near: float = NEAR
    low_pass: float = LOW_PASS
    clamp: float = CLAMP


PRESETS = {
    "opaque": Preset(),
    # Kerbl et al. 2023, released code, and gsplat 1.6; near plane and clamp as gsplat has them
    "3dgs": Preset(alpha_max=0.99, stop=1e-4),
}


@dataclass(frozen=True)
class Splats:
    """Opaque circles: the footprints of isotropic Gaussians. Float64 apart from the colours and the depth."""

    xy: Tensor  # [M, 2] px
    variance: Tensor  # [M] px², low-pass included
    depth: Tensor  # [M] m, float32, without gradient: it only orders
    colors: Tensor  # [M, C]


@dataclass(frozen=True)
class Ellipses:
    """The footprints of general Gaussians. Float64 apart from the opacities, the colours and the depth."""

    xy: Tensor  # [M, 2] px
    covariance: Tensor  # [M, 3] px²: xx, xy, yy, low-pass included
    opacity: Tensor  # [M] 0..1
    depth: Tensor  # [M] m, float32, without gradient: it only orders
    colors: Tensor  # [M, C]


def as_ellipses(splats: Splats | Ellipses) -> Ellipses:
    """Opaque circles are ellipses, too."""
    if isinstance(splats, Ellipses):
        return splats
    v = splats.variance
    covariance = torch.stack([v, torch.zeros_like(v), v], 1)
    return Ellipses(splats.xy, covariance, torch.ones_like(v), splats.depth, splats.colors)


@dataclass
class Screen:
    """What density control needs to know about each Gaussian of one picture."""

    radius: Tensor  # [N] px: where alpha ends, along the longer axis; 0 for Gaussians that are not in the picture
    gradient: Tensor | None = None  # [N, 2] along the centres, per px; of all backward passes so far, None before

    @property
    def visible(self) -> Tensor:
        """[N] bool: those that reach a pixel, be they hidden behind others or not."""
        return self.radius > 0

    def add(self, gradient: Tensor) -> None:
        """One more backward pass's gradient along the centres, [N, 2] per px."""
        self.gradient = gradient if self.gradient is None else self.gradient + gradient
