"""Many runs side by side, each in a process of its own: one that fails, or is killed, takes no other along. When the
process that started them ends, however it does, so do they."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from ihbench.clock.failures import one_line
from ihbench.clock.gpu_slots import only
from ihbench.clock.interruption import GRACE, end_with_parent, interruptible, reason_of
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.record.results import RunResult, read_result
from ihbench.runner.run_loop import RunRequest, run_scene
from ihbench.scene.data_source import DataSource

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Cell:
    """One run. `after` is the number of another cell that must have ended before, however it ended."""

    name: str
    request: RunRequest
    source: DataSource
    scene: str
    after: int | None = None


@dataclass(frozen=True)
class CellOutcome:
    """How a cell ended: with a result, which may say that the run diverged or failed, or with none and why."""

    cell: Cell
    result: RunResult | None
    problem: str = ""

    @property
    def done(self) -> bool:
        return self.result is not None and self.result.status == "done"


def run_cells(
    cells: Sequence[Cell], workers: int, threads: int, progress: Progress, cards: Sequence[int] | None = None
) -> list[CellOutcome]:
    """Run all cells, `workers` at a time with `threads` threads each; outcomes in the order of the cells.

    `cards` has the graphics card of each worker; a run sees no other. 0 workers run them one after the other in this
    process, with the card that torch takes. Interrupted, all processes end; the same call then finds
    what is finished and goes on with what is not. Raises `ValueError` for a cell that waits for a later one.
    """
    for number, cell in enumerate(cells):
        if cell.after is not None and not 0 <= cell.after < number:
            raise ValueError(f"cell {number}: may wait for an earlier cell only, not for {cell.after}")
    outcomes: dict[int, CellOutcome] = {}
    with progress.task("runs", len(cells)) as task:

        def ended(number: int, outcome: CellOutcome) -> None:
            outcomes[number] = outcome
            status = outcome.problem or (outcome.result.outcome if outcome.result is not None else "")
            progress.say(f"{outcome.cell.name}: {status}")
            task.advance()

        if workers == 0:
            for number, cell in enumerate(cells):
                try:
                    outcome = CellOutcome(cell, run_scene(cell.request, cell.source, cell.scene, Progress.silent()))
                except Exception as error:  # one cell takes no other along
                    outcome = CellOutcome(cell, None, _told(error))
                ended(number, outcome)
        else:
            _side_by_side(cells, workers, threads, ended, cards)
    return [outcomes[number] for number in range(len(cells))]


def _told(error: Exception) -> str:
    """An exception in one line."""
    return str(error) if isinstance(error, BadInput) else one_line(f"{type(error).__name__}: {error}")


def _side_by_side(
    cells: Sequence[Cell],
    workers: int,
    threads: int,
    ended: Callable[[int, CellOutcome], None],
    cards: Sequence[int] | None,
) -> None:
    context = get_context("spawn")  # torch's threads do not survive a fork
    waiting = list(range(len(cells)))
    finished: set[int] = set()
    running: dict[Connection, tuple[int, Any]] = {}
    free_cards, card_of = list(cards or ()), {}
    variables = {name: str(threads) for name in THREAD_VARIABLES}
    try:
        while waiting or running:
            ready = [n for n in waiting if (after := cells[n].after) is None or after in finished]
            for number in ready[: workers - len(running)]:
                waiting.remove(number)
                ours, theirs = context.Pipe(duplex=False)
                cell = cells[number]
                arguments = (theirs, cell.request, cell.source, cell.scene, threads)
                process = context.Process(target=_child, args=arguments, daemon=True)
                if cards is not None:
                    card_of[number] = free_cards.pop(0)
                with _variables(variables | (only(card_of[number], os.environ) if cards is not None else {})):
                    process.start()
                theirs.close()
                running[ours] = number, process
            for connection in wait(list(running)):
                assert isinstance(connection, Connection)
                number, process = running.pop(connection)
                finished.add(number)
                free_cards += [card_of.pop(number)] if cards is not None else []
                ended(number, _outcome(cells[number], connection, process))
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join(2 * GRACE)  # they record how they ended
            process.kill()
            process.join()


def _outcome(cell: Cell, connection: Connection, process: Any) -> CellOutcome:
    """What a process that has spoken, or died, leaves behind."""
    with connection:
        try:
            folder, problem = connection.recv()
        except EOFError:
            folder, problem = None, None
    process.join()
    if folder is not None:
        try:
            return CellOutcome(cell, read_result(Path(folder)))
        except BadInput as error:
            return CellOutcome(cell, None, str(error))
    if problem is None:
        code = process.exitcode
        problem = f"its process was killed by signal {-code}" if code < 0 else f"its process ended with status {code}"
    return CellOutcome(cell, None, problem)


def _child(connection: Connection, request: RunRequest, source: DataSource, scene: str, threads: int) -> None:
    end_with_parent()
    folder, problem = None, ""
    with interruptible():
        try:
            import cv2
            import torch

            torch.set_num_threads(threads)
            cv2.setNumThreads(threads)
            folder = str(run_scene(request, source, scene, Progress.silent()).folder)
        except KeyboardInterrupt as stop:
            problem = reason_of(stop)
        except Exception as error:
            problem = _told(error)
    with suppress(OSError), connection:  # the one who asked may be gone
        connection.send((folder, problem))


@contextmanager
def _variables(values: dict[str, str]) -> Iterator[None]:
    """Environment variables that a process started inside sees: libraries read them while they are imported."""
    before = {name: os.environ.get(name) for name in values}
    os.environ |= values
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
