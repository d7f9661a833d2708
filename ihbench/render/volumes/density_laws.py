"""From what a network says to a density in 1/m, and from a density to the opacity of a piece of ray."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def relu_density(raw: Tensor) -> Tensor:
    """NeRF and HumanNeRF: max(raw, 0). Without a gradient where it is 0."""
    return raw.relu()


def softplus_density(raw: Tensor) -> Tensor:
    """OccNeRF: ln(1 + exp raw), .693 at 0."""
    return F.softplus(raw)


def laplace_density(
    distance: Tensor,  # m, signed: negative inside
    beta: Tensor | float,  # m, > 0: how soft the surface is
) -> Tensor:
    """VolSDF (Yariv et al. 2021, eq. 2 and 3): 1/β times the Laplace distribution function of -distance.

    1/(2β) on the surface, 1/β deep inside, 0 far outside.
    """
    # not `abs`, whose gradient at 0 is 0: σ is smooth there
    away = torch.where(distance > 0, distance, -distance)
    tail = 0.5 * torch.exp(-away / beta)  # the exponent is never positive: no overflow, no NaN in gradients
    return torch.where(distance > 0, tail, 1 - tail) / beta


def opacity(
    density: Tensor,  # [...] 1/m
    lengths: Tensor,  # [...] m
) -> Tensor:
    """[...] 1 - exp(-density · length), of small ones to full relative precision."""
    return -torch.expm1(-density * lengths)
