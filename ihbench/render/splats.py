"""Gaussians projected to one image, and the constants with which every back end composites them; see `splat.py`."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

NEAR = 0.01  # m; a Gaussian whose centre is no farther than this from the camera plane is not drawn
LOW_PASS = 0.3  # px²; added to every footprint, so that a splat smaller than a pixel cannot fall between the centres
ALPHA_MAX = 0.999  # an opaque splat still lets 1/1000 through: the transmittance never reaches 0 in one step
ALPHA_MIN = 1 / 255  # an alpha below one grey level is dropped, which ends the footprint at 3.33 sigma


@dataclass(frozen=True)
class Splats:
    """Gaussians projected to one image: what a back end composites. Float64 apart from the colours and the depth."""

    xy: Tensor  # [M, 2] px
    variance: Tensor  # [M] px², low-pass included
    depth: Tensor  # [M] m, float32, without gradient: it only orders
    colors: Tensor  # [M, C]
