"""Snapshots of a fit for whoever watches it: avatars as they stand, saved beside the record while somebody looks.

Whoever watches renews `live/watched.json` in the run folder. The run looks now and then whether it was renewed; only
then does it save its avatar, in turn into `live/a` and `live/b`, and says in `live/snapshot.json` which one is whole.
So the last one can be read while the next one is written. Without a watcher that costs one look every few seconds;
the time that saving takes is booked as evaluation, not as fitting. No number of the run depends on it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput
from ihbench.files import atomic, removal

LIVE = "live"  # folder inside a run folder
SNAPSHOT, WATCHED = "snapshot.json", "watched.json"
PLACES = ("a", "b")
EVERY = 3.0  # s between two looks at whether somebody watches, and so between two snapshots
SHARE = 0.1  # of the time may go into snapshots


@dataclass(frozen=True)
class Snapshot:
    """An avatar that was saved during a fit."""

    folder: Path  # as the avatar's own `save` wrote it
    number: int  # counts up in one process of the run
    step: int
    seconds: float  # of fitting


class Snapshots:
    """The side of the run. `Ledger.offer` asks `due` at every step."""

    def __init__(self, run: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self._folder = run / LIVE
        self._clock = clock
        self._next = clock()
        self._seen = self._renewed()
        self._number = 0
        last = read_snapshot(run)  # of an earlier process of this run
        if last is not None:
            self._number = last.number

    def due(self) -> bool:
        """Whether somebody has asked for a snapshot since the last look."""
        if self._clock() < self._next:
            return False
        self._next = self._clock() + EVERY
        before, self._seen = self._seen, self._renewed()
        return self._seen is not None and self._seen != before

    def take(self, step: int, seconds: float, avatar: Any) -> None:
        """Save the avatar. What goes wrong is the watcher's loss, not the run's."""
        began = self._clock()
        number = self._number + 1
        place = PLACES[number % len(PLACES)]
        with suppress(BadInput, OSError, ValueError, RuntimeError):
            avatar.save(self._folder / place)
            words = {"place": place, "number": number, "step": step, "seconds": seconds}
            atomic.write_json(self._folder / SNAPSHOT, words)
            self._number = number
        took = self._clock() - began
        self._next = max(self._next, self._clock() + took / SHARE)

    def end(self) -> None:
        """Remove them: the avatar itself is there."""
        for place in PLACES:
            removal.remove_written(self._folder / place, is_snapshot)
        for name in (SNAPSHOT, WATCHED):
            removal.discard_file(self._folder / name)
        for folder in (*(self._folder / place for place in PLACES), self._folder):
            removal.discard_empty(folder)

    def _renewed(self) -> int | None:
        try:
            return os.stat(self._folder / WATCHED).st_mtime_ns
        except OSError:
            return None


def is_snapshot(path: Path) -> bool:
    """Whether a file of this name in a snapshot's folder may be the bench's own: avatars name their files."""
    from ihbench.record.store import WRITTEN

    return path.suffix in WRITTEN["avatar"] or atomic.is_stray(path.name)


def read_snapshot(run: Path) -> Snapshot | None:
    """The last one that is whole; None without any."""
    try:
        words = atomic.read_json(run / LIVE / SNAPSHOT)
        place, number, step, seconds = (words[name] for name in ("place", "number", "step", "seconds"))
        if place in PLACES:
            return Snapshot(run / LIVE / place, int(number), int(step), float(seconds))
    except (BadInput, OSError, ValueError, KeyError, TypeError):
        pass
    return None


def ask(run: Path) -> None:
    """Ask a run for snapshots, for the next few seconds. Raises `OSError` where its folder may not be written."""
    watched = run / LIVE / WATCHED
    watched.parent.mkdir(exist_ok=True)
    if watched.exists():
        os.utime(watched)
    else:
        atomic.write_json(watched, {"why": "somebody looks at this run with ihbench view --live"})
