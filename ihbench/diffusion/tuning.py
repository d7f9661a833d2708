"""Tuning parts of a backbone to one person: AdamW that a kill, a bad step or too little memory does not spoil."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from ihbench.clock.events import Resumed, RolledBack, Warned
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.memory import ADVICE, halved

GOOD_EVERY = 20  # steps between two copies to roll back to

Good = tuple[int, dict[str, Tensor]]  # steps taken, parameters by name
Loss = Callable[[np.random.Generator, int], Tensor | None]  # draws of one step, crops in it -> loss; None without any


@dataclass
class Curve:
    """Loss by step, for the record."""

    steps: list[int]
    losses: list[float]


class Tuning:
    """Optimises parts of a backbone in place. Resumes from the ledger's states; deterministic by seed."""

    def __init__(self, backbone: Backbone, seed: int, ledger: Ledger) -> None:
        self.backbone, self.seed, self.ledger = backbone, seed, ledger
        self.dtype = backbone.dtype
        self.curves: dict[str, Curve] = {}

    def _tune(
        self,
        state: str,  # name of the saved state
        what: str,  # for messages
        named: dict[str, nn.Parameter],
        rates: dict[str, float],  # AdamW's step size of each
        steps: int,
        batch: int,
        loss_of: Loss,
        progress: Progress,
        *,
        weight_decay: float = 0.0,
        falling: bool = True,  # step sizes fall to a tenth as half a cosine; else they stay
    ) -> None:
        """AdamW on `named`, gradients clipped to norm 1. A non-finite loss stops the stage at the last good state,
        and the record says so. Raises `BadInput` where a single crop does not fit into memory."""
        groups = [
            {
                "params": [named[n] for n in named if rates[n] == rate],
                "lr": rate,
                "base": rate,
                "weight_decay": weight_decay,
            }
            for rate in sorted(set(rates.values()))
        ]
        optimizer = torch.optim.AdamW(groups, fused=True)
        for p in named.values():
            p.data = p.data.float()  # steps of 1e-5 are lost in half precision
        curve = self.curves.setdefault(state, Curve([], []))
        step = self._restored(state, named, optimizer, curve)
        good: Good = (step, _copies(named))
        with progress.task(what, steps) as task:
            task.advance(step)
            while step < steps:
                share = 0.1 + 0.9 * 0.5 * (1 + math.cos(math.pi * step / steps)) if falling else 1.0
                for group in optimizer.param_groups:
                    group["lr"] = group["base"] * share
                optimizer.zero_grad(set_to_none=True)
                rng = np.random.default_rng((self.seed, *state.encode(), step))
                try:
                    loss = loss_of(rng, batch)
                    value = float("nan") if loss is None else loss.item()
                    if loss is not None and loss.requires_grad:
                        loss.backward()
                    norm = float(torch.nn.utils.clip_grad_norm_(list(named.values()), 1.0))
                    fine = loss is None or (math.isfinite(value) and math.isfinite(norm))
                    if loss is not None and fine:
                        if step % GOOD_EVERY == 0:
                            good = (step, _copies(named))  # a finite loss vouches for them
                        optimizer.step()
                except (MemoryError, RuntimeError) as error:
                    line = f"{what}: one crop does not fit into memory; {ADVICE[self.backbone.name]}"
                    batch = halved(batch, error, line)
                    self.ledger.event(Warned(f"{what}: out of memory at step {step}, batch now {batch}"))
                    continue
                if not fine:
                    why = f"{what}: loss {value}, gradient {norm} at step {step}"
                    self._roll_back(named, good, curve, why, state)
                    break
                if loss is not None:
                    curve.steps.append(step)
                    curve.losses.append(value)
                step += 1
                task.advance()
                due = self.ledger.due_to_save() and step < steps
                if (due or step == steps) and not _finite(named):  # no loss has seen this last step's outcome yet
                    self._roll_back(named, good, curve, f"{what}: parameters not finite after step {step - 1}", state)
                    break
                if due:
                    self._save(state, step, named, optimizer, curve)
        self._save(state, steps, named, None, curve)
        for p in named.values():
            p.data = p.data.to(self.dtype)

    def _roll_back(self, named: dict[str, nn.Parameter], good: Good, curve: Curve, why: str, state: str) -> None:
        step, values = good
        kept = sum(n < step for n in curve.steps)
        del curve.steps[kept:], curve.losses[kept:]
        with torch.no_grad():
            for name, p in named.items():
                p.copy_(values[name])
        self.ledger.event(RolledBack(state, step, f"{why}; went back to step {step} and stopped there"))

    # --- resume ---

    def _save(
        self,
        state: str,
        step: int,
        named: dict[str, nn.Parameter],
        optimizer: torch.optim.Optimizer | None,  # None: nothing is to follow
        curve: Curve,
    ) -> None:
        tensors: dict[str, Tensor] = {f"p.{name}": p.detach() for name, p in named.items()}
        if optimizer is not None:
            for name, p in named.items():
                tensors |= {f"adam.{name}.{key}": value for key, value in optimizer.state[p].items()}
        self.ledger.save_state(state, tensors, {"step": step, "steps": curve.steps, "losses": curve.losses})

    def _restored(
        self, state: str, named: dict[str, nn.Parameter], optimizer: torch.optim.Optimizer, curve: Curve
    ) -> int:
        saved = self.ledger.load_state(state)
        if saved is None:
            return 0
        tensors, meta = saved
        with torch.no_grad():
            for name, p in named.items():
                p.copy_(torch.as_tensor(tensors[f"p.{name}"]))
                if f"adam.{name}.step" in tensors:
                    keys = ("step", "exp_avg", "exp_avg_sq")
                    optimizer.state[p] = {
                        key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).to(p.device, copy=True) for key in keys
                    }
        curve.steps[:], curve.losses[:] = list(meta["steps"]), list(meta["losses"])
        self.ledger.event(Resumed(state, int(meta["step"])))
        return int(meta["step"])


def trainable(module: nn.Module, prefix: str) -> dict[str, nn.Parameter]:
    """The parameters of a module that are to be tuned, by name."""
    return {f"{prefix}.{name}": p for name, p in module.named_parameters() if p.requires_grad}


def _copies(named: dict[str, nn.Parameter]) -> dict[str, Tensor]:
    return {name: p.detach().clone() for name, p in named.items()}


def _finite(named: dict[str, nn.Parameter]) -> bool:
    return all(bool(torch.isfinite(p).all()) for p in named.values())
