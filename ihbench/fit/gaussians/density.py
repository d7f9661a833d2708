"""Density control: Gaussians are cloned, split, merged and pruned where the screen gradient asks for it.

As 3DGS has it (graphdeco-inria/gaussian-splatting, scene/gaussian_model.py), with the gate, the merging and the order
of GauHuman (scene/gaussian_model.py:573-625): clone, split, merge, prune. The operations stand alone;
`DensityControl` puts them together. Random places are drawn from generators of their own, by seed, step and
operation, so a fit that was stopped goes on as it would have, with nothing to save of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.checkpoints import Tensors
from ihbench.errors import Diverged
from ihbench.fit.gaussians.adam import GaussianAdam
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.density_state import DensityState
from ihbench.fit.gaussians.divergence import gaussian_divergence
from ihbench.fit.gaussians.gaussian_set import Gaussians, Rows, to_logit
from ihbench.fit.gaussians.neighbours import distance_to, nearest
from ihbench.fit.gaussians.skinned_covariance import quaternion_to_matrix

Mask = Callable[[Gaussians], Tensor]  # [N] bool of the set as it then is
CLONE, SPLIT = range(2)  # what random numbers are drawn for
SURE = 20.0  # the logit that an opacity of 1 counts as in a mean


# --- operations; each changes the set and returns where its rows came from ---


def clone(adam: GaussianAdam, chosen: Tensor, generator: np.random.Generator | None = None) -> Rows:
    """Add a copy of each of the chosen (mask [N]): in place, or with a generator at a place drawn from it."""
    parents = chosen.nonzero()[:, 0]
    rows = Rows.made(torch.ones_like(chosen), parents)
    adam.rearrange(rows, None if generator is None else {"means": drawn_from(adam.gaussians, parents, generator)})
    return rows


def split(
    adam: GaussianAdam,
    chosen: Tensor,  # [N] bool
    generator: np.random.Generator,
    *,
    children: int = 2,
    shrink: float = 1.6,
    stays: Tensor | None = None,  # [N] bool
) -> Rows:
    """Replace each of the chosen by children at places drawn from it, with scales divided by `shrink`, equal in all
    else. Those of `stays` remain beside their children."""
    parents = chosen.nonzero()[:, 0].repeat(children)
    gaussians = adam.gaussians
    rows = Rows.made(~chosen if stays is None else ~chosen | stays, parents)
    own = {
        "means": drawn_from(gaussians, parents, generator),
        "log_scales": gaussians.log_scales.detach()[parents] - math.log(shrink),
    }
    adam.rearrange(rows, own)
    return rows


def merge(
    adam: GaussianAdam,
    first: Tensor,  # [P] int64
    second: Tensor,  # [P] int64
    *,
    shrink: float = 0.8,
) -> Rows:
    """For each pair a Gaussian with the pair's mean centre, opacity logit and further attributes, and with the first
    one's rotation, what it carries, and its scale divided by `shrink`. All that are in a pair are removed. The pair's
    covariance is not kept: that is GauHuman's rule (kl_merge)."""
    gaussians = adam.gaussians
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=first.device)
    keep[first] = keep[second] = False
    own = {name: (p.detach()[first] + p.detach()[second]) / 2 for name, p in gaussians.attributes.items()}
    logits = gaussians.opacity_logits.detach().nan_to_num(posinf=SURE, neginf=-SURE)
    own["opacity_logits"] = (logits[first] + logits[second]) / 2
    own["quaternions"] = gaussians.quaternions.detach()[first]
    own["log_scales"] = gaussians.log_scales.detach()[first] - math.log(shrink)
    rows = Rows.made(keep, first)
    adam.rearrange(rows, own)
    return rows


def prune(adam: GaussianAdam, keep: Tensor) -> Rows:
    """Remove all but those to keep (mask [N])."""
    rows = Rows.made(keep, torch.empty(0, dtype=torch.int64, device=keep.device))
    adam.rearrange(rows)
    return rows


