"""Fitting an avatar with AdamW, one view a step, stopped after any step and gone on with later.

The guard has three parts. Gradients are clipped. A step whose loss or gradient is not finite, or whose loss has
exploded, is rejected: the fit goes back to the last good state and on with smaller step sizes, a bounded number of
times, and the ledger has an event of each. What that cannot mend is a divergence, recorded with its first bad step.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from ihbench.clock.checkpoints import Tensors, Words
from ihbench.clock.events import Resumed, RolledBack
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.visible_person import require_visible_person
from ihbench.scene.contracts import TrainingSet

GOOD_EVERY = 25  # steps between two copies to go back to
SMALLER = 0.1  # share that is left of the step sizes after going back
MOST_ROLL_BACKS = 3  # of a stage
EXPLODED = 10.0  # times what any view cost at first, and what this one costs with the last good parameters


Module = TypeVar("Module", bound=nn.Module)


@dataclass(frozen=True)
class ParameterGroup:
    """Parameters that share AdamW's settings."""

    parameters: Sequence[nn.Parameter]
    lr: float
    weight_decay: float = 0.0
    eps: float = 1e-8


@dataclass(frozen=True)
class GoodState:
    """A state whose loss and gradients were finite; `step` are done."""

    step: int
    tensors: dict[str, Tensor]


