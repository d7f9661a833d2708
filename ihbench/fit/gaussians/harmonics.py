"""Colours of Gaussians as spherical harmonics whose degree rises during the fit, in two attributes of the set."""

from __future__ import annotations

import torch
from torch import Tensor

from ihbench.fit.gaussians.gaussian_set import Gaussians

Y00 = 0.28209479177387814  # the spherical harmonic of degree 0
DC, REST = "sh_dc", "sh_rest"  # attributes: degree 0, and above, [N, 1, 3] and [N, (degree + 1)² - 1, 3]


def grey_harmonics(count: int, grey: float, highest: int) -> dict[str, Tensor]:
    """The attributes of so many Gaussians of one grey, 0..1, from every side; `REST` only above degree 0."""
    above = (highest + 1) ** 2 - 1
    colours = {DC: torch.full((count, 1, 3), (grey - 0.5) / Y00)}
    return colours | ({REST: torch.zeros(count, above, 3)} if above else {})


def harmonics_in_use(gaussians: Gaussians, degree: int) -> Tensor:
    """[N, (degree + 1)², 3]."""
    above = (degree + 1) ** 2 - 1
    first = gaussians.attributes[DC]
    return torch.cat([first, gaussians.attributes[REST][:, :above]], 1) if above else first
