"""Fitting an avatar of Gaussians whose number changes: `Optimisation` with density control.

Networks are optimised as everywhere, Gaussians by an Adam of their own whose moments follow them
(`gaussian_adam.py`). The guard goes back over changes of the set, too, and a resumed fit has the same Gaussians.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Generic, Protocol, TypeVar, cast

import torch
from torch import Tensor, nn

from ihbench.clock.checkpoints import Tensors
from ihbench.clock.ledger import Ledger
from ihbench.errors import Diverged
from ihbench.fit.gaussians.adam import GaussianAdam, Rate
from ihbench.fit.gaussians.density import DensityChanged, DensityControl, DensityRules
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.gaussian_set import SHAPES, Carried, Gaussians
from ihbench.fit.optimisation import SMALLER, GoodState, Optimisation, ParameterGroup
from ihbench.scene.contracts import TrainingSet

GAUSSIANS = "gaussians."  # the avatar's attribute, before the names of its parameters
EPS = 1e-15  # of Adam, for networks as well, as 3DGS and its descendants have it


class OfGaussians(Protocol):
    """An avatar made of them; a module."""

    gaussians: Gaussians


class Observation(Protocol):
    """What a renderer knows of each Gaussian after the backward pass."""

    @property
    def gradient(self) -> Tensor | None: ...  # [N, 2] ∂L/∂u, u the projected centre in px; None without one

    @property
    def radius(self) -> Tensor: ...  # [N] px, 0 where nothing of it can be on the image


Avatar = TypeVar("Avatar", bound=nn.Module)


class GaussianOptimisation(Optimisation[Avatar], Generic[Avatar]):
    """One view a step, as `Optimisation`; `avatar.gaussians` by the `rates` of their attributes, networks by groups.

    A stage gives its loss and calls `observe` in it with what the renderer has of each Gaussian's screen gradient. As
    in the released systems the set changes before Adam's step, and the Gaussians lose that step. Learning rates are
    not bent over the fit as `Optimisation` bends them, and nothing is clipped. Each change is an event of the ledger.
    """

    def __init__(
        self,
        avatar: Avatar,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        groups: Sequence[ParameterGroup],
        rates: Mapping[str, Rate],
        density: DensityConfig,
        rules: DensityRules | None = None,
        *,
        steps: int,
        views: int,
        first_step: int = 0,
    ):
        super().__init__(
            avatar, training, seed, ledger, groups,
            steps=steps, views=views, lr_final=1.0, clip_gradient=math.inf, first_step=first_step,
        )  # fmt: skip
        own = {id(p) for p in self._set.parameters()}
        self._frozen = [p for p in self._frozen if id(p) not in own]
        self.gaussian_rates = dict(rates)
        self.density = DensityControl(GaussianAdam(self._set, rates), density, seed, rules)
        self._observed: tuple[Observation, int, int] | None = None

    @property
    def _set(self) -> Gaussians:
        return cast("OfGaussians", self.avatar).gaussians

    def observe(self, observation: Observation, width: int, height: int) -> None:
        """What the renderer will know after the backward pass of this step's loss, and the size of its image in px
        (for a window: of the image it is cut from)."""
        self._observed = (observation, width, height)

    @abstractmethod
    def _rearranged(self, changed: DensityChanged) -> None:
        """Called after the set has changed: what the avatar keeps of each Gaussian beside them must follow."""

    # --- a step ---

    def _zero_grad(self) -> None:
        super()._zero_grad()
        self.density.adam.zero_grad()

    def _check_gradients(self) -> None:
        super()._check_gradients()
        for name, p in self._set.attributes.items():
            if p.grad is not None and not math.isfinite(p.grad.sum().item()) and not p.grad.isfinite().all():
                raise Diverged(self.first_step + self.step, f"gradient of the Gaussians' {name} is not finite")

    def _update(self) -> None:
        number = self.first_step + self.step + 1
        if self._observed is not None:
            observation, width, height = self._observed
            if observation.gradient is not None:
                self.density.observe(number, observation.gradient, observation.radius, width, height)
            self._observed = None
        changed = self.density.after_step(number)
        if changed is not None:
            self._rearranged(changed)
            self.ledger.event(changed)
        self._slow_down()
        self.density.adam.step(number)
        super()._update()

    def _slow_down(self) -> None:
        """After going back, steps are smaller for Gaussians, too."""
        share = SMALLER**self.rolled_back
        self.density.adam.rates = {
            name: replace(rate, first=rate.first * share, last=None if rate.last is None else rate.last * share)
            for name, rate in self.gaussian_rates.items()
        }

    # --- going back and resuming ---

    def _parameters(self) -> list[tuple[str, nn.Parameter]]:
        return [(name, p) for name, p in super()._parameters() if not name.startswith(GAUSSIANS)]

    def _buffers(self) -> list[tuple[str, Tensor]]:
        return [(name, value) for name, value in super()._buffers() if not name.startswith(GAUSSIANS)]

    def _tensors(self) -> dict[str, Tensor]:
        return super()._tensors() | self.density.tensors()

    def _put(self, tensors: Tensors) -> None:
        super()._put(tensors)
        self.density.put(tensors)

    @torch.no_grad()
    def _loss_before(self, k: int, good: GoodState) -> float:
        avatar, own = cast("OfGaussians", self.avatar), self._set
        avatar.gaussians = _set_of(good.tensors, own)
        try:
            return super()._loss_before(k, good)
        finally:
            avatar.gaussians = own


def _set_of(tensors: Mapping[str, Tensor], like: Gaussians) -> Gaussians:
    """A set with the attributes of another, from what `GaussianAdam.tensors` gave."""
    learned = {name: tensors[f"gaussians.{name}"] for name in like.attributes}
    carried = {name: Carried(tensors[f"carried.{name}"], of_new) for name, of_new in like.of_new.items()}
    means, log_scales, quaternions, opacity_logits = (learned.pop(name) for name in SHAPES)
    return Gaussians(means, log_scales, quaternions, opacity_logits, learned, carried)
