"""How far long work is: a bar with the time left on a terminal, a line now and then elsewhere, nothing when asked.

Everything goes to stderr: stdout belongs to results.
"""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from ihbench.clock.streams import say
from ihbench.errors import visible

PLAIN_EVERY = 10.0  # s between two plain lines of one task
MODES = ("auto", "bar", "plain", "silent")


class Progress:
    """Shows tasks, also nested ones.

    with progress.task("fitting", total=500) as task:
        for step in range(500):
            task.advance()
            task.note(f"loss {loss:.4f}")

    `mode` is "bar", "plain", "silent", or "auto": a bar if stderr is a terminal and CI is not set, else plain lines.
    """

    def __init__(
        self, mode: str = "auto", stream: TextIO | None = None, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        if mode not in MODES:
            raise ValueError(f"progress mode: expected one of {', '.join(MODES)}, got {mode!r}")
        self.stream = stream or sys.stderr or io.StringIO()  # stderr may be closed
        if mode == "auto":
            in_ci = os.environ.get("CI", "").lower() not in ("", "0", "false")
            mode = "bar" if self.stream.isatty() and not in_ci else "plain"
        self.mode = mode
        self.clock = clock
        self._bars: Any = None  # rich.progress.Progress while a task is open in bar mode
        self._open_tasks = 0

    @classmethod
    def silent(cls) -> Progress:
        return cls("silent")

    @contextmanager
    def task(self, description: str, total: int | None = None) -> Iterator[Task]:
        """A piece of work of `total` steps; without a total only the time spent is shown."""
        task = Task(self, description, total)
        self._open_tasks += 1
        try:
            if self.mode == "bar":
                if self._bars is None:
                    self._bars = _rich_bars(self.stream)
                    self._bars.start()
                task.bar = self._bars.add_task(task.description, total=total, note="")
            yield task
        finally:
            self._open_tasks -= 1
            self._close(task)

    def say(self, text: str) -> None:
        """One line of its own, above the bars."""
        text = visible(text, keep="\n")
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        elif self.mode != "silent" and not say(text, self.stream):
            self.mode = "silent"

    def _close(self, task: Task) -> None:
        if task.bar is not None:
            self._bars.remove_task(task.bar)
        if self._bars is not None and self._open_tasks == 0:
            self._bars.stop()
            self._bars = None
        if task.lines_said or (task.seconds >= 1.0 and self.mode != "silent"):
            self.say(f"{task.description}: {task.count()} in {duration(task.seconds)}")


class Task:
    """One running piece of work; made by `Progress.task`."""

    def __init__(self, progress: Progress, description: str, total: int | None) -> None:
        self.description = visible(description)
        self.total = total
        self.done = 0
        self.lines_said = 0
        self.bar: Any = None
        self._progress = progress
        self._note = ""
        self._start = self._last_line = progress.clock()

    @property
    def seconds(self) -> float:
        return self._progress.clock() - self._start

    def advance(self, steps: int = 1) -> None:
        """`steps` more are done. Cheap enough for every step of a fit."""
        self.done += steps
        if self.bar is not None:
            self._progress._bars.advance(self.bar, steps)
        elif self._progress.mode == "plain" and self._progress.clock() - self._last_line >= PLAIN_EVERY:
            self._last_line = self._progress.clock()
            self.lines_said += 1
            note = f", {self._note}" if self._note else ""
            self._progress.say(f"{self.description}: {self.count()}{self._time_left()}{note}")

    def note(self, text: str) -> None:
        """A word on the state of things, shown beside the count from now on."""
        self._note = visible(text)
        if self.bar is not None:
            self._progress._bars.update(self.bar, note=self._note)

    def count(self) -> str:
        return f"{self.done}" if self.total is None else f"{self.done}/{self.total}"

    def _time_left(self) -> str:
        if not self.total or not 0 < self.done < self.total:
            return ""
        return f", {duration(self.seconds * (self.total - self.done) / self.done)} left"


def duration(seconds: float) -> str:
    """12.3 s, 4 min 05 s, 2 h 07 min."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min"


def _rich_bars(stream: TextIO) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    return RichProgress(
        TextColumn("{task.description}", markup=False), BarColumn(bar_width=30), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", style="dim", markup=False),
        console=Console(file=stream),
        redirect_stdout=False,  # rich would send stdout to the bar's stream
        redirect_stderr=False,
        transient=True,
    )  # fmt: skip
