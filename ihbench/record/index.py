"""What a folder of runs holds, read fast: `runs.sqlite` keeps what was read of each run folder until it changes.

The folders are the truth. What the index lacks, or holds of a folder whose files have changed since, is read again;
where it may not be written, everything is, with the same answer.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from ihbench.config_fields import as_json, read
from ihbench.errors import BadInput
from ihbench.files import removal
from ihbench.record.results import Rows, RunResult, read_result, without_copies
from ihbench.record.schema import CurvePoint, RunRecord
from ihbench.record.store import INDEX, KILLED, OUR_NAME
from ihbench.version import __version__

UNREADABLE = "unreadable"
FILES = ("run.json", "scores.jsonl", "calibration.jsonl", "curve.jsonl")  # and presets/
OURS = 0x69686265  # the database's application_id
WAIT = 10.0  # s for another process that writes the index
FRESH = 10**8  # ns; files that have changed within this time are read again: they may change within the same tick


@dataclass(frozen=True)
class Entry:
    """One run folder as the index knows it."""

    folder: bytes
    signature: str
    protocol: str | None
    scene: str | None
    method: str | None
    profile: str | None
    seed: int | None
    status: str
    reason: str
    created: str | None

    @property
    def name(self) -> str:
        return os.fsdecode(self.folder)

    def matches(self, filters: Mapping[str, Any]) -> bool:
        for name, expected in filters.items():
            value = getattr(self, name)
            if value != expected and not (
                name == "protocol" and value is not None and value.partition("@")[0] == expected
            ):
                return False
        return True


COLUMNS = [field.name for field in fields(Entry)]  # of the database, and last the run as JSON, compressed


class Index:
    """The runs in a folder of run folders."""

    def __init__(self, runs: Path) -> None:
        self.runs = Path(runs)
        self.file = self.runs / INDEX

    def query(self, **filters: Any) -> list[Entry]:
        """What the folders are, oldest first. A protocol matches with or without its @version.

        Raises `BadInput` when there is no folder of runs.
        """
        entries, _ = self._entries()
        return [entry for entry in entries if entry.matches(filters)]

    def results(self, **filters: Any) -> tuple[list[RunResult], list[str]]:
        """The runs that match every filter, oldest first, and, one line each, the folders that are left out: damaged
        ones, whatever they were, and copies of a run that is there. Raises as `query` does."""
        entries, fresh = self._entries()
        matching = [entry for entry in entries if entry.status != UNREADABLE and entry.matches(filters)]
        fresh |= self._stored_results([entry for entry in matching if entry.folder not in fresh])
        results, left_out = without_copies([fresh[entry.folder] for entry in matching])
        damaged = [f"{self.runs / entry.name}: {entry.reason}" for entry in entries if entry.status == UNREADABLE]
        return results, [*damaged, *left_out]

    # --- reading folders ---

    def _entries(self) -> tuple[list[Entry], dict[bytes, RunResult]]:
        """All folders, oldest first, and of those that were read now the results."""
        signatures = {os.fsencode(folder.name): signature(folder) for folder in self._folders()}
        stored = {entry.folder: entry for entry in self._stored()}
        entries, results = {}, {}
        for name, signed in signatures.items():
            if name in stored and stored[name].signature == signed:
                entries[name] = stored[name]
            else:
                entries[name], result = read_entry(self.runs / os.fsdecode(name), signed)
                if result is not None:
                    results[name] = result
        fresh = [entry for name, entry in entries.items() if entry is not stored.get(name)]
        gone = [name for name in stored if name not in signatures]
        if fresh or gone or not os.path.lexists(self.file):
            self._store(fresh, gone, results)
        return sorted(entries.values(), key=lambda entry: (entry.created or "", entry.folder)), results

    def _folders(self) -> Iterator[Path]:
        """Folders that hold, or should hold, a run. Links are not followed."""
        try:
            with os.scandir(self.runs) as entries:
                folders = [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
        except OSError as error:
            raise BadInput(f"{self.runs}: no folder of runs ({error.strerror}); give the --runs of a run") from error
        return filter(_holds_a_run, folders)

    # --- the database ---

    def _stored(self) -> list[Entry]:
        with suppress(OSError, sqlite3.Error), self._database() as database:
            return [Entry(*row) for row in database.execute(f"SELECT {', '.join(COLUMNS)} FROM runs")]
        return []

    def _stored_results(self, entries: Iterable[Entry]) -> dict[bytes, RunResult]:
        """The runs of entries that the database holds; what it has lost meanwhile is read from the folders."""
        kept: dict[bytes, RunResult] = {}
        select = "SELECT content FROM runs WHERE folder = ? AND signature = ?"
        with suppress(OSError, sqlite3.Error, zlib.error, TypeError, BadInput), self._database() as database:
            for entry in entries:
                (packed,) = database.execute(select, (entry.folder, entry.signature)).fetchone()
                content = read(_Content, json.loads(zlib.decompress(packed)), "", strict=False)
                kept[entry.folder] = RunResult(self.runs / entry.name, **vars(content))
        return {e.folder: kept.get(e.folder) or read_result(self.runs / e.name) for e in entries}

    def _store(self, fresh: Iterable[Entry], gone: Iterable[bytes], results: Mapping[bytes, RunResult]) -> None:
        """Bring the database up to date, as far as it may be written, or begin anew where it is damaged. What another
        process has put there meanwhile stays or is replaced: each line has the signature of what it was read from."""
        rows = []
        for entry in fresh:
            content = results.get(entry.folder)
            rows.append((*vars(entry).values(), None if content is None else _packed(content)))
        for _ in range(2):
            try:
                with self._database(write=True) as database:
                    marks = ", ".join("?" * (len(COLUMNS) + 1))
                    database.executemany(f"INSERT OR REPLACE INTO runs VALUES ({marks})", rows)
                    database.executemany("DELETE FROM runs WHERE folder = ?", [(name,) for name in gone])
                return
            except (OSError, sqlite3.OperationalError):
                return
            except sqlite3.DatabaseError:
                removal.discard_file(self.file)

    @contextmanager
    def _database(self, write: bool = False) -> Iterator[sqlite3.Connection]:
        """The database, emptied for writing where other code has filled it. Raises `OSError` for a file that is not
        ours, a link or a pipe, and where there is nothing to read."""
        if write and not os.path.lexists(self.file):
            head = b""
        elif self.file.is_symlink() or not self.file.is_file():
            raise OSError(f"{self.file}: is no plain file")
        else:
            with self.file.open("rb") as file:
                head = file.read(72)
        if head and head[68:] != OURS.to_bytes(4, "big"):
            raise OSError(f"{self.file}: is not an index of this bench")
        with closing(sqlite3.connect(self.file, timeout=WAIT, isolation_level=None)) as database, database:
            database.execute("PRAGMA synchronous = OFF")  # after a power cut what is lost or damaged is read again
            if write:
                database.execute("BEGIN IMMEDIATE")
            if database.execute("PRAGMA user_version").fetchone()[0] != this_code():
                if not write:
                    raise OSError(f"{self.file}: of other code")
                database.execute("DROP TABLE IF EXISTS runs")
                database.execute(f"CREATE TABLE runs ({', '.join(COLUMNS)}, content, PRIMARY KEY (folder))")
                database.execute(f"PRAGMA application_id = {OURS}")
                database.execute(f"PRAGMA user_version = {this_code()}")
            yield database


@dataclass(frozen=True)
class _Content:
    """What the database keeps of a `RunResult`."""

    record: RunRecord
    rows: Rows
    presets: Mapping[str, Rows]
    curve: tuple[CurvePoint, ...]
    damage: tuple[str, ...]


def _holds_a_run(folder: Path) -> bool:
    """Whether there is a record, or numbers of a run that has lost its record."""
    if os.path.lexists(folder / "run.json"):
        return True
    return bool(OUR_NAME.search(folder.name)) and any(os.path.lexists(folder / name) for name in FILES)


def signature(folder: Path) -> str:
    """Changes whenever a file that a run is read from does."""
    parts = []
    newest = 0
    names: list[str | Path] = [folder / name for name in FILES]
    with suppress(OSError):
        names += sorted(entry.path for entry in os.scandir(folder / "presets"))
    for name in names:
        try:
            about = os.lstat(name)
        except OSError:
            parts.append("-")
            continue
        newest = max(newest, about.st_ctime_ns)
        parts.append(f"{about.st_mode} {about.st_mtime_ns} {about.st_ctime_ns} {about.st_size} {about.st_ino}")
    seen = "\n".join([*map(str, names[len(FILES) :]), *parts])
    if abs(time.time_ns() - newest) < FRESH:
        seen += f"\nread {time.time_ns()}"
    return hashlib.sha256(seen.encode("utf-8", "replace")).hexdigest()


def read_entry(folder: Path, signed: str) -> tuple[Entry, RunResult | None]:
    """A folder as an entry and, unless it is damaged, as a run."""
    name = os.fsencode(folder.name)
    try:
        result = read_result(folder)
    except BadInput as error:
        reason = str(error).removeprefix(f"{folder}/").removeprefix(f"{folder}: ")
        return Entry(name, signed, None, None, None, None, None, UNREADABLE, _printable(reason), None), None
    identity = result.identity
    if result.status == "running" or result.reason == KILLED:
        signed += " at that moment"  # no file changes when a process dies: to be read again
    named = (_printable(t) for t in (identity.protocol, identity.scene, identity.method, identity.profile))
    protocol, scene, method, profile = named
    reason, created = _printable(result.reason), result.record.outcome.created
    entry = Entry(name, signed, protocol, scene, method, profile, identity.seed, result.status, reason, created)
    return entry, result


@cache
def this_code() -> int:
    """Changes with the code that reads run folders: what other code has read is read again."""
    bench = Path(__file__).parents[1]
    files = [
        file for name in ("*.py", "files/*.py", "metrics/*.py", "record/*.py") for file in sorted(bench.glob(name))
    ]
    code = __version__.encode() + b"".join(file.read_bytes() for file in files)
    return int(hashlib.sha256(__version__.encode() + code).hexdigest()[:7], 16)


def _packed(result: RunResult) -> bytes:
    return zlib.compress(
        json.dumps(as_json(_Content(**{f.name: getattr(result, f.name) for f in fields(_Content)}))).encode(), 1
    )


def _printable(value: str) -> str:
    """Text that any database and terminal takes: undecodable names and lone surrogates replaced."""
    return value[:2000].encode("utf-8", "replace").decode()
