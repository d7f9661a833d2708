"""The completeness prior: density inside the body costs nothing, none there costs ten.

As released (tiangexiang/OccNeRF 1cb1ef3, network.py:486-499, trainer.py:167-186): the mean over all samples of
rays of 10 · [inside] · exp(clip(-relu(σ), -10, 0)), σ before its activation. Where σ is not above 0, or 10 and more,
there is no gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

COST = 10.0  # of a sample inside without density
DENSE = 10.0  # of σ: solid enough


@dataclass(frozen=True)
class Completeness:
    """The prior's value, split by where it comes from."""

    body: Tensor  # scalar, from samples that are evaluated
    collapsed: Tensor  # scalar, from those that the warp drops onto the origin

    @property
    def total(self) -> Tensor:
        return self.body + self.collapsed


def sample_costs(
    sigma: Tensor,  # [M] before the activation
    inside: Tensor,  # [M] bool
) -> Tensor:
    """[M]: 0 outside, 10 where nothing is, 4.54e-4 where it is solid."""
    return torch.where(inside, COST * sigma.relu().clamp(max=DENSE).neg().exp(), 0.0)


def completeness(
    sigma: Tensor,  # [M] of the samples that are evaluated
    inside: Tensor,  # [M] bool
    samples: float,  # how many there are on all rays, evaluated or not
    origin: tuple[Tensor, Tensor] | None = None,  # σ and inside of the canonical origin, scalars
    shares: Tensor | None = None,  # [M] of one of those samples that each evaluated one stands for; None: one each
) -> Completeness:
    """The mean over all samples. With `origin` those not evaluated count as lying there, as in the released code,
    which warps every place without motion weights to the canonical origin: inside the torso."""
    costs = sample_costs(sigma, inside)
    body = (costs if shares is None else costs * shares).sum() / max(samples, 1)
    if origin is None:
        return Completeness(body, torch.zeros_like(body))
    evaluated = len(sigma) if shares is None else float(shares.sum())
    skipped = max(samples - evaluated, 0)
    return Completeness(body, sample_costs(*origin) * (skipped / max(samples, 1)))
