"""Run folders: one folder for each run, named by what the run is.

    runs/zju_occ@1__377__inpainthuman__quick__s0__1f0c9a4b2e/
        run.json            identity, config, provenance, machine, ledger, status
        scores.jsonl        one line for each test view: identity string -> value
        curve.jsonl         quality-time points
        renders/  checkpoints/

Two runs are the same run when what affects the answer is the same: protocol, data, method and its configuration,
seed, body and code. The device and the number of threads move the last bits of a result, not its meaning: they are
recorded in `run.json`, and do not make another run.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

from ihbench.clock import machine
from ihbench.clock.checkpoints import is_saved_state
from ihbench.clock.interruption import undisturbed
from ihbench.clock.ledger import ARTIFACTS, Ledger
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import atomic, locks, removal
from ihbench.record.migrations import MIGRATIONS
from ihbench.record.provenance import provenance
from ihbench.record.schema import (
    HASH_LENGTH,
    SCHEMA_VERSION,
    About,
    CurvePoint,
    Outcome,
    RunIdentity,
    RunRecord,
    ScoreLine,
    Status,
    curve_points,
    read_json,
    read_record,
)

NOTHING = About()
STATUSES = get_args(Status)
FINISHED = ("done", "diverged", "skipped")  # running such a run again would end the same way
OUR_NAME = re.compile(f"__[0-9a-f]{{{HASH_LENGTH}}}$")  # of a run folder, even of one that has lost its record
LOCK = "lock"
INDEX = "runs.sqlite"  # beside the run folders
DAMAGED_NAME = re.compile(r"run\.json\.damaged(-\d+)?")
KILLED = "its process ended without a word: it was killed, or the machine went down"
# what the bench writes into a run folder: whatever else lies there is the user's, and stays
EXPORTED = {  # of `ihbench export` and `render`, unless they are told otherwise
    "avatar.ply", "avatar.glb", "avatar_splats.glb", "avatar_texture.png", "avatar_motion.npz", "render.webp",
}  # fmt: skip
SEQUENCE = "avatar_ply"  # folder of an exported sequence
WRITTEN = {
    "": {
        "run.json", "scores.jsonl", "calibration.jsonl", "curve.jsonl", "traceback.txt", "contact_sheet.png",
        *EXPORTED, *ARTIFACTS,
    },
    SEQUENCE: {".ply"},
    "avatar": {".safetensors", ".json", ".npz", ".npy", ".pt", ".pth", ".bin"},
    "checkpoints": {".safetensors"},
    "live": {".safetensors", ".json", ".npz", ".npy", ".pt", ".pth", ".bin"},  # snapshots while somebody watches
    "presets": {".jsonl"},
    "renders": {".png"},  # of a number
}  # fmt: skip


class RunFolder:
    """One run on disk. `create` opens it for writing, `open` for reading."""

    def __init__(self, path: Path, record: RunRecord) -> None:
        self.path = path
        self.record = record

    @classmethod
    def create(cls, runs: Path, identity: RunIdentity, about: About = NOTHING, force: bool = False) -> RunFolder:
        """The folder of this run, new or as an earlier process left it.

        A finished run is found, not begun again (see `finished`); one that was cut short keeps its checkpoints and
        its ledger, to be resumed. `force` sets a finished run aside until `settle`, and
        empties the folder otherwise. A damaged run.json is kept beside as
        run.json.damaged, and the run starts again with a warning. `about` holds what a reader should know and no
        identity needs (whether the data are a stand-in, the device). Hold `lock()` while writing. Raises `BadInput`
        when the folder cannot be written, belongs to another run, or to a newer version of this bench.
        """
        path = Path(runs) / identity.folder_name
        if not force:
            return cls._there(path, identity, about)
        try:
            with _locked(path), _movable(path):
                _set_aside(path)
            return cls._there(path, identity, about)
        except BaseException:
            with undisturbed(), suppress(BadInput), _locked(path), _movable(path):
                _bring_back(path)
            raise

    @classmethod
    def _there(cls, path: Path, identity: RunIdentity, about: About) -> RunFolder:
        """The run as `create` finds or begins it."""
        warnings: tuple[str, ...] = ()
        if (path / "run.json").exists():
            try:
                run = cls.open(path)
            except DamagedRecord as damage:
                damaged = _free_name(path / "run.json.damaged")
                os.rename(path / "run.json", damaged)
                warnings = (f"run.json was damaged and the run started again: {damage}",)
            else:
                if run.record.digest != identity.digest:
                    raise BadInput(
                        f"{path}: holds another run under the same name; move that folder away and run again"
                    )
                return run
        outcome = Outcome("running", "", created=_now())
        record = RunRecord(
            identity.digest, outcome, identity, about, machine.identity(), provenance(), warnings=warnings
        )
        run = cls(path, read_record(atomic.decode(atomic.encode(as_json(record))), str(path)))  # as it is read again
        run.save()
        return run

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """Read a run folder. Raises `BadInput` when it is none, is damaged, or is of a newer version."""
        file = Path(path) / "run.json"
        if not os.path.lexists(file):
            raise BadInput(f"{path}: not a run folder, it has no run.json; expected a folder that ihbench run made")
        try:
            record = read_json(file)
        except BadInput as error:
            raise DamagedRecord(str(error)) from error
        return cls(Path(path), _checked(file, record))

    # --- what it says ---

    @property
    def identity(self) -> RunIdentity:
        return self.record.identity

    @property
    def about(self) -> About:
        return self.record.about

    @property
    def status(self) -> Status:
        return self.record.outcome.status

    @property
    def reason(self) -> str:
        return self.record.outcome.reason

    @property
    def finished(self) -> bool:
        """Whether the outcome stands: done, diverged or skipped. Everything else may be continued."""
        return self.status in FINISHED

    @property
    def renders(self) -> Path:
        return self.path / "renders"

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    def curve(self) -> list[CurvePoint]:
        """Quality-time points in order. Raises `BadInput` for a damaged file."""
        file = self.path / "curve.jsonl"
        return curve_points(file) if os.path.lexists(file) else []

    def notice_death(self) -> None:
        """Of a run that says it is running, and that nobody is writing, know that it was interrupted."""
        if self.status == "running" and not locks.is_held(self.path / LOCK):
            self._change(outcome=replace(self.record.outcome, status="interrupted", reason=KILLED))

    # --- writing ---

    def set_status(
        self, status: Status, reason: str = "", ledger: Ledger | None = None, step: int | None = None
    ) -> None:
        """Write the outcome, and the ledger's books with it. Raises `ValueError` for an unknown status."""
        if status not in STATUSES:
            raise ValueError(f"run status: expected one of {', '.join(STATUSES)}, got {status!r}")
        self._change(outcome=replace(self.record.outcome, status=status, reason=reason, step=step))
        if ledger is not None:
            self._change(ledger=ledger.state())
        self.save()

    def describe(self, **about: Any) -> None:
        """Put more into what a reader should know; `save` writes it."""
        self._change(about=replace(self.about, **about))

    def note_machine(self, at: machine.Machine) -> None:
        self._change(machine=at)

    def warn(self, text: str) -> None:
        """Note something the reader of the result should know; once."""
        if text not in self.record.warnings:
            self._change(warnings=(*self.record.warnings, text))
            self.save()

    def save(self) -> None:
        """Write run.json. Machine and versions are those of the process that wrote it last."""
        self._change(outcome=replace(self.record.outcome, updated=_now()))
        atomic.write_json(self.path / "run.json", {"schema_version": SCHEMA_VERSION, **as_json(self.record)})

    def restarted(self) -> None:
        """Mark a run that is continued as running, on this machine with these versions."""
        self._change(provenance=provenance(), machine=machine.identity())
        self.set_status("running")

    def _change(self, **parts: Any) -> None:
        self.record = replace(self.record, **parts)

    @contextmanager
    def saving_avatar(self) -> Iterator[None]:
        """Note in the record which files are written into the folder `avatar` meanwhile: the method names them."""

        def state() -> dict[str, tuple[int, ...]]:
            files = [path for path in (self.path / "avatar").rglob("*") if path.is_file() and not path.is_symlink()]
            about = {path.relative_to(self.path).as_posix(): path.stat() for path in files}
            return {name: (stat.st_ino, stat.st_size, stat.st_mtime_ns) for name, stat in about.items()}

        before = state()
        yield
        known = self.about.avatar_files or ()
        changed = [name for name, stat in state().items() if before.get(name) != stat]
        self.describe(avatar_files=tuple(sorted({*known, *changed})))

    def write_scores(self, rows: Sequence[ScoreLine]) -> None:
        """Replace scores.jsonl: one row for each test view."""
        atomic.write_json_lines(self.path / "scores.jsonl", as_json(rows))

    def add_curve_point(self, point: CurvePoint) -> None:
        """Append a quality-time point.

        Points of this step or later are dropped: a resumed fit makes them again. A damaged file begins anew, with a
        warning: the fit does not depend on it.
        """
        try:
            kept = [earlier for earlier in self.curve() if earlier.step < point.step]
        except BadInput as damage:
            kept = []
            self.warn(f"earlier points of the quality-time curve are lost: {damage}")
        atomic.write_json_lines(self.path / "curve.jsonl", as_json([*kept, point]))

    def settle(self, keep_new: bool) -> None:
        """End a forced run: forget the finished run it replaces, or bring that one back. Call it inside `lock()`."""
        old = _aside(self.path)
        with _movable(self.path):
            if not keep_new:
                _bring_back(self.path)
            elif old.is_dir():
                removal.remove_written(old, _written_in(old))
                with suppress(OSError):  # it holds something that is not ours
                    old.rmdir()

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes from writing this run, and read again what they may have written before.

        Ask `finished` inside. Raises `BadInput` naming the process that is writing.
        """
        with _locked(self.path):
            removal.remove_written(self.path, lambda path: atomic.is_stray(path.name))  # of a process that was killed
            if not os.path.lexists(self.path / "run.json"):  # a forced rival, or `runs rm`, has made room meanwhile
                self.save()
            self.record = RunFolder.open(self.path).record
            yield


def is_finished(runs: Path, identity: RunIdentity) -> bool:
    """Whether `RunFolder.create` would find this run and its outcome. Writes nothing."""
    try:
        return RunFolder.open(Path(runs) / identity.folder_name).finished
    except (BadInput, OSError):
        return False


def note_interruption(path: Path, reason: str) -> None:
    """Of a run whose record says that it is running, and that nobody writes, record that it was interrupted; a
    finished one that it would have replaced is brought back."""
    if not (path / "run.json").is_file():
        return
    with suppress(BadInput, OSError), locks.locked(path / LOCK, "", wait=0):
        _bring_back(path)
        run = RunFolder.open(path)
        if run.status == "running":
            run.set_status("interrupted", reason)


class DamagedRecord(BadInput):
    """A run.json that is there and cannot be used."""


def _checked(file: Path, record: Any) -> RunRecord:
    """The record brought to this schema version. Raises `BadInput` for a newer one, `DamagedRecord` for no record."""
    version = record.get("schema_version") if isinstance(record, dict) else None
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise DamagedRecord(f"{file}: not a run record, schema_version is missing; run the same command with --force")
    if version > SCHEMA_VERSION:
        raise BadInput(
            f"{file}: written by a newer ihbench (schema {version}, this one knows {SCHEMA_VERSION}); update ihbench"
        )
    while version < SCHEMA_VERSION:
        version, record = version + 1, MIGRATIONS[version](record)
    record = {**record, "schema_version": version}
    try:
        made = read_record(record, str(file))
    except BadInput as error:
        raise DamagedRecord(f"{error}; run the same command with --force") from error
    if made.identity.digest != made.digest:
        raise BadInput(f"{file}: its identity is not the one of its digest: edited, or of another run; restore it")
    return made


def _free_name(path: Path) -> Path:
    """The path, or the first of path-2, path-3, … that is not there."""
    number, free = 1, path
    while os.path.lexists(free):
        number, free = number + 1, path.with_name(f"{path.name}-{number + 1}")
    return free


def _locked(path: Path) -> AbstractContextManager[None]:
    """Keep other processes from writing a run folder."""
    return locks.locked(path / LOCK, "choose another --runs folder")


@contextmanager
def _movable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BadInput(
            f"{path}: cannot be replaced ({error.strerror or error}); choose another --runs folder"
        ) from error


def _aside(path: Path) -> Path:
    """Where a finished run waits while a forced one takes its place; too deep for reports to find it."""
    return path.parent / "replaced" / path.name


def _set_aside(path: Path) -> None:
    """Make room for a forced run. What is not finished is not worth keeping."""
    if path.is_symlink():
        raise BadInput(f"{path}: is a link; --force only empties real run folders, remove the link")
    old = _aside(path)
    try:
        finished = not (old / "run.json").exists() and RunFolder.open(path).finished
    except BadInput:
        finished = False
    if finished:
        removal.move_written(path, old, _written_in(path), "run.json")
    else:
        removal.remove_written(path, _written_in(path))


def _is_ours(path: Path) -> bool:
    """Whether the bench writes what has this path in a run folder."""
    top = path.parts[0]
    if len(path.parts) == 1:
        return path.name in WRITTEN[""] or path.name in WRITTEN or atomic.is_stray(path.name)
    if top == "renders" and path.suffix == ".png":
        return path.stem.isdecimal()
    return path.suffix in WRITTEN.get(top, ()) or atomic.is_stray(path.name)


def _bring_back(path: Path) -> None:
    """Undo `_set_aside`, as far as it came: the record goes last in both directions."""
    old = _aside(path)
    if not old.is_dir():
        return
    if (old / "run.json").exists():
        removal.remove_written(path, _written_in(path))
    removal.move_written(old, path, _written_in(old), "run.json")
    with suppress(OSError):  # it holds something that is not ours
        old.rmdir()


def _written_in(folder: Path) -> removal.Ours:
    """`_is_ours` of one run folder. Where a method or the user chooses the name, the record or the file itself says
    who wrote it."""
    try:
        avatar = RunFolder.open(folder).about.avatar_files
    except BadInput:
        avatar = None  # as of a run of version 0.1: all that has such a name

    def ours(path: Path) -> bool:
        if len(path.parts) > 1 and not atomic.is_stray(path.name):
            if path.parts[0] == "avatar" and avatar is not None and not (folder / path).is_dir():
                return path.as_posix() in avatar
            if path.parts[0] == "checkpoints":
                return is_saved_state(folder / path)
        return _is_ours(path)

    return ours


def check_is_run(path: Path) -> None:
    """Raise `BadInput` unless a run of this bench lies at `path`: one whose record says so, or whose name does where
    the record is damaged or gone."""
    if path.is_symlink():
        raise BadInput(f"{path}: is a link; name the run folder itself")
    if not OUR_NAME.search(path.resolve().name) or not path.is_dir():
        RunFolder.open(path)


def writer_of(path: Path) -> Path | None:
    """The lock of a run that somebody is writing, else None."""
    return path / LOCK if locks.is_held(path / LOCK) else None


def remove_run(path: Path) -> Path | None:
    """Remove what the bench wrote into a run folder, and the folder; where something else is in it, that stays, and
    its path is returned. Raises `BadInput` for what is no run, for one that somebody writes, and where it may not go.
    """
    check_is_run(path)
    advice = "check its permissions"
    with locks.locked(path / LOCK, advice, wait=0), _movable(path):
        ours = _written_in(path)
        removal.remove_written(path, lambda file: ours(file) or DAMAGED_NAME.fullmatch(str(file)) is not None)
        removal.discard_file(path / LOCK)  # while it is held: later it may be somebody else's
    with suppress(OSError):
        path.rmdir()
        return None
    return removal.foreign(path, lambda _: False) or path


def is_record(path: Path) -> bool:
    """Whether what has this path in a run folder belongs to the run; an exported avatar does not."""
    exported = path.as_posix() in EXPORTED or path.parts[0] == SEQUENCE
    return (not exported and _is_ours(path)) or path.as_posix() in (
        LOCK,
        LOCK + locks.OWNER,
        LOCK + locks.CLAIM,
    )


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
