"""Files whose names the bench chooses in a folder that the user chose: never over what somebody else put there.

`LIST` in that folder says what was written there, with hashes. A file of the same name that is not in it, or has been
edited since, is the user's: it stays, and the command says so. A file that the user names is replaced, as with any
other command.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput
from ihbench.files import atomic, removal
from ihbench.record.store import INDEX, is_record

LIST = ".ihbench-written.json"


def write_bytes(path: Path, data: bytes, durable: bool = True) -> None:
    """`atomic.write_bytes` of a file that is new, or that the bench wrote. Raises `BadInput` for another."""
    if atomic.is_stream(path):
        atomic.write_bytes(path, data)
        return
    digest = hashlib.sha256(data).hexdigest()
    if _hash(path) == digest:
        return
    with suppress(OSError):  # said where the file is written
        path.parent.mkdir(parents=True, exist_ok=True)
    with _alone(path.parent):
        check(path.parent, [path.name])
        written = _written(path.parent)
        # first the list, with the old file and the new: a kill in between must not make a stranger of either
        _note(path, [*written.get(path.name, []), digest], written)
        atomic.write_bytes(path, data, durable=durable)
        _note(path, [digest], written)


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep the list from other commands that write into this folder, where the system can lock one."""
    with ExitStack() as held:
        with suppress(OSError, ImportError):
            import fcntl

            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield


def write_text(path: Path, text: str) -> None:
    """`write_bytes` in UTF-8."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """As `atomic.write_json` writes."""
    write_text(path, atomic.json_text(value))


def write_files(path: Path, files: Mapping[str, bytes]) -> Path:
    """Files of one name, by suffix. Returns the first one's path."""
    for suffix, data in files.items():
        write_bytes(path.parent / f"{path.name}{suffix}", data)
    return path.parent / f"{path.name}{next(iter(files))}"


def remove_old(folder: Path, ours: Callable[[str], bool]) -> None:
    """Remove files that the bench wrote into this folder under such names, and that nobody has edited since."""
    with _alone(folder):
        written = _written(folder)
        for name, digests in sorted(written.items()):
            path = folder / name
            if ours(name) and not path.is_symlink() and _hash(path) in digests:
                removal.discard_file(path)


def check(folder: Path, names: Iterable[str]) -> None:
    """Raise `BadInput` where one of these files is there and is somebody else's. For long work, before it begins."""
    written = _written(folder)
    for name in names:
        path = folder / name
        there = None if atomic.is_stream(path) else _hash(path)
        if there is not None and there not in written.get(name, []):
            raise BadInput(
                f"{path}: is there already and not as ihbench wrote it; move it away, or name another folder"
            )


def check_file(path: Path | None, *sources: Path | None) -> None:
    """Raise `BadInput` where a file that the user names to be written is a part of a run, a training set or a
    stand-in, or one of `sources`, which the command reads, or in them. None is fine."""
    if path is None or not os.path.lexists(path) or atomic.is_stream(path):
        return
    for source in sources:
        if source is not None and removal.holds(source, path):
            raise BadInput(f"{path}: is a part of {source}, which is only read; name another file")
    where = Path(os.path.realpath(path))
    for folder in list(where.parents)[:4]:
        if _is_part(folder, where.relative_to(folder)):
            raise BadInput(f"{path}: is a part of {folder}, which ihbench wrote; name another file")


def _is_part(folder: Path, file: Path) -> bool:
    if os.path.isfile(folder / "run.json") and is_record(file):
        return True
    if file.as_posix() == INDEX:
        return True
    for name, list_of in (("manifest.json", "files"), ("STANDIN.json", None)):
        if not os.path.isfile(folder / name):
            continue
        with suppress(BadInput):
            content = atomic.read_json(folder / name)
            maker = content.get("made_by", content.get("generator")) if isinstance(content, dict) else None
            if str(maker).startswith("ihbench") and (list_of is None or file.as_posix() in content.get(list_of, ())):
                return True
    return False


def _written(folder: Path) -> dict[str, list[str]]:
    """File name -> hashes of what was written under it; empty where nothing was or the list is damaged."""
    try:
        content = atomic.read_json(folder / LIST)
    except BadInput:
        return {}
    if not isinstance(content, dict):
        return {}
    return {name: hashes for name, hashes in content.items() if isinstance(hashes, list)}


def _note(path: Path, hashes: list[str], written: dict[str, list[str]]) -> None:
    written[path.name] = hashes
    atomic.write_json(path.parent / LIST, written)


def _hash(path: Path) -> str | None:
    """None where nothing is. What cannot be read is somebody else's."""
    if not os.path.lexists(path) or (path.is_symlink() and not path.exists()):
        return None
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