def reset_opacity(adam: GaussianAdam, most: float = 0.01) -> None:
    """No opacity above `most`; moments of all opacities are zero and Adam's step count goes on, as released. A
    gradient that waits for Adam is dropped."""
    logits = adam.gaussians.opacity_logits
    everything = torch.ones(len(adam.gaussians), dtype=torch.bool, device=logits.device)
    adam.set_rows("opacity_logits", everything, logits.detach().clamp(max=to_logit(torch.tensor(most)).item()))
    logits.grad = None


# --- what they go by ---


@torch.no_grad()
def drawn_from(gaussians: Gaussians, chosen: Tensor, generator: np.random.Generator) -> Tensor:
    """[F, 3] m: a place drawn from each of the chosen Gaussians (numbers [F]): μ + R(q) N(0, s²)."""
    means = gaussians.means[chosen]
    along = torch.from_numpy(generator.standard_normal((len(chosen), 3))).to(means) * gaussians.scales[chosen]
    return means + (quaternion_to_matrix(gaussians.quaternions[chosen]) @ along[:, :, None])[:, :, 0]


@torch.no_grad()
def divergence_to_nearest(gaussians: Gaussians) -> tuple[Tensor, Tensor]:
    """[N] float64 divergence of each Gaussian from its nearest neighbour by centre, KL(own ‖ neighbour), and [N]
    int64 the neighbour's number. A single Gaussian is infinitely far from any other: it may grow, never merge."""
    _, number = nearest(gaussians.means, 1)
    if not number.shape[1]:
        return torch.full((len(number),), math.inf, dtype=torch.float64, device=number.device), number.new_zeros(
            len(number)
        )
    one = number[:, 0]
    own = (gaussians.means, gaussians.log_scales, gaussians.quaternions)
    return gaussian_divergence(*own, *(each[one] for each in own)), one


def farther_than(points: Tensor, distance: float) -> Mask:
    """Those farther than `distance` in m from all of some points [V, 3]: GauHuman prunes at .05 m from the vertices
    of its canonical body."""
    return lambda gaussians: distance_to(gaussians.means, points)[0] > distance


def outside(low: Tensor, high: Tensor) -> Mask:
    """Those outside a box, corners [3] in m: GTU prunes what leaves its grid of skinning weights."""
    return lambda gaussians: ((gaussians.means < low) | (gaussians.means > high)).any(1)


# --- all of it ---


@dataclass(frozen=True)
class DensityRules:
    """What a method adds to the switches: masks over the set as it is when they are asked. `None`: no such rule."""

    may_grow: Mask | None = None
    """Only these are cloned, split and merged (OccGaussian: those that were seen)."""
    spared: Mask | None = None
    """These are never pruned (GTU: the original vertices; OccGaussian: what is hidden) and not merged."""
    stays: Mask | None = None
    """These stay beside their children when they are split (GTU: the original vertices)."""
    unwanted: Mask | None = None
    """These are pruned, whatever their opacity."""


@dataclass(frozen=True)
class DensityChanged:
    """What happened to the set after a step."""

    kind: ClassVar[str] = "density"
    step: int
    before: int  # Gaussians
    cloned: int  # copies added
    split: int  # Gaussians replaced by children
    merged: int  # Gaussians made from pairs
    pruned: int
    faint: int  # of the pruned, those below the least opacity
    spared: int  # not removed because of a rule
    count: int  # Gaussians now
    reset: bool  # opacities
    refused: int  # screen gradients that were not finite, so far


