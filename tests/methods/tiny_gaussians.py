"""A GauHuman of few steps, and views to fit it to. For tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.gauhuman.avatar import GauHumanAvatar
from ihbench.methods.gauhuman.config import SMOKE
from ihbench.methods.gauhuman.fitting import GauHumanFit
from ihbench.scene.contracts import TrainingSet
from tests.bench.fake_capture import the_body

# twelve steps with changes after 6 and 9; the network of the weights takes most of a step's time
TINY = replace(
    SMOKE,
    steps=12,
    density=DensityConfig(after=4, before=11, every=3),
    white_reset=4,
    sh_every=8,
    weight_network=False,
)


def an_avatar(seed: int = 0, **changes: Any) -> GauHumanAvatar:
    return GauHumanAvatar(replace(TINY, **changes), the_body(), seed)


def fitted(training: TrainingSet, seed: int = 0, ledger: Ledger | None = None, **changes: Any) -> GauHumanAvatar:
    avatar = an_avatar(seed, **changes)
    GauHumanFit(avatar, training, seed, ledger or Ledger()).run(Progress.silent())
    return avatar


def events(ledger: Ledger, kind: str = "density") -> list[Any]:
    return [event.data for event in ledger.events if event.kind == kind]


class SavesAt(Ledger):
    """Asks for a saved state after one step only."""

    def __init__(self, step: int):
        super().__init__()
        self.step, self.seen = step, 0

    def offer(self, step: int, avatar: Any, progress: Progress | None = None, force: bool = False) -> bool:
        self.seen = step
        return False

    def due_to_save(self) -> bool:
        return self.seen == self.step


class Killed(Exception):
    pass


def killed_after(fit: GauHumanFit, steps: int) -> None:
    one_step = fit._one_step

    def counted(k: int) -> None:
        if fit.step == steps:
            raise Killed
        one_step(k)

    fit._one_step = counted
    with pytest.raises(Killed):
        fit.run(Progress.silent())
