"""Where the person's rays are sampled: VolSDF's error-bounded sampling (Yariv et al. 2021, sec. 3.4; Vid2Avatar,
ray_sampler.py).

The opacity of a ray, summed over intervals of length δ, is off by at most

    e^{-∫σ} (e^{Σ δ² e^{-d*/b} / 4b²} - 1)

with d* the least distance that the surface can have within an interval. While that exceeds ε the ray gets samples
where the bound grows, and is sampled with the smallest spread b' >= b for which the bound holds. Without rounds
(`quick`) it is sampled by the weights of the even samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ihbench.render.volumes.density_laws import laplace_density

ERROR = 0.1  # ε
BISECTIONS = 10
LARGEST_EXPONENT = 13.8  # of the bound: e^13.8 = 1e6


@dataclass(frozen=True)
class SampleCounts:
    even: int  # first, and in each round
    rounds: int
    by_weight: int
    extra: int  # of those already there, so that what is empty is sampled, too

    @property
    def total(self) -> int:
        """Both ends are among them."""
        return self.by_weight + self.extra + 2


@torch.no_grad()
def ray_samples(
    distance_at: Callable[[Tensor], Tensor],  # t [N, S] -> signed distances [N, S] m
    near: Tensor,  # [N] m
    far: Tensor,  # [N] m
    spread: float,  # b, m
    counts: SampleCounts,
    generator: torch.Generator | None = None,  # None: not at random
) -> Tensor:
    """[N, `counts.total`] m, ascending, from near to far."""
    shares = torch.linspace(0, 1, counts.even, device=near.device).expand(len(near), -1)
    if generator is not None and counts.rounds == 0:
        # one shift for each ray: the even samples are all there is to find the surface by
        move = torch.rand(len(near), 1, generator=generator).to(near.device) / counts.even
        shares = (shares + move - 0.5 / counts.even).clamp(0, 1)
    t = near[:, None] + (far - near)[:, None] * shares
    d = distance_at(t)
    wide = torch.full_like(near, spread)
    for _ in range(counts.rounds):
        if bool((error_bound(t, d, torch.full_like(near, spread)) <= ERROR).all()):
            break
        wide = least_spread(t, d, spread)
        if bool((wide <= spread).all()):
            break
        new = by_density(t, _sections(t, d, wide), counts.even, None)
        t, order = torch.cat([t, new], 1).sort(1)
        d = torch.cat([d, distance_at(new)], 1).gather(1, order)
    if counts.rounds:
        wide = least_spread(t, d, spread)
    sigma = laplace_density(d, wide[:, None])[:, :-1]
    free = sigma * t.diff(dim=1)
    passed = (-torch.cat([torch.zeros_like(free[:, :1]), free.cumsum(1)], 1)).exp()
    chosen = by_density(t, passed[:, :-1] - passed[:, 1:], counts.by_weight, generator)
    if generator is None:
        kept = torch.linspace(0, t.shape[1] - 1, counts.extra, device=t.device).long()
    else:
        kept = torch.randperm(t.shape[1], generator=generator)[: counts.extra].to(t.device)
    return torch.cat([near[:, None], far[:, None], chosen, t[:, kept]], 1).sort(1).values


def least_distance(t: Tensor, d: Tensor) -> Tensor:
    """[N, S - 1] d*: how near the surface can come within each interval, from the distances at its ends."""
    a, b, c = t.diff(dim=1), d[:, :-1].abs(), d[:, 1:].abs()
    half = (a + b + c) / 2
    area = (half * (half - a) * (half - b) * (half - c)).clamp(min=0).sqrt()
    height = 2 * area / a.clamp(min=1e-12)
    least = torch.where(a.square() + b.square() <= c.square(), b, height)
    least = torch.where(a.square() + c.square() <= b.square(), c, least)
    least = torch.where(b + c <= a, 0.0, least)  # no such triangle: the surface is between
    return torch.where(d[:, :-1].sign() * d[:, 1:].sign() > 0, least, 0.0)


def error_bound(
    t: Tensor,  # [N, S]
    d: Tensor,  # [N, S]
    spread: Tensor,  # [N]
) -> Tensor:
    """[N] bound of the error of a ray's opacity, the largest over its intervals."""
    return _sections(t, d, spread).max(1).values


def _sections(t: Tensor, d: Tensor, spread: Tensor) -> Tensor:
    """[N, S - 1] the bound up to each interval."""
    step, b = t.diff(dim=1), spread[:, None]
    free = laplace_density(d, b)[:, :-1] * step
    before = torch.cat([torch.zeros_like(free[:, :1]), free.cumsum(1)[:, :-1]], 1)
    error = ((-least_distance(t, d) / b).exp() * step.square() / (4 * b.square())).cumsum(1)
    return error.clamp(max=LARGEST_EXPONENT).expm1() * (-before).exp()


def least_spread(t: Tensor, d: Tensor, spread: float) -> Tensor:
    """[N] the smallest b' >= b, by bisection, under which the bound holds; b where b itself is enough."""
    wanted = torch.full_like(t[:, 0], spread)
    safe = (t.diff(dim=1).square().sum(1) / (4 * torch.tensor(1 + ERROR).log())).sqrt().clamp(min=spread)
    low, high = wanted, safe
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        holds = error_bound(t, d, middle) <= ERROR
        low, high = torch.where(holds, low, middle), torch.where(holds, middle, high)
    return torch.where(error_bound(t, d, wanted) <= ERROR, wanted, high)


def by_density(
    t: Tensor,  # [N, S] ascending
    mass: Tensor,  # [N, S - 1] of the intervals, >= 0
    count: int,
    generator: torch.Generator | None,
) -> Tensor:
    """[N, count] places by inverse transform sampling, even where there is no mass at all."""
    share = mass + 1e-5
    share = share / share.sum(1, keepdim=True)
    up_to = torch.cat([torch.zeros_like(share[:, :1]), share.cumsum(1)], 1)
    if generator is None:
        u = (torch.arange(count, device=t.device) + 0.5).expand(len(t), -1) / count
    else:
        u = (torch.arange(count) + torch.rand(len(t), count, generator=generator)).to(t.device) / count
    k = torch.searchsorted(up_to, u.contiguous(), right=True).clamp(1, t.shape[1] - 1)
    low, high = up_to.gather(1, k - 1), up_to.gather(1, k)
    part = ((u - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return torch.lerp(t.gather(1, k - 1), t.gather(1, k), part)
