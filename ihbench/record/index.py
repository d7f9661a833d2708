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
from contextlib import closing, suppress
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput
from ihbench.files import removal
from ihbench.files.shape import as_json, from_json
from ihbench.record.results import Rows, RunResult, read_result, without_copies
from ihbench.record.schema import CurvePoint, RunRecord
from ihbench.record.store import INDEX, KILLED, OUR_NAME
from ihbench.version import __version__

UNREADABLE = "unreadable"
FILTERS = ("protocol", "scene", "method", "profile", "seed", "status")
FILES = ("run.json", "scores.jsonl", "calibration.jsonl", "curve.jsonl")  # and presets/
OURS = 0x69686265  # the database's application_id
FORMER = b"CREATE TABLE about (signature TEXT"  # in the first page of an index of version 0.1
WAIT = 10.0  # s for another process that writes the index
FRESH = 10**8  # ns; files that have changed within this time are read again: they may change within the same tick

SCHEMA = """
CREATE TABLE about (made_by TEXT NOT NULL);
CREATE TABLE runs (
    folder BLOB PRIMARY KEY,  -- its name
    signature TEXT NOT NULL,  -- of the files it was read from
    protocol TEXT, scene TEXT, method TEXT, profile TEXT, seed INTEGER,  -- NULL when unreadable
    status TEXT NOT NULL, reason TEXT NOT NULL, created TEXT,
    proof INTEGER NOT NULL,  -- CRC-32 of the above
    content BLOB  -- the run as JSON, compressed, NULL when unreadable
);
"""
COLUMNS = "folder, signature, protocol, scene, method, profile, seed, status, reason, created"


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

    @property
    def columns(self) -> tuple[Any, ...]:
        return tuple(vars(self).values())

    @property
    def proof(self) -> int:
        return zlib.crc32(repr(self.columns).encode("utf-8", "replace"))

    def matches(self, filters: Mapping[str, Any]) -> bool:
        for name, expected in filters.items():
            value = getattr(self, name)
            if value != expected and not (
                name == "protocol" and value is not None and value.partition("@")[0] == expected
            ):
                return False
        return True


class Index:
    """The runs in a folder of run folders."""

    def __init__(self, runs: Path) -> None:
        self.runs = Path(runs)
        self.file = self.runs / INDEX

    def query(self, **filters: Any) -> list[Entry]:
        """What the folders are, oldest first. A protocol matches with or without its @version.

        Raises `BadInput` when there is no folder of runs, `ValueError` for an unknown filter.
        """
        entries, _ = self._entries(filters)
        return [entry for entry in entries if entry.matches(filters)]

    def results(self, **filters: Any) -> tuple[list[RunResult], list[str]]:
        """The runs that match every filter, oldest first, and, one line each, the folders that are left out: damaged
        ones, whatever they were, and copies of a run that is there. Raises as `query` does."""
        entries, read = self._entries(filters)
        matching = [entry for entry in entries if entry.status != UNREADABLE and entry.matches(filters)]
        read |= self._stored_results([entry for entry in matching if entry.folder not in read])
        results, left_out = without_copies([read[entry.folder] for entry in matching])
        damaged = [f"{self.runs / entry.name}: {entry.reason}" for entry in entries if entry.status == UNREADABLE]
        return results, [*damaged, *left_out]

    # --- reading folders ---

    def _entries(self, filters: Mapping[str, Any]) -> tuple[list[Entry], dict[bytes, RunResult]]:
        """All folders, oldest first, and of those that were read now the results."""
        unknown = sorted(set(filters) - set(FILTERS))
        if unknown:
            raise ValueError(f"index: expected filters among {', '.join(FILTERS)}, got {', '.join(unknown)}")
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
        """What the database says that it can prove; nothing where there is none, or none of ours."""
        with suppress(OSError, sqlite3.Error, OverflowError), closing(self._open("ro")) as database:
            if not _is_current(database):
                return []
            rows = database.execute(f"SELECT {COLUMNS}, proof FROM runs").fetchall()
            proven = [(_entry(row[:-1]), row[-1]) for row in rows]
            return [entry for entry, proof in proven if entry is not None and entry.proof == proof]
        return []

    def _stored_results(self, entries: Iterable[Entry]) -> dict[bytes, RunResult]:
        """The runs of entries that the database holds; what it has lost meanwhile is read from the folders."""
        contents: dict[bytes, bytes] = {}
        entry_of = {entry.folder: entry for entry in entries}
        with suppress(OSError, sqlite3.Error), closing(self._open("ro")) as database:
            for name, entry in entry_of.items():
                row = database.execute(
                    "SELECT content FROM runs WHERE folder = ? AND signature = ?", (name, entry.signature)
                ).fetchone()
                if row is not None:
                    contents[name] = row[0]
        return {
            name: _unpacked(self.runs / entry.name, contents.get(name)) or read_result(self.runs / entry.name)
            for name, entry in entry_of.items()
        }

    def _store(self, fresh: Iterable[Entry], gone: Iterable[bytes], results: Mapping[bytes, RunResult]) -> None:
        """Bring the database up to date, as far as it may be written. What another process has put there meanwhile
        stays or is replaced: each line proves by its signature what it was read from."""
        rows = []
        for entry in fresh:
            content = results.get(entry.folder)
            rows.append((*entry.columns, entry.proof, None if content is None else _packed(content)))
        for attempt in range(2):
            try:
                with closing(self._open("rwc")) as database, database:
                    database.execute("BEGIN IMMEDIATE")
                    if not _is_current(database):
                        _make(database)
                    marks = ", ".join("?" * (len(COLUMNS.split(",")) + 2))
                    database.executemany(f"INSERT OR REPLACE INTO runs VALUES ({marks})", rows)
                    database.executemany("DELETE FROM runs WHERE folder = ?", [(name,) for name in gone])
                return
            except sqlite3.DatabaseError as error:
                if attempt or isinstance(error, sqlite3.OperationalError) or not self._is_broken():
                    return
                removal.discard_file(self.file)  # of ours, and damaged
            except (OSError, OverflowError):
                return

    def _open(self, mode: str) -> sqlite3.Connection:
        """The database in a file of our own; never one that a link or a pipe leads to. Raises `OSError`."""
        if os.path.lexists(self.file) and (self.file.is_symlink() or not self.file.is_file()):
            raise OSError(f"{self.file}: is no plain file")
        if mode == "ro" and not self.file.exists():
            raise FileNotFoundError(self.file)
        database = sqlite3.connect(
            f"{self.file.resolve().as_uri()}?mode={mode}", uri=True, timeout=WAIT, isolation_level=None
        )
        database.text_factory = lambda data: data.decode("utf-8", "replace")
        database.execute("PRAGMA synchronous = OFF")  # after a power cut what is lost or damaged is read again
        return database

    def _is_broken(self) -> bool:
        """Whether the file is a damaged index, and nothing of anybody else's."""
        try:
            with open(self.file, "rb") as file:
                head = file.read(4096)
        except OSError:
            return False
        own = head[:15] == b"SQLite format 3" and int.from_bytes(head[68:72], "big") == OURS
        return own or FORMER in head


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


