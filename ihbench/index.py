"""A SQLite index over run folders, for queries. The folders are the truth; it is made again when they change."""

from __future__ import annotations

import hashlib
import os
import secrets
import sqlite3
import stat
from contextlib import closing
from pathlib import Path
from typing import Any

from ihbench import locks, removal
from ihbench.errors import BadInput
from ihbench.results import mean_rows
from ihbench.store import KILLED, LOCK, RunFolder

UNREADABLE = "unreadable"
LARGEST_FILE = 256 * 2**20  # bytes; no honest record comes near

SCHEMA = """
CREATE TABLE about (signature TEXT NOT NULL);
CREATE TABLE runs (
    id TEXT PRIMARY KEY,  -- the folder's name
    protocol TEXT, scene TEXT, method TEXT, profile TEXT, seed INTEGER,
    status TEXT NOT NULL, reason TEXT NOT NULL, created TEXT, path TEXT NOT NULL
);
CREATE TABLE scores (
    run TEXT NOT NULL REFERENCES runs (id),
    row TEXT NOT NULL,  -- the predictor: the method itself
    identity TEXT NOT NULL,
    value REAL,  -- mean over the test views; NULL when absent
    n INTEGER NOT NULL,  -- views the mean runs over
    reason TEXT NOT NULL,
    PRIMARY KEY (run, row, identity)
);
"""

FILTERS = ("protocol", "scene", "method", "profile", "seed", "status")


class Index:
    """`runs.sqlite` in a folder of runs."""

    def __init__(self, runs: Path) -> None:
        self.runs = Path(runs)
        self.file = self.runs / "runs.sqlite"

    def query(self, **filters: Any) -> list[dict[str, Any]]:
        """Runs that match every filter, oldest first. A protocol matches with or without its @version.

        Filters: protocol, scene, method, profile, seed, status ("unreadable" for damaged folders). Raises `BadInput`
        when there is no folder of runs, `ValueError` for an unknown filter.
        """
        where, values = _conditions({name: value for name, value in filters.items() if name != "status"})
        rows = self._select(f"SELECT * FROM runs {where} ORDER BY created, id", values)
        for row in rows:
            if row["status"] == "running" and not locks.is_held(self.runs / row["path"] / LOCK):
                row |= {"status": "interrupted", "reason": KILLED}  # no file changes when a process dies
        return [row for row in rows if filters.get("status", row["status"]) == row["status"]]

    def scores(self, **filters: Any) -> list[dict[str, Any]]:
        """Mean scores of the runs that match, one row for each run, predictor and identity string."""
        where, values = _conditions(filters)
        return self._select(
            f"SELECT scores.*, protocol, scene, method, profile, seed FROM scores JOIN runs ON runs.id = scores.run "
            f"{where} ORDER BY created, id, row, identity",
            values,
        )

    def rebuild(self) -> int:
        """Read every run folder again; how many there are. A damaged one is listed as unreadable with the reason."""
        folders = self._folders()
        temporary = self.runs / f".runs.sqlite.{secrets.token_hex(4)}.tmp"
        try:
            with closing(sqlite3.connect(temporary)) as database, database:
                database.executescript(SCHEMA)
                database.execute("INSERT INTO about VALUES (?)", (self._signature(folders),))
                for folder in folders:
                    run, scores = _read(folder)
                    database.execute("INSERT INTO runs VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", run)
                    database.executemany("INSERT INTO scores VALUES (?, ?, ?, ?, ?, ?)", scores)
            os.replace(temporary, self.file)
        except (OSError, sqlite3.OperationalError) as error:
            raise BadInput(f"{self.file}: cannot be written ({error}); make room or check permissions") from error
        finally:
            removal.discard_file(temporary)
        return len(folders)

    def _select(self, statement: str, values: dict[str, Any]) -> list[dict[str, Any]]:
        if not self._is_current():
            self.rebuild()
        with closing(sqlite3.connect(self.file)) as database:
            database.row_factory = sqlite3.Row
            return [dict(row) for row in database.execute(statement, values)]

    def _is_current(self) -> bool:
        if not self.file.is_file():
            return False
        try:
            with closing(sqlite3.connect(self.file)) as database:
                (stored,) = database.execute("SELECT signature FROM about").fetchone()
        except (sqlite3.DatabaseError, TypeError):
            return False
        return stored == self._signature(self._folders())

    def _folders(self) -> list[Path]:
        """Folders that hold, or should hold, a run. Links are not followed."""
        try:
            entries = sorted(os.scandir(self.runs), key=lambda entry: entry.name)
        except OSError as error:
            raise BadInput(f"{self.runs}: no folder of runs ({error.strerror}); give the --runs of a run") from error
        folders = [Path(entry.path) for entry in entries if entry.is_dir(follow_symlinks=False)]
        return [folder for folder in folders if os.path.lexists(folder / "run.json")]

    def _signature(self, folders: list[Path]) -> str:
        """Changes whenever a file the index was made from does."""
        seen = hashlib.sha256(SCHEMA.encode())
        for folder in folders:
            for name in ("run.json", "scores.jsonl"):
                try:
                    about = os.lstat(folder / name)
                except OSError:
                    continue
                seen.update(os.fsencode(folder / name))
                seen.update(f"{about.st_mtime_ns} {about.st_size} {about.st_ino}\n".encode())
        return seen.hexdigest()


def _conditions(filters: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    unknown = sorted(set(filters) - set(FILTERS))
    if unknown:
        raise ValueError(f"index: expected filters among {', '.join(FILTERS)}, got {', '.join(unknown)}")
    parts = [
        f"({name} = :{name} OR substr({name}, 1, length(:{name}) + 1) = :{name} || '@')"
        if name == "protocol"
        else f"{name} = :{name}"
        for name in filters
    ]
    return ("WHERE " + " AND ".join(parts) if parts else ""), filters


def _read(folder: Path) -> tuple[tuple[Any, ...], list[tuple[Any, ...]]]:
    """One row for `runs` and the rows for `scores`, whatever the folder holds."""
    name = _text(folder.name)
    try:
        for file in ("run.json", "scores.jsonl"):
            _check_plain_file(folder / file)
        run = RunFolder.open(folder)
        parts = [run.identity[key] for key in ("protocol", "scene", "method", "profile")]
        seed = run.identity["seed"]
        if not all(isinstance(part, str) for part in parts) or not isinstance(seed, int) or abs(seed) >= 2**63:
            raise BadInput("identity holds values of a wrong type")
        scores = [
            (name, _text(row), _text(identity), None if mean.absent else mean.value, mean.n, _text(mean.reason))
            for row, means in mean_rows(run.scores()).items()
            for identity, mean in means.items()
        ]
        about = run.status, _text(run.reason), _text(run.record["created"])
        return (name, *map(_text, parts), seed, *about, name), scores
    except Exception as error:  # a folder may hold anything; it must not take the others with it
        reason = _text(f"{type(error).__name__}: {error}")
        return (name, None, None, None, None, None, UNREADABLE, reason, None, name), []


def _check_plain_file(file: Path) -> None:
    """Raise `BadInput` for what must not be opened: links, pipes, devices, and files too large to be records."""
    try:
        about = os.lstat(file)
    except FileNotFoundError:
        return
    if not stat.S_ISREG(about.st_mode) or about.st_size > LARGEST_FILE:
        raise BadInput(f"{file.name}: not a plain file, or larger than {LARGEST_FILE} bytes")


def _text(value: Any) -> str:
    """Text that any database takes: undecodable file names and lone surrogates replaced, length bounded."""
    return str(value)[:2000].encode("utf-8", "replace").decode()
