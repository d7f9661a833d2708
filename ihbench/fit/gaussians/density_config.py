"""Switches of density control (`ihbench.fit.gaussians.density`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check

STEP = Within(0, STEPS)
LENGTH = Within(0, 1e6, above=True)
NATS = Within(0, 1e9)
OPACITY = Within(0, 1)


@dataclass(frozen=True)
class DensityConfig:
    """The defaults are GauHuman's, as released (scene/gaussian_model.py:573-601, arguments/__init__.py:78-94); steps
    are counted from 1. None leaves a part out."""

    after: Annotated[int, STEP] = 400
    """Density changes after this step …"""
    before: Annotated[int, STEP] = 1000
    """… and before this one, up to which the screen gradient is gathered …"""
    every: Annotated[int, Within(1, STEPS)] = 100
    """… at multiples of this number."""
    gradient: Annotated[float, Within(0, 1e15, above=True)] = 2e-4
    """Gaussians grow whose mean screen gradient, per half image, is at least this."""
    size: Annotated[float, LENGTH] = 0.01
    """Of those, ones of at most this size in m are cloned or merged, larger ones split."""
    clone: Literal["sampled", "in_place", "off"] = "sampled"
    """Where a copy goes: to a place drawn from the Gaussian (GauHuman), or where it is (3DGS). Merging
    would take back a copy in place at once: turn one of the two off."""
    split: bool = True
    """Whether large ones are replaced by smaller ones, placed by draws from them."""
    children: Annotated[int, Within(2, 100)] = 2
    """How many of them."""
    shrink: Annotated[float, Within(1, 1000)] = 1.6
    """By what their scale is divided."""
    kl_grow: Annotated[float, NATS] | None = 0.4
    """Only Gaussians whose divergence to their nearest neighbour is above this are cloned or split. None: all."""
    kl_merge: Annotated[float, NATS] | None = 0.1
    """Those whose divergence is below this are merged with that neighbour. None: no merging."""
    merge_shrink: Annotated[float, Within(0, 1000, above=True)] = 0.8
    """By what the scale of a merged one is divided."""
    pairs: Literal["released", "disjoint"] = "released"
    """Merging: each gives one of itself and its neighbour, so two that choose each other give two at one place
    (GauHuman); or each is in one pair at most, the closest first."""
    indexing: Literal["fixed", "released"] = "fixed"
    """Whether merging reads a Gaussian's own gradient, or that of the row where it was before splitting removed rows,
    as GauHuman does."""
    faint: Annotated[float, OPACITY] | None = 0.005
    """Gaussians below this opacity are pruned."""
    largest: Annotated[float, LENGTH] | None = None
    """Gaussians above this size in m are pruned (3DGS-Avatar .35 after step 3000, GTU .05, then .5)."""
    widest: Annotated[float, LENGTH] | None = None
    """Gaussians that were drawn with a radius above this in px since the last change are pruned. 3DGS and what is
    made from it say 20, but set all radii to zero before they look: as released is None."""
    size_after: Annotated[int, STEP] = 0
    """Both prune by size only after this step."""
    resets: tuple[Annotated[int, STEP], ...] = ()
    """Steps after which no opacity is above `reset_to`, whatever `after`, `before` and `every` say. 3DGS-Avatar 3000,
    6000, 9000; GauHuman 400 on a white background and never on a black one."""
    reset_to: Annotated[float, OPACITY] = 0.01
    """The most that a reset leaves of an opacity."""
    most: Annotated[int, Within(1, 1_000_000_000)] = 1_000_000
    """Gaussians there may be; those of the largest gradient grow first."""

    @property
    def grows(self) -> bool:
        """Whether anything depends on the screen gradient."""
        return self.clone != "off" or self.split or self.kl_merge is not None

    def changes_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split, merged and pruned after step `step`."""
        return self.after < step < self.before and step % self.every == 0

    def __post_init__(self) -> None:
        check(self, "--method.density.")
