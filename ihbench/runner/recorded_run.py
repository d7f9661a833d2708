"""A run on record: found when it is done, guarded while it goes on, and always with an outcome."""

from __future__ import annotations

import gc
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ihbench.clock import machine
from ihbench.clock.events import DivergedAt, Event, Resumed
from ihbench.clock.failures import one_line
from ihbench.clock.interruption import asked, interruptible, reason_of, undisturbed
from ihbench.clock.ledger import Ledger, OnCheckpoint
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput, Diverged
from ihbench.files import atomic, removal
from ihbench.record.results import TRACEBACK, RunResult, read_result
from ihbench.record.schema import About, RunIdentity, Status
from ihbench.record.store import RunFolder, note_interruption
from ihbench.scene.capture_digest import capture_digest
from ihbench.scene.contracts import Capture
from ihbench.scene.protocol import Protocol

if TYPE_CHECKING:
    from ihbench.body import Body


class RecordedRun(ABC):
    """One run in progress. `work` does it and sets the status "done"; how it ends otherwise is recorded here."""

    def __init__(
        self,
        folder: RunFolder,
        progress: Progress,
        device: str = "cpu",
        on_checkpoint: OnCheckpoint | None = None,
    ):
        self.folder, self.progress = folder, progress
        before = folder.record.ledger
        self.ledger = Ledger(
            folder.path, device=device, state=before, on_checkpoint=on_checkpoint, on_event=self._say_where
        )
        if before is not None:
            if not any(folder.checkpoints.glob("*.safetensors")):
                progress.say("beginning again: the earlier process saved nothing of this run")
            folder.restarted()
            removal.discard_file(folder.path / TRACEBACK)

    @abstractmethod
    def work(self) -> None:
        """Do the run. May raise anything."""

    def guarded(self) -> None:
        """Run, and record how it ended. Only bad input and interruption are passed on."""
        try:
            self.work()
        except BaseException as error:
            outcome = asked() or error  # a library may have made something else of an interruption
            match outcome:
                case Diverged():
                    self.ledger.event(DivergedAt(outcome.step, outcome.reason))
                    self._end("diverged", str(outcome), step=outcome.step)
                case BadInput():
                    self._end("failed", str(outcome))
                    raise
                case KeyboardInterrupt():
                    self._end("interrupted", reason_of(outcome))
                    raise outcome from (None if outcome is error else error)
                case Exception() | SystemExit():  # a method's own exit is a failure of the method
                    words = str(outcome).splitlines()[0] if str(outcome) else "no message"
                    reason = f"{type(outcome).__name__}: {words} (see {TRACEBACK})"
                    self._end("failed", reason, traceback.format_exc())
                case _:
                    raise

    def _end(self, status: Status, reason: str, details: str = "", step: int | None = None) -> None:
        with undisturbed():
            self.describe()
            try:
                if details:
                    atomic.write_text(self.folder.path / TRACEBACK, details)
                self.folder.set_status(status, reason, self.ledger, step)
            except (BadInput, OSError) as error:  # the disk that failed the run may fail its record too
                self.progress.say(f"the run's record could not be written: {error}")

    def _say_where(self, event: Event) -> None:
        """Where a run goes on that was cut short, or begins with what another one lent."""
        if event.kind == Resumed.kind:
            self.progress.say(f"continuing {event.data['stage']} at step {event.data['step']}")

    def describe(self, **more: Any) -> None:
        """Put the clocks, the peak memory, what the machine has turned out to be, and more into the record."""
        self.folder.note_machine(self.folder.record.machine.at_end())
        # an earlier process of this run, or the run that lent a stage, may have held more
        stages = [row["peak_mb"] for row in self.ledger.table()]
        clocks = {"fit_seconds": self.ledger.fit_seconds, "total_seconds": self.ledger.seconds}
        self.folder.describe(**{**clocks, "peak_mb": max([*stages, machine.peak_memory_mb()]), **more})


def recorded(
    runs: Path,
    identity: RunIdentity,
    about: About,
    force: bool,
    make: Callable[[RunFolder], RecordedRun],
) -> RunResult:
    """Find the finished run of this identity, or do it. See `RunFolder.create` for what `force` does.

    A finished one is found in places that may not be written, too.
    """
    with interruptible():
        try:
            folder = RunFolder.create(runs, identity, about, force)
            if not folder.finished:
                _begun(folder, make)
            return read_result(folder.path)
        except KeyboardInterrupt as stop:
            with undisturbed():  # it may have come before the run was guarded
                note_interruption(Path(runs) / identity.folder_name, reason_of(stop))
            raise


def _begun(folder: RunFolder, make: Callable[[RunFolder], RecordedRun]) -> None:
    with folder.lock():
        if folder.finished:  # a rival was quicker
            return
        gc.collect()  # what an earlier run in this process left in cycles is not this run's memory
        machine.reset_peak_memory()
        keep = False
        try:
            make(folder).guarded()
            keep = True
        except Exception as error:
            if folder.status == "running":  # it came before the run was guarded
                with suppress(BadInput, OSError):
                    folder.set_status("failed", one_line(str(error)) or type(error).__name__)
            raise
        finally:
            with undisturbed():
                folder.settle(keep)


def about_scene(capture: Capture, protocol: Protocol, device: str, command: Sequence[str]) -> About:
    """What the record of any run on a scene says of it. The protocol's whole content makes a run folder complete."""
    return About(
        standin=capture.standin,
        variant=capture.variant,
        body=capture.body,
        headline=protocol.metrics.headline,
        protocol=protocol.content,
        device=device,
        command=tuple(command),
    )


def identity_of(
    protocol: Protocol, capture: Capture, body: Body, method: str, config: Mapping[str, Any], seed: int, code: str
) -> RunIdentity:
    """Everything that affects the answer of a run on a scene."""
    return RunIdentity(
        protocol=protocol.name,
        protocol_digest=protocol.digest,
        dataset=capture.dataset,
        scene=capture.name,
        data=f"{capture.standin or capture.variant} {capture_digest(capture, protocol)}",
        method=method,
        config=config,
        profile=protocol.profile,
        seed=seed,
        body=body.content_sha(),
        code=code,
    )
