"""Which run to look at, and what is new of it: for views that follow fits while they go on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ihbench.errors import BadInput
from ihbench.record.store import RunFolder, writer_of
from ihbench.runner.snapshots import ask, read_snapshot

KEPT = 2  # snapshots that are there at a time


@dataclass(frozen=True)
class Seen:
    """An avatar that is new."""

    run: Path
    folder: Path  # of the avatar
    number: int | None = None  # of the snapshot; None: the run's own, finished avatar
    step: int = 0
    seconds: float = 0.0  # of fitting

    @property
    def still_there(self) -> bool:
        """Whether the run has not begun to write over it: ask after reading."""
        if self.number is None:
            return True
        last = read_snapshot(self.run)
        return last is not None and last.number < self.number + KEPT

    @property
    def words(self) -> str:
        if self.number is None:
            return "finished"
        return f"step {self.step}, {self.seconds:.0f} s of fitting"


@dataclass
class Following:
    """Follows the run that was begun last among those that go on in some places: run folders, or folders of them.
    Where none goes on, the one that ended last is shown."""

    places: Sequence[Path]
    run: Path | None = None
    fault: str = ""  # why a run that goes on cannot be asked
    _number: int | None = None  # of the last snapshot seen
    _final: bool = False  # the finished avatar of `run` was seen
    _known: dict[Path, tuple[int, str, str, str]] = field(
        default_factory=dict
    )  # run.json's time, status, begun, ended

    def look(self) -> Seen | None:
        """What is new since the last look, if anything. A run that goes on is asked for its next snapshot."""
        runs = {folder: words for folder in self._folders() if (words := self._read(folder)) is not None}
        going = [folder for folder, (status, *_) in runs.items() if status == "running" and writer_of(folder)]
        if self.run in going:
            return self._snapshot(self.run)
        if self.run in runs and not self._final and runs[self.run][0] == "done":  # what was followed has ended
            return self._last(self.run)
        if going:
            self._follow(max(going, key=lambda folder: runs[folder][1]))
            assert self.run is not None
            return self._snapshot(self.run)
        done = [folder for folder, (status, *_) in runs.items() if status == "done" and (folder / "avatar").is_dir()]
        if self.run is None and done:
            self._follow(max(done, key=lambda folder: runs[folder][2]))
            assert self.run is not None
            return self._last(self.run)
        return None

    def _follow(self, run: Path) -> None:
        self.run, self._number, self._final, self.fault = run, None, False, ""

    def _snapshot(self, run: Path) -> Seen | None:
        try:
            ask(run)
            self.fault = ""
        except (BadInput, OSError) as error:
            self.fault = f"{run.name}: cannot be asked for snapshots: {error}"
        found = read_snapshot(run)
        if found is None or found.number == self._number or not found.folder.is_dir():
            return None
        self._number = found.number
        return Seen(run, found.folder, found.number, found.step, found.seconds)

    def _last(self, run: Path) -> Seen | None:
        self._final = True
        return Seen(run, run / "avatar") if (run / "avatar").is_dir() else None

    def _folders(self) -> Iterator[Path]:
        for place in self.places:
            if (place / "run.json").is_file():
                yield place
            elif place.is_dir():
                yield from sorted(file.parent for file in place.glob("*/run.json"))

    def _read(self, folder: Path) -> tuple[str, str, str] | None:
        """Status, when it was begun, when it was written last; read again where run.json has changed."""
        with suppress(BadInput, OSError):
            changed = (folder / "run.json").stat().st_mtime_ns
            if self._known.get(folder, (0,))[0] != changed:
                outcome = RunFolder.open(folder).record.outcome
                self._known[folder] = changed, outcome.status, str(outcome.created), str(outcome.updated)
            return self._known[folder][1:]
        return None
