"""The ledger of one run: seconds by stage, the quality-time curve, and what a method needs to go on after a kill.

Every interval of wall time is charged to exactly one chain of stages, the innermost open one and its parents, so
stages add up to the wall clock by construction. `paused` and `save_state` switch to a chain of their own: evaluation
and checkpoint writing inside a fit are booked beside the fit, not in it. The fit clock is the time charged to `fit`.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TypedDict

from ihbench.clock import interruption, machine
from ihbench.clock.checkpoints import States, Tensors, Words, state_file
from ihbench.clock.events import Event, Happening, Warned
from ihbench.config_fields import TextRule, Within
from ihbench.files.atomic import encode, write_bytes

if TYPE_CHECKING:
    from ihbench.clock.progress import Progress

FIT = "fit"
EVALUATE = "evaluate"
CHECKPOINT = "checkpoint"
REDONE = "redone"  # fit time that a kill threw away
SAVE_SHARE = 0.05  # of the time may go into saving states
STAGE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.+-]*(/[A-Za-z0-9][A-Za-z0-9 _.+-]*)*")
ARTIFACTS = {"inpainting.png": "painted training views"}  # files that methods leave beside the record -> their titles

Seconds = Annotated[float, Within(0)]
Megabytes = Annotated[float, Within(0, nan=True)]  # NaN where the system does not tell
_PART = r"[A-Za-z0-9][A-Za-z0-9 _.+-]{0,99}"
StagePath = Annotated[str, TextRule("a stage", re.compile(rf"{_PART}(/{_PART}){{0,9}}").fullmatch)]
OnCheckpoint = Callable[[int, float, Any], None]


class Watcher(Protocol):
    """Somebody who looks on while a fit goes on: see `runner.snapshots`."""

    def due(self) -> bool:
        """Asked at every step: whether to show the avatar now."""
        ...

    def take(self, step: int, seconds: float, avatar: Any) -> None: ...


@dataclass
class Stage:
    """What one stage has cost so far."""

    seconds: Seconds = 0.0  # wall
    cpu_seconds: float = 0.0  # all threads of the process
    peak_mb: Megabytes = 0.0  # the process's peak when the stage last ended
    peak_device_mb: Megabytes | None = 0.0
    entered: Annotated[int, Within(0, 2**63 - 1)] = 0


class StageRow(TypedDict):
    """A stage as the record's table has it."""

    stage: str  # path, or "other", or "total"
    depth: int
    share: float  # of the total
    seconds: float
    cpu_seconds: float
    peak_mb: float
    peak_device_mb: float | None
    entered: int


@dataclass(frozen=True)
class LedgerState:
    """The books of a run, as its record keeps them and `Ledger(state=...)` takes them."""

    stages: Mapping[StagePath, Stage]
    seconds: Seconds
    cpu_seconds: float
    events: tuple[Event, ...]


@dataclass(frozen=True)
class QualityTimes:
    """When the quality-time curve is sampled: at `first` seconds of the fit clock, then ever `factor` times later."""

    first: float = 2.0  # s
    factor: float = 2.0

    def __post_init__(self) -> None:
        if not self.first > 0 or not self.factor > 1:
            raise ValueError(f"quality times: expected first > 0 and factor > 1, got {self.first}, {self.factor}")

    def after(self, seconds: float) -> float:
        """The first sampling time later than `seconds`."""
        due = self.first
        while due <= seconds:
            due *= self.factor
        return due