class Optimisation(ABC, Generic[Module]):
    """One view a step. A stage gives its loss (`_loss`), may have a schedule of its own (`_rate_share`), and may act
    before each step (`_before_step`) and after a saved state has been restored (`_restored`).

    Parameters of the avatar in none of the `groups` are frozen meanwhile. Step sizes rise over the share `warm_up` of
    the steps and fall to the share `lr_final` as half a cosine; each group's gradient is clipped to the norm
    `clip_gradient`. `steps` are the stage's own. `first_step` is how many the avatar had before: steps offered to
    the ledger and named in a divergence grow over all stages.
    """

    name: str  # of the saved state
    title: str  # of the progress bar

    def __init__(
        self,
        avatar: Module,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        groups: Sequence[ParameterGroup],
        *,
        steps: int,
        views: int,
        lr_final: float,
        clip_gradient: float,
        first_step: int = 0,
        warm_up: float = 0.0,
    ):
        self.avatar, self.training, self.seed, self.ledger = avatar, training, seed, ledger
        self.steps, self.views, self.first_step, self.warm_up = steps, views, first_step, warm_up
        self.lr_final, self.clip_gradient = lr_final, clip_gradient
        optimised = {id(p) for group in groups for p in group.parameters}
        self._frozen = [p for p in avatar.parameters() if id(p) not in optimised]
        self.rates = [group.lr for group in groups]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": list(g.parameters), "lr": g.lr, "weight_decay": g.weight_decay, "eps": g.eps}
                for g in groups
            ],
            fused=True,
        )
        self.names = {id(p): name for name, p in avatar.named_parameters()}
        self.step = 0
        self.rolled_back = 0  # times
        self._good: GoodState | None = None
        self._first_bad: Diverged | None = None
        self._usual: float | None = None  # a loss of this size is nothing to wonder at

    @abstractmethod
    def _loss(self, k: int) -> Tensor:
        """The loss of view k. Must be differentiable in the avatar's parameters."""

    def _rate_share(self) -> float:
        """Of the groups' step sizes, what the step after `self.step` takes."""
        rise = min((self.step + 1) / max(self.warm_up * self.steps, 1), 1)
        decay = self.lr_final + (1 - self.lr_final) * 0.5 * (1 + math.cos(math.pi * self.step / self.steps))
        return decay * rise

    def _before_step(self) -> None:
        """Called before each step; `self.step` are done."""

    def _restored(self) -> None:
        """Called when a saved state has been restored; `self.step` are done."""

    def run(self, progress: Progress) -> None:
        """Optimise to the last step, resuming a saved state if the ledger has one.

        Raises `Diverged` with the first bad step where going back does not help: at the first step of all, for a view
        whose own values are bad, and after `MOST_ROLL_BACKS`. `BadInput` when no view shows the person.
        """
        require_visible_person(self.training)
        self._restore()
        started_at = self.step
        with progress.task(self.title, self.steps) as task, self._freezing():
            task.advance(self.step)
            while True:
                try:
                    if self.step == self.steps:
                        if self.step > started_at:
                            self._check_end()
                        break
                    self._one_step(self._view_of(self.step, self.views))
                except Diverged as bad:
                    reached = self.step
                    self._roll_back(bad)
                    task.advance(self.step - reached)
                    continue
                self.step += 1
                task.advance()
                self.ledger.offer(self.first_step + self.step, self.avatar)
                if self.ledger.due_to_save() and self.step < self.steps:
                    self.save()
        self.ledger.offer(self.first_step + self.step, self.avatar, force=True)
        self.save()

    @contextmanager
    def _freezing(self) -> Iterator[None]:
        """Without gradients of what is not optimised."""
        for p in self._frozen:
            p.requires_grad_(False)
        try:
            yield
        finally:
            for p in self._frozen:
                p.requires_grad_(True)

    def _view_of(self, step: int, n: int) -> int:
        """Every view once an epoch, in an order that depends on seed and epoch alone, so a resumed run repeats it."""
        epoch, k = divmod(step, n)
        return int(np.random.default_rng((self.seed, epoch)).permutation(n)[k])

    def _one_step(self, k: int) -> None:
        self._before_step()
        share = self._rate_share()
        for group, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            group["lr"] = rate * share * SMALLER**self.rolled_back
        self._zero_grad()
        loss = self._loss(k)
        self._check_loss(k, loss.item())
        loss.backward()
        self._check_gradients()
        if self.step % GOOD_EVERY == 0:
            tensors = {name: value.detach().clone() for name, value in self._tensors().items()}
            self._good = GoodState(self.step, tensors)
        self._update()

    def _zero_grad(self) -> None:
        self.optimizer.zero_grad(set_to_none=True)

    def _update(self) -> None:
        """Change the parameters by their gradients."""
        self.optimizer.step()

    # --- the guard ---

    def _check_loss(self, k: int, value: float) -> None:
        """Raise `Diverged` unless the loss of view k is finite and has not exploded.

        A view that shows little of the person may cost many times what others do, so a loss only counts as exploded
        when the same view costs far less with the last good parameters. Once no going back is left, any finite loss
        is taken: it may still come down.
        """
        step = self.first_step + self.step
        if not math.isfinite(value):
            raise Diverged(step, f"loss is {value}")
        if self._usual is None:
            self._usual = value
        if value <= EXPLODED * self._usual or self._good is None or self.rolled_back == MOST_ROLL_BACKS:
            return
        before = self._loss_before(k, self._good)
        if value > EXPLODED * before:
            good = self.first_step + self._good.step
            raise Diverged(step, f"loss is {value:.3g}, it was {before:.3g} with the parameters of step {good}")
        self._usual = max(self._usual, before)

    def _check_gradients(self) -> None:
        """Clip gradients. Raises `Diverged` for one that is not finite."""
        for group in self.optimizer.param_groups:
            norm = torch.nn.utils.clip_grad_norm_(group["params"], self.clip_gradient)
            if not math.isfinite(norm.item()):
                raise Diverged(self.first_step + self.step, f"gradient norm is {norm.item()}")

    @torch.no_grad()
    def _check_end(self) -> None:
        """Raise `Diverged` when the last step, after which no loss is taken, has spoiled the avatar."""
        if not all(p.isfinite().all() for p in self.avatar.parameters()):
            raise Diverged(self.first_step + self.step, "a parameter is not finite")
        k = self._view_of(self.step, self.views)
        self._check_loss(k, self._loss(k).item())

    @torch.no_grad()
    def _loss_before(self, k: int, good: GoodState) -> float:
        """The loss of view k with the last good parameters; nothing else is touched."""
        now = {name: p.data for name, p in self._parameters()}
        try:
            for name, p in self._parameters():
                p.data = good.tensors[f"avatar.{name}"]  # not copied into: the graph of a loss may wait for its turn
            return self._loss(k).item()
        finally:
            for name, p in self._parameters():
                p.data = now[name]

    def _roll_back(self, bad: Diverged) -> None:
        """Go back to the last good state, with smaller step sizes. Raises `Diverged` where that cannot help."""
        self._first_bad = self._first_bad or bad
        good = self._good
        if good is None or good.step == self.step:
            raise bad
        if self.rolled_back == MOST_ROLL_BACKS:
            why = f"{self._first_bad.reason}; {self.rolled_back} times back with smaller step sizes did not help"
            raise Diverged(self._first_bad.step, why) from bad
        if not math.isfinite(self._loss_before(self._view_of(self.step, self.views), good)):
            step = self.first_step + good.step
            raise Diverged(bad.step, f"{bad.reason}, with the parameters of step {step} as well") from bad
        self._put(good.tensors)
        self.step = good.step
        self._restored()
        self.rolled_back += 1
        step, share = self.first_step + good.step, SMALLER**self.rolled_back
        what = f"{bad.reason} at step {bad.step}; went back to step {step}, step sizes × {share:g} from there"
        self.ledger.event(RolledBack(self.name, step, what, bad.step))

    # --- resume ---

    def _parameters(self) -> list[tuple[str, nn.Parameter]]:
        """The avatar's parameters with their names, but for those that a subclass saves and restores by itself."""
        return list(self.avatar.named_parameters())

    def _buffers(self) -> list[tuple[str, Tensor]]:
        """The avatar's persistent buffers with their names."""
        parameters = {name for name, _ in self.avatar.named_parameters()}
        return [(name, value) for name, value in self.avatar.state_dict().items() if name not in parameters]

    def _tensors(self) -> dict[str, Tensor]:
        """Parameters, persistent buffers and optimiser moments by name; not copies."""
        tensors = {f"avatar.{name}": value.detach() for name, value in (*self._parameters(), *self._buffers())}
        for p, state in self.optimizer.state.items():
            for key, value in state.items():
                tensors[f"adam.{self.names[id(p)]}.{key}"] = value
        return tensors

    @torch.no_grad()
    def _put(self, tensors: Tensors) -> None:
        """Set parameters, persistent buffers and moments to copies of these."""
        self.optimizer.state.clear()
        for name, value in self._buffers():
            value.copy_(torch.as_tensor(tensors[f"avatar.{name}"]))
        for name, p in self._parameters():
            p.copy_(torch.as_tensor(tensors[f"avatar.{name}"]))
            state = {
                key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).to(p.device, copy=True)
                for key in ("step", "exp_avg", "exp_avg_sq")
                if f"adam.{name}.{key}" in tensors
            }
            if state:
                self.optimizer.state[p] = state

    def save(self) -> None:
        """Hand parameters, optimiser moments, the state to go back to and the step to the ledger."""
        tensors, first = self._tensors(), self._first_bad
        meta: Words = {"step": self.step, "rolled_back": self.rolled_back, "usual": self._usual}
        meta["first_bad"] = None if first is None else [first.step, first.reason]
        if self._good is not None and self.step < self.steps:
            meta["good"] = self._good.step
            tensors |= {f"good.{name}": value for name, value in self._good.tensors.items()}
        self.ledger.save_state(self.name, tensors, meta)

    def _restore(self) -> None:
        saved = self.ledger.load_state(self.name)
        if saved is None:
            return
        tensors, meta = saved
        self._put(tensors)
        self.step = int(meta["step"])
        self.rolled_back, self._usual = meta.get("rolled_back", 0), meta.get("usual")
        if meta.get("first_bad"):
            self._first_bad = Diverged(*meta["first_bad"])
        if "good" in meta:
            named = {name.removeprefix("good."): v for name, v in tensors.items() if name.startswith("good.")}
            device = next(self.avatar.parameters()).device
            self._good = GoodState(meta["good"], {n: torch.as_tensor(v).to(device) for n, v in named.items()})
        self._restored()
        self.ledger.event(Resumed(self.name, self.step))
