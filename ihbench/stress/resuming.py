"""A fit that is killed between two saved states and gone on with, for methods' own stress cases."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from torch import nn

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.optimisation import Optimisation

Module = TypeVar("Module", bound=nn.Module)
SAVED, KILLED = 11, 14  # steps done


class _Killed(Exception):
    pass


def changed_by_a_kill(
    fresh: Callable[[], Module], stage_of: Callable[[Module, Ledger], Optimisation[Module]], whole: Module
) -> int:
    """Values in which a killed and resumed fit of a fresh avatar differs from the uninterrupted one, `whole`."""

    class SavesOnce(Ledger):
        def due_to_save(self) -> bool:
            return stage.step == SAVED

    ledger = SavesOnce()
    stage = stage_of(fresh(), ledger)
    one_step = stage._one_step

    def until_killed(k: int) -> None:
        if stage.step == KILLED:
            raise _Killed
        one_step(k)

    stage._one_step = until_killed
    with suppress(_Killed):
        stage.run(Progress.silent())
    again = fresh()
    stage_of(again, ledger).run(Progress.silent())
    pairs = zip(whole.state_dict().values(), again.state_dict().values(), strict=True)
    return sum(int((a != b).sum()) for a, b in pairs)