class DensityControl:
    """Calls the operations when it is time. `config` may be replaced between steps, for a method with several phases.

    After each backward pass `observe`; after Adam's step (or before it, when the step of that iteration shall be lost
    as in the released systems) `after_step`.
    """

    def __init__(self, adam: GaussianAdam, config: DensityConfig, seed: int, rules: DensityRules | None = None):
        self.adam, self.config, self.seed, self.rules = adam, config, seed, rules or DensityRules()
        self.state = DensityState.none(len(adam.gaussians), adam.gaussians.means.device)
        self.kept_back = torch.zeros_like(self.state.steps, dtype=torch.bool)
        """[N] bool: what the last change would have removed but for the rules `spared` and `stays`. To be read before
        the next step; it is not saved."""

    def observe(self, step: int, gradient: Tensor, radius: Tensor, width: int, height: int) -> None:
        """Count the screen gradient of step `step` (`DensityState.add`), if a later change may ask for it."""
        if step < self.config.before:
            self.state.add(gradient, radius, width, height)

    @torch.no_grad()
    def after_step(self, step: int) -> DensityChanged | None:
        """Change the set if step `step` is one to do it after. The state begins anew then.

        Raises `Diverged` when a Gaussian is not finite, and when every one would be pruned: there is then no avatar
        to go on with, and a picture of nothing would pass for one.
        """
        change, reset = self.config.changes_at(step), step in self.config.resets
        if not (change or reset):
            return None
        before = len(self.adam.gaussians)
        cloned = halved = merged = pruned = faint = spared = 0
        if change:
            self._require_finite(step)
            self.kept_back = torch.zeros_like(self.kept_back)
            if self.config.grows:
                cloned, halved, merged = self._grow(step)
            pruned, faint = self._prune(step)
            spared = int(self.kept_back.sum())
            self.state.clear()
        if reset:
            reset_opacity(self.adam, self.config.reset_to)
        count, refused = len(self.adam.gaussians), int(self.state.refused)
        return DensityChanged(step, before, cloned, halved, merged, pruned, faint, spared, count, reset, refused)

    def tensors(self) -> dict[str, Tensor]:
        """Gaussians, moments and statistics by name; not copies."""
        return self.adam.tensors() | self.state.tensors()

    def put(self, tensors: Tensors) -> None:
        """Go back to what `tensors` gave, by copies. Raises `ValueError` for the state of another fit."""
        state = DensityState.of(tensors, self.kept_back.device)
        self.adam.put(tensors)
        self.state = state
        self.kept_back = torch.zeros_like(state.steps, dtype=torch.bool)

    # --- the parts of a change ---

    def _grow(self, step: int) -> tuple[int, int, int]:
        """Clone, split and merge; how many of each."""
        config, adam = self.config, self.adam
        gradient = self.state.mean()  # by the rows of the set as it was before
        room = config.most - len(adam.gaussians)
        chosen = self._chosen(gradient, config.clone != "off", large=False, room=room)
        if cloned := int(chosen.sum()):
            generator = self._generator(step, CLONE) if config.clone == "sampled" else None
            self._follow(clone(adam, chosen, generator))
        added = config.children if self.rules.stays else config.children - 1
        room = (config.most - len(adam.gaussians)) // added
        chosen = self._chosen(self.state.mean(), config.split, large=True, room=room)
        if halved := int(chosen.sum()):
            stays = self._mask(self.rules.stays)
            self.kept_back |= chosen & stays
            generator = self._generator(step, SPLIT)
            rows = split(adam, chosen, generator, children=config.children, shrink=config.shrink, stays=stays)
            self._follow(rows)
        return cloned, halved, self._merge(gradient)

    def _chosen(self, gradient: Tensor, on: bool, *, large: bool, room: int) -> Tensor:
        """[N] bool: if it is on, those large or small ones that shall grow; at most `room`, those of the largest
        gradients, ties by number."""
        config, gaussians = self.config, self.adam.gaussians
        if not on:
            return torch.zeros_like(gradient, dtype=torch.bool)
        chosen = (gradient >= config.gradient) & (self._large() == large) & self._mask(self.rules.may_grow, True)
        if config.kl_grow is not None and chosen.any():
            chosen &= divergence_to_nearest(gaussians)[0] > config.kl_grow
        if int(chosen.sum()) > room:
            first = torch.where(chosen, gradient, -1.0).sort(descending=True, stable=True).indices[: max(room, 0)]
            chosen = torch.zeros_like(chosen).index_fill_(0, first, True)
        return chosen

    def _merge(self, before: Tensor) -> int:
        """Merge; `before` are gradients by the rows of the set as it was before anything grew."""
        config, gaussians = self.config, self.adam.gaussians
        if config.kl_merge is None:
            return 0
        gradient = self.state.mean()
        if config.indexing == "released":
            gradient = torch.zeros_like(gradient)
            n = min(len(before), len(gradient))
            gradient[:n] = before[:n]
        chosen = (gradient >= config.gradient) & ~self._large() & self._mask(self.rules.may_grow, True)
        if not chosen.any():
            return 0
        divergence, neighbour = divergence_to_nearest(gaussians)
        spared = self._mask(self.rules.spared)
        chosen &= (divergence < config.kl_merge) & ~spared & ~spared[neighbour]
        first = chosen.nonzero()[:, 0]
        if config.pairs == "disjoint":
            first = _disjoint(first, neighbour, divergence)
        if len(first):
            self._follow(merge(self.adam, first, neighbour[first], shrink=config.merge_shrink))
        return len(first)

    def _prune(self, step: int) -> tuple[int, int]:
        """Prune; how many, and how many of them were faint."""
        config, gaussians = self.config, self.adam.gaussians
        reasons: dict[str, Tensor] = {"where no Gaussian may be": self._mask(self.rules.unwanted)}
        faint = self._mask(None)
        if config.faint is not None:
            faint = reasons[f"of opacity below {config.faint:g}"] = gaussians.opacities < config.faint
        if config.largest is not None and step > config.size_after:
            reasons[f"larger than {config.largest:g} m"] = gaussians.scales.amax(1) > config.largest
        if config.widest is not None and step > config.size_after:
            reasons[f"wider than {config.widest:g} px"] = self.state.radius > config.widest
        wanted = torch.stack(list(reasons.values())).any(0)
        spared = self._mask(self.rules.spared)
        remove = wanted & ~spared
        if remove.all():
            why = ", ".join(f"{int(mask.sum())} {name}" for name, mask in reasons.items() if mask.any())
            raise Diverged(step, f"density control would prune all of {len(gaussians)} Gaussians: {why}")
        self.kept_back |= wanted & spared
        if count := int(remove.sum()):
            self._follow(prune(self.adam, ~remove))
        return count, int((remove & faint).sum())

    def _follow(self, rows: Rows) -> None:
        self.state.rearrange(rows)
        self.kept_back = rows.of(self.kept_back, fresh=0)

    def _require_finite(self, step: int) -> None:
        broken = int(self.adam.gaussians.broken().sum())
        if broken:
            raise Diverged(step, f"{broken} of {len(self.adam.gaussians)} Gaussians are not finite")

    def _large(self) -> Tensor:
        return self.adam.gaussians.scales.amax(1) > self.config.size

    def _mask(self, rule: Mask | None, without: bool = False) -> Tensor:
        """[N] bool what a rule says, or the same for all without one."""
        gaussians = self.adam.gaussians
        if rule is None:
            return torch.full((len(gaussians),), without, device=gaussians.means.device)
        return rule(gaussians).bool()

    def _generator(self, step: int, operation: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, step, operation))


def _disjoint(first: Tensor, neighbour: Tensor, divergence: Tensor) -> Tensor:
    """Of pairs (first, its neighbour) those that share no Gaussian, taken by rising divergence, ties by number."""
    order = first[divergence[first].sort(stable=True).indices]
    taken: set[int] = set()
    kept = []
    for one, other in zip(order.tolist(), neighbour[order].tolist(), strict=True):
        if one not in taken and other not in taken:
            taken |= {one, other}
            kept.append(one)
    return first.new_tensor(sorted(kept))