class Ledger:
    """Times a run and keeps what is needed to resume it. Without a folder it works in memory. For one thread only.

    `state` is what `state()` gave in an earlier process of the same run; its seconds count on. `on_checkpoint(step,
    fit_seconds, avatar)` belongs to the run loop: it scores the avatar while the fit clock stands still.
    """

    def __init__(
        self,
        folder: Path | None = None,
        *,
        device: str = "cpu",
        state: LedgerState | None = None,
        on_checkpoint: OnCheckpoint | None = None,
        on_event: Callable[[Event], None] | None = None,  # of each, as it happens
        watcher: Watcher | None = None,
        quality_times: QualityTimes = QualityTimes(),
        save_every: float = 20.0,  # s, the least time between two saved states
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self._folder = None if folder is None else Path(folder)
        self._states = States(self._folder)
        self.device = device
        self.on_checkpoint, self.on_event, self.watcher = on_checkpoint, on_event, watcher
        self.quality_times = quality_times
        self.save_every = save_every
        self.events: list[Event] = []
        self._clock = clock
        self._stages: dict[str, Stage] = {}
        self._total = 0.0
        self._total_cpu = 0.0
        self._chain: tuple[str, ...] = ()  # open stages, outermost first
        self._loaded_clock: float | None = None  # the latest fit clock among the states loaded
        self._offered_step: int | None = None
        self._shown_step: int | None = None
        if state is not None:
            self._stages = {path: replace(stage) for path, stage in state.stages.items()}
            self._total, self._total_cpu = state.seconds, state.cpu_seconds
            self.events = list(state.events)
        self._earlier = len(self.events)  # of these: what happened before this process
        self._last, self._last_cpu = clock(), time.process_time()
        self._last_save, self._save_cost = self._last, 0.0
        self._due = quality_times.after(self.fit_seconds)

    # --- time ---

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Charge what happens inside to a stage. Nested names extend the path: `stage1` inside `fit` is `fit/stage1`.

        A name that already begins with the open path is taken as it is, and `fit/stage1` outside any stage opens
        `fit` as well, so a method may give full paths wherever it is called from. The device is synchronised at both
        ends. Raises `ValueError` for a name that is no path of plain words.
        """
        interruption.check()
        if not STAGE_NAME.fullmatch(name):
            raise ValueError(f"stage: expected words joined by /, got {name!r}")
        parent = self._chain[-1] if self._chain else ""
        path = name if not parent or name.startswith(parent + "/") else f"{parent}/{name}"
        cuts = [i for i, letter in enumerate(path + "/") if letter == "/" and i > len(parent)]
        with self._charging((*self._chain, *(path[:i] for i in cuts))):
            yield

    def book(self, name: str, seconds: float, cpu_seconds: float = 0.0) -> None:
        """Charge time that passed before there was a ledger to a stage of its own, and to the total. Raises
        `ValueError` for negative seconds and for a name that is no plain word."""
        if not STAGE_NAME.fullmatch(name) or "/" in name or not seconds >= 0:
            raise ValueError(f"stage: expected a word and seconds of 0 or more, got {name!r}, {seconds}")
        self._charge()
        stage = self._stages.setdefault(name, Stage())
        stage.seconds += seconds
        stage.cpu_seconds += cpu_seconds
        stage.peak_mb = machine.peak_memory_mb()
        stage.entered += 1
        self._total += seconds
        self._total_cpu += cpu_seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop the clocks of all open stages and charge what happens inside to `evaluate`."""
        with self._charging((EVALUATE,)):
            yield

    @property
    def fit_seconds(self) -> float:
        """The fit clock: seconds in `fit`, without evaluation and checkpoints, over all processes of the run."""
        self._charge()
        return self._stages[FIT].seconds if FIT in self._stages else 0.0

    @property
    def seconds(self) -> float:
        """All wall time of the run so far, over all its processes."""
        self._charge()
        return self._total

    @contextmanager
    def _charging(self, chain: tuple[str, ...]) -> Iterator[None]:
        """Charge to another chain of stages for a while."""
        machine.synchronize(self.device)
        self._charge()
        before, self._chain = self._chain, chain
        opened = [path for path in chain if path not in before]
        for path in opened:
            self._stages.setdefault(path, Stage()).entered += 1
        try:
            yield
        finally:
            try:
                machine.synchronize(self.device)
            finally:
                self._charge()
                self._chain = before
                for path in opened:
                    self._stages[path].peak_mb = machine.peak_memory_mb()
                    self._stages[path].peak_device_mb = machine.peak_device_memory_mb()

    def _charge(self) -> None:
        """Charge the time since the last charge to the open stages."""
        now, cpu = self._clock(), time.process_time()
        passed, cpu_passed = now - self._last, cpu - self._last_cpu
        self._last, self._last_cpu = now, cpu
        self._total += passed
        self._total_cpu += cpu_passed
        for path in self._chain:
            self._stages[path].seconds += passed
            self._stages[path].cpu_seconds += cpu_passed

    # --- quality against time ---

    def offer(self, step: int, avatar: Any, progress: Progress | None = None, force: bool = False) -> bool:
        """Offer the avatar as it stands at `step` to the quality-time curve; True when it was taken.

        Call it every step: while nothing is due it costs a microsecond. `avatar` is an avatar or, where making one
        costs something, a function that makes it. `force` is for the end of the fit. The fit clock stands still
        until the avatar is scored.
        """
        interruption.check()
        if self.watcher is not None and step != self._shown_step and self.watcher.due():
            self._show(step, avatar)
        if self.on_checkpoint is None or (step == self._offered_step if force else self.fit_seconds < self._due):
            return False
        machine.synchronize(self.device)
        seconds = self.fit_seconds
        with self.paused(), progress.task(f"scoring step {step}") if progress is not None else nullcontext():
            self.on_checkpoint(step, seconds, _made(avatar))
        self._offered_step = step
        self._due = self.quality_times.after(seconds)
        return True

    def _show(self, step: int, avatar: Any) -> None:
        assert self.watcher is not None
        seconds = self.fit_seconds
        with self.paused():
            self.watcher.take(step, seconds, _made(avatar))
        self._shown_step = step

    # --- resume ---

    def due_to_save(self) -> bool:
        """Whether the method should save its state now: `save_every` seconds after the last time, later when saving
        is slow, so that it never takes more than a twentieth of the time."""
        return self._clock() - self._last_save >= max(self.save_every, self._save_cost / SAVE_SHARE)

    def save_state(self, name: str, tensors: Mapping[str, Any], meta: Mapping[str, Any]) -> None:
        """Keep tensors (torch or numpy, any shape) and JSON-able `meta`, with the clock and the events so far, as
        checkpoint `name`, replaced whole.

        The time is booked under `checkpoint`. Raises `BadInput` when the disk is full, `ValueError` for a name that
        is no plain file name.
        """
        start = self._clock()
        with self._charging((CHECKPOINT,)):
            words = {"meta": dict(meta), "clock": self._clocks(), "events": self.events}
            self._states.save(name, tensors, words)
        self._last_save = self._clock()
        self._save_cost = self._last_save - start

    def load_state(self, name: str) -> tuple[Tensors, Words] | None:
        """Tensors (as they were: torch on the CPU, or numpy) and meta of checkpoint `name`, or None if there is none.

        The fit clock goes on from where it stood when the state was saved (the latest, when several are loaded): work
        that a kill threw away is booked under `redone`. Events that the kill took from the record come back, but not
        from a state that was reused from another run. A file that is truncated or damaged counts as absent, and an
        event says so.
        """
        state_file(Path(), name)  # a wrong name is an error, a damaged file is not
        with self._charging((CHECKPOINT,)):
            try:
                saved = self._states.load(name)
                if saved is None:
                    return None
                tensors, words = saved
                clocks, meta = _stages(words["clock"]), words["meta"]
                events = [Event.of(row) for row in words.get("events", ())]
            except Exception as error:  # whatever a damaged file makes of the reader: the stage starts again
                self.event(Warned(f"checkpoint {name} is damaged, starting that stage again: {error}"))
                return None
            self._recall(events)
        self._go_on_from(clocks)
        return tensors, meta

    def _recall(self, events: list[Event]) -> None:
        """Put events of an earlier process, as far as they are not known, before those of this one."""
        known = [encode(event) for event in self.events]  # encoded, NaN equals itself
        lost = [event for event in events if encode(event) not in known]
        self.events[self._earlier : self._earlier] = lost
        self._earlier += len(lost)

    def _clocks(self) -> dict[str, dict[str, float]]:
        self._charge()
        return {path: asdict(stage) for path, stage in self._stages.items()}

    def _go_on_from(self, clocks: dict[str, Stage]) -> None:
        """Set the stages of the fit to what they were when a state was saved; keep the books balanced."""
        saved = clocks[FIT].seconds if FIT in clocks else 0.0
        if self._loaded_clock is not None and saved <= self._loaded_clock:
            return
        self._loaded_clock = saved
        now = self._stages.get(FIT, Stage())
        then = clocks.get(FIT, Stage())
        lost, lost_cpu = self.fit_seconds - then.seconds, now.cpu_seconds - then.cpu_seconds
        fit = {path: stage for path, stage in clocks.items() if _root(path) == FIT}
        self._stages = {path: stage for path, stage in self._stages.items() if _root(path) != FIT} | fit
        for path in self._chain:
            self._stages.setdefault(path, Stage())
        if lost > 0:
            redone = self._stages.setdefault(REDONE, Stage())
            redone.seconds += lost
            redone.cpu_seconds += lost_cpu
            redone.entered += 1
        else:
            self._total -= lost
            self._total_cpu -= lost_cpu
        self._due = self.quality_times.after(saved)

    # --- the record ---

    def event(self, happening: Happening) -> None:
        """Note something that happened, with both clocks: see `ihbench.clock.events`."""
        self.events.append(Event.at(happening, self.fit_seconds, self.seconds))
        if self.on_event is not None:
            self.on_event(self.events[-1])

    def event_once(self, happening: Happening) -> None:
        """As `event`, unless the record has it: a resumed run comes by the same places again."""
        if not any(event.kind == happening.kind and event.data == vars(happening) for event in self.events):
            self.event(happening)

    @property
    def on_disk(self) -> bool:
        """Whether what is saved outlives the process."""
        return self._folder is not None

    def artifact(self, name: str, data: bytes) -> None:
        """Leave a file beside the run's record, such as a picture; nothing where the ledger works in memory. Raises
        `ValueError` for a name that is not among `ARTIFACTS`: whoever removes a run must know what belongs to it."""
        if name not in ARTIFACTS:
            raise ValueError(f"artifact: expected one of {', '.join(ARTIFACTS)}, got {name!r}")
        if self._folder is not None:
            write_bytes(self._folder / name, data)

    def state(self) -> LedgerState:
        """Everything but the checkpoints, for the run record and for `Ledger(state=...)`."""
        self._charge()
        stages = {path: replace(stage) for path, stage in self._stages.items()}
        return LedgerState(stages, self._total, self._total_cpu, tuple(self.events))

    def table(self) -> list[StageRow]:
        """One row a stage, parents before children, then `other` and `total`.

        The rows of depth 0 above `total` add up to it. `share` is of the total; `peak_mb` is the process's peak when
        the stage last ended.
        """
        self._charge()
        rows = [_row(path, self._stages[path], self._total) for path in in_order(self._stages)]
        top = [stage for path, stage in self._stages.items() if "/" not in path]
        other = Stage(
            self._total - sum(stage.seconds for stage in top),
            self._total_cpu - sum(stage.cpu_seconds for stage in top),
        )
        total = Stage(
            self._total, self._total_cpu, machine.peak_memory_mb(), machine.peak_device_memory_mb(), entered=1
        )
        return [*rows, _row("other", other, self._total), _row("total", total, self._total)]


def _row(path: str, stage: Stage, total: float) -> StageRow:
    share = stage.seconds / total if total > 0 else 0.0
    return StageRow(stage=path, depth=path.count("/"), share=share, **asdict(stage))


def in_order(paths: Mapping[str, Any]) -> Iterator[str]:
    """Paths in the order they were first opened, each followed by what it contains; one whose parent is not among
    them comes where it stands."""
    inside: dict[str, list[str]] = {}
    for path in paths:
        parent = path.rpartition("/")[0]
        inside.setdefault(parent if parent in paths else "", []).append(path)
    waiting = inside.get("", [])[::-1]
    while waiting:
        path = waiting.pop()
        yield path
        waiting += inside.get(path, [])[::-1]


def _stages(record: Mapping[str, Any]) -> dict[str, Stage]:
    """What an earlier version counted besides is dropped, what it did not count begins at 0."""
    known = [field.name for field in fields(Stage)]
    return {
        path: Stage(**{name: values[name] for name in known if name in values}) for path, values in record.items()
    }


def _root(path: str) -> str:
    return path.partition("/")[0]


def _made(avatar: Any) -> Any:
    """An avatar, of one or of what makes one."""
    return avatar if hasattr(avatar, "render") or not callable(avatar) else avatar()