def _entry(row: tuple[Any, ...]) -> Entry | None:
    """A line of the database, or None for one that nobody here has written."""
    folder, signed, *texts, seed, status, reason, created = row
    may_be_null = [*texts, created]
    if not isinstance(folder, bytes) or not all(isinstance(text, str) for text in (signed, status, reason)):
        return None
    if not all(text is None or isinstance(text, str) for text in may_be_null) or not isinstance(seed, int | None):
        return None
    return Entry(*row)


def _made_by(database: sqlite3.Connection) -> str | None:
    """What code wrote the database; "" for an empty one, None for one that is not ours."""
    if not database.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
        return ""
    if database.execute("PRAGMA application_id").fetchone()[0] == OURS:
        row = database.execute("SELECT made_by FROM about").fetchone()
        return "" if row is None else str(row[0])
    tables = {row[0] for row in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    columns = [row[1] for row in database.execute("PRAGMA table_info(about)")]
    return "0.1" if tables == {"about", "runs", "scores"} and columns == ["signature"] else None


def _is_current(database: sqlite3.Connection) -> bool:
    columns = [row[1] for row in database.execute("PRAGMA table_info(runs)")]
    return columns == [*COLUMNS.split(", "), "proof", "content"] and _made_by(database) == this_code()


def _make(database: sqlite3.Connection) -> None:
    """Begin anew inside a transaction. Raises `sqlite3.OperationalError` for a database that is not ours."""
    if _made_by(database) is None:
        raise sqlite3.OperationalError("not an index of this bench")
    for table in ("about", "runs", "scores"):
        database.execute(f"DROP TABLE IF EXISTS {table}")
    for statement in SCHEMA.split(";")[:-1]:
        database.execute(statement)
    database.execute("INSERT INTO about VALUES (?)", (this_code(),))
    database.execute(f"PRAGMA application_id = {OURS}")


@cache
def this_code() -> str:
    """Changes with the code that reads run folders: what other code has read is read again."""
    from ihbench.files import shape
    from ihbench.metrics import aggregate, identity
    from ihbench.record import migrations, results, store
    from ihbench.record import schema as record

    digest = hashlib.sha256(f"{__version__}\n{SCHEMA}".encode())
    for module in (record, results, shape, store, migrations, aggregate, identity):
        with suppress(OSError, TypeError):
            digest.update(Path(module.__file__).read_bytes())  # type: ignore[arg-type]
    with suppress(OSError):
        digest.update(Path(__file__).read_bytes())
    return digest.hexdigest()


def _packed(result: RunResult) -> bytes:
    return zlib.compress(
        json.dumps(as_json(_Content(**{f.name: getattr(result, f.name) for f in fields(_Content)}))).encode(), 1
    )


def _unpacked(folder: Path, content: Any) -> RunResult | None:
    """The inverse of `_packed`; None for what it cannot have made."""
    try:
        return RunResult(folder, **vars(from_json(json.loads(zlib.decompress(content)), _Content)))
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _printable(value: str) -> str:
    """Text that any database and terminal takes: undecodable names and lone surrogates replaced."""
    return value[:2000].encode("utf-8", "replace").decode()
