"""What stages 1 and 3 share: AdamW on the avatar, step by step, stopped after any step and gone on with later."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor

from ihbench.errors import BadInput, Diverged
from ihbench.ledger import Ledger
from ihbench.methods.inpainthuman.avatar import GaussianAvatar
from ihbench.progress import Progress
from ihbench.scene import MaskState, TrainingSet


class Optimisation(ABC):
    """One view a step. A stage gives its loss (`_loss`), and may act before each step (`_before_step`) and after a
    saved state has been restored (`_restored`).

    `steps` are the stage's own. `first_step` is how many the avatar had before, so that steps offered to the ledger
    and named in a divergence grow over all stages. `lr_share` scales the configured step sizes, which rise over the
    share `warm_up` of the steps.
    """

    name: str  # of the saved state
    title: str  # of the progress bar

    def __init__(
        self,
        avatar: GaussianAvatar,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        *,
        steps: int,
        views: int,
        first_step: int = 0,
        lr_share: float = 1.0,
        warm_up: float = 0.0,
    ):
        self.avatar, self.training, self.seed, self.ledger = avatar, training, seed, ledger
        self.steps, self.views, self.first_step, self.warm_up = steps, views, first_step, warm_up
        config = avatar.config
        groups = [
            {"params": list(avatar.features.parameters()), "lr": config.lr_maps * lr_share, "weight_decay": 0.0},
            {"params": list(avatar.decoder.parameters()), "lr": config.lr_decoder * lr_share, "weight_decay": 0.01},
        ]
        if config.pose_residual:
            encoder = list(avatar.encoder.parameters())
            groups.append({"params": encoder, "lr": config.lr_encoder * lr_share, "weight_decay": 0.01})
        self.rates = [group["lr"] for group in groups]
        self.optimizer = torch.optim.AdamW(groups, fused=True)
        self.names = {id(p): name for name, p in avatar.named_parameters()}
        self.step = 0

    @abstractmethod
    def _loss(self, k: int) -> Tensor:
        """The loss of view k. Must be differentiable in the avatar's parameters."""

    def _before_step(self) -> None:  # noqa: B027
        """Called before each step; `self.step` are done."""

    def _restored(self) -> None:  # noqa: B027
        """Called when a saved state has been restored; `self.step` are done."""

    def run(self, progress: Progress) -> None:
        """Optimise to the last step, resuming a saved state if the ledger has one.

        Raises `Diverged` at the first non-finite loss or gradient, `BadInput` when no view shows the person.
        """
        self._require_visible_pixels()
        self._restore()
        with progress.task(self.title, self.steps) as task:
            task.advance(self.step)
            while self.step < self.steps:
                self._one_step(self._view_of(self.step, self.views))
                self.step += 1
                task.advance()
                self.ledger.offer(self.first_step + self.step, self.avatar)
                if self.ledger.due_to_save() and self.step < self.steps:
                    self.save()
        self.ledger.offer(self.first_step + self.step, self.avatar, force=True)
        self.save()

    def _require_visible_pixels(self) -> None:
        shows = any((view.mask == MaskState.PERSON).any() for view in self.training.views)
        if not shows:
            raise BadInput(
                f"scene {self.training.name}: no training view shows a visible person pixel; nothing to fit"
            )

    def _view_of(self, step: int, n: int) -> int:
        """Every view once an epoch, in an order that depends on seed and epoch alone, so a resumed run repeats it."""
        epoch, k = divmod(step, n)
        return int(np.random.default_rng((self.seed, epoch)).permutation(n)[k])

    def _one_step(self, k: int) -> None:
        config = self.avatar.config
        self._before_step()
        share = self.step / self.steps
        rise = min((self.step + 1) / max(self.warm_up * self.steps, 1), 1)
        decay = config.lr_final + (1 - config.lr_final) * 0.5 * (1 + math.cos(math.pi * share))
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * decay * rise
        self.optimizer.zero_grad(set_to_none=True)
        loss = self._loss(k)
        if not math.isfinite(loss.item()):
            raise Diverged(self.first_step + self.step, f"loss is {loss.item()}")
        loss.backward()
        for group in self.optimizer.param_groups:
            norm = torch.nn.utils.clip_grad_norm_(group["params"], config.clip_gradient)
            if not math.isfinite(norm.item()):
                raise Diverged(self.first_step + self.step, f"gradient norm is {norm.item()}")
        self.optimizer.step()

    def save(self) -> None:
        """Hand parameters, optimiser moments and the step to the ledger."""
        tensors = {f"avatar.{name}": p.detach() for name, p in self.avatar.named_parameters()}
        for p, state in self.optimizer.state.items():
            for key, value in state.items():
                tensors[f"adam.{self.names[id(p)]}.{key}"] = value
        self.ledger.save_state(self.name, tensors, {"step": self.step})

    def _restore(self) -> None:
        saved = self.ledger.load_state(self.name)
        if saved is None:
            return
        tensors, meta = saved
        with torch.no_grad():
            for name, p in self.avatar.named_parameters():
                p.copy_(torch.as_tensor(tensors[f"avatar.{name}"]))
                state = {
                    key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).to(p.device, copy=True)
                    for key in ("step", "exp_avg", "exp_avg_sq")
                    if f"adam.{name}.{key}" in tensors
                }
                if state:
                    self.optimizer.state[p] = state
        self.step = int(meta["step"])
        self._restored()
        self.ledger.event("resumed", stage=self.name, step=self.step)
