"""Files that are either the old ones or the new ones, never half of each.

JSON written here parses everywhere: strict JSON has no NaN or infinity, so they are written as the strings "nan",
"inf" and "-inf", and read back as floats. A text that happens to be one of these gets an apostrophe in front
("'nan"), so that everything comes back as it went in.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from ihbench.errors import BadInput
from ihbench.files import removal
from ihbench.files.paths import cache_folder
from ihbench.files.regular import read_bytes

Json: TypeAlias = "bool | int | float | str | list[Json] | dict[str, Json] | None"
NON_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}
MOST_LINKS = 40  # as the system follows
# how an open stream of a process is named, by Linux and by others
OPEN_FILE = re.compile(r"(?:/proc/(?P<process>\d+)(?:/task/\d+)?|/dev)/fd/(?P<number>\d+)")
STRAY = re.compile(r"\..+\.\d+\.[0-9a-f]{8}\.tmp")  # what `_beside` makes

USER_ERRORS = {
    errno.ENOSPC: "disk full",
    errno.EDQUOT: "disk quota used up",
    errno.EFBIG: "file larger than allowed here",
    errno.EROFS: "read-only file system",
    errno.EACCES: "permission denied",
    errno.EPERM: "permission denied",
    errno.EEXIST: "a file stands where a folder should be",
    errno.ENOTDIR: "a file stands where a folder should be",
    errno.EISDIR: "a folder stands where the file should be",
    errno.ENAMETOOLONG: "name too long",
    errno.ENOENT: "no such place",
    errno.ELOOP: "links that lead in a circle",
    errno.ENXIO: "nobody reads there",
    errno.ENODEV: "no such device",
    errno.EBUSY: "in use",
    errno.ETXTBSY: "in use",
}


def write_bytes(path: Path, *data: bytes | memoryview, durable: bool = True) -> None:
    """Write the file, pieces in turn, whole, or leave what was there. Missing parent folders are made.

    See `replaced`. What is no regular file (a terminal, a pipe, /dev/null, /dev/stdout) is written into instead.
    Raises `BadInput` when the disk is full or may not be written.
    """
    path = Path(path)
    try:
        stream = _stream(path)
        if stream is not None:
            with suppress(BrokenPipeError), stream:  # who reads no further has had enough
                stream.writelines(data)
            return
    except OSError as error:
        raise _explained(error, path) from error
    with replaced(path, durable) as temporary:
        temporary.write_bytes(data[0])
        if data[1:]:
            with open(temporary, "ab") as file:
                file.writelines(data[1:])


@contextmanager
def replaced(path: Path, durable: bool = True) -> Iterator[Path]:
    """A file to write into, which takes the name `path` at the end of the block if nothing was raised in it.

    The data go to a file beside it, reach the disk, and only then take the name. `durable=False` skips the wait for
    the disk: for files by the thousand that can be made again; a killed process still leaves no half file. A link is
    followed, and stays; a file that was there passes on its mode and owner; its other names (hard links) keep the old
    content, as copies made with them should. Raises `BadInput` when the disk is full or may not be written.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    temporary = _beside(target)
    try:
        before = _regular(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        # nobody else reads what takes the place of a file that nobody else may read
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666 if before is None else 0o600))
        yield temporary
        if durable:
            with open(temporary, "rb+") as file:
                os.fsync(file.fileno())
        _take_after(temporary, before)
        try:
            os.replace(temporary, target)
        except OSError as error:
            if error.errno != errno.EBUSY:
                raise
            _overwrite(target, temporary.read_bytes())  # a file of its own mount, as containers get them
    except OSError as error:
        raise _explained(error, path) from error
    finally:
        removal.discard_file(temporary)
    if durable:
        _sync_folder(target.parent)


def write_text(path: Path, text: str) -> None:
    """`write_bytes` in UTF-8."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """`value` as indented strict JSON (NaN and infinity: see above). Raises `TypeError` for what JSON lacks."""
    write_text(path, json_text(value))


def json_text(value: Any) -> str:
    """What `write_json` writes."""
    return json.dumps(encode(value), indent=2, allow_nan=False) + "\n"


def write_json_lines(path: Path, rows: list[Any]) -> None:
    """One compact JSON value a line, all of them or none."""
    write_text(path, "".join(json.dumps(encode(row), allow_nan=False) + "\n" for row in rows))


def read_json(path: Path) -> Any:
    """What `write_json` wrote. Raises `BadInput` when the file is missing, unreadable or not JSON."""
    return _parsed(path, _read_text(path))


def read_json_lines(path: Path) -> list[Any]:
    """What `write_json_lines` wrote. Raises `BadInput` as `read_json` does, naming the line."""
    lines = _read_text(path).split("\n")  # not splitlines: a JSON string may hold U+2028 and its like
    return [_parsed(path, line, f", line {number}") for number, line in enumerate(lines, 1) if line.strip()]


def encode(value: Any) -> Any:
    """A value made of what strict JSON has: non-finite floats as strings, numpy, paths and dataclasses unpacked."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    if isinstance(value, str):
        return "'" + value if value.lstrip("'") in NON_FINITE else str(value)
    if isinstance(value, dict):
        for key in value:
            if not isinstance(key, str):
                raise TypeError(f"JSON: expected text as keys, got {key!r}")
        return {key: encode(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [encode(item) for item in value]
    if isinstance(value, os.PathLike):
        return encode(os.fspath(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def decode(value: Any) -> Any:
    """The inverse of `encode`, as far as JSON keeps types (tuples come back as lists)."""
    if isinstance(value, str):
        if value in NON_FINITE:
            return NON_FINITE[value]
        return value[1:] if value.startswith("'") and value.lstrip("'") in NON_FINITE else value
    if isinstance(value, dict):
        return {key: decode(item) for key, item in value.items()}
    if isinstance(value, list):
        return [decode(item) for item in value]
    return value


def unique_keys(pairs: list[tuple[str, Json]]) -> dict[str, Json]:
    """A JSON object, for the parser, which would keep the last of two equal keys. Raises `ValueError` for these."""
    content, seen = dict(pairs), set()
    for key, _ in pairs:
        if key in seen:
            raise ValueError(f"{key[:40]!r} is there twice")
        seen.add(key)
    return content


def _beside(path: Path) -> Path:
    """A hidden name in the same folder, short enough whatever the file is called."""
    return path.parent / f".{path.name[:60]}.{os.getpid()}.{secrets.token_hex(4)}.tmp"


def is_stray(name: str) -> bool:
    """Whether a file of this name was left by a process that was killed while it wrote."""
    return STRAY.fullmatch(name) is not None


def is_stream(path: Path) -> bool:
    """Whether `write_bytes` writes into what is there: a terminal, a pipe, a device, a stream of this process."""
    if _own_stream(path) is not None:
        return True
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return False
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)


def _stream(path: Path) -> BinaryIO | None:
    """What is there, opened for writing, or None where a file belongs. A disk is never written into."""
    own = _own_stream(path)
    if own is not None:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        return os.fdopen(os.dup(own), "wb")  # not opened again: that would cut off what `>>` keeps
    if not is_stream(path):
        return None
    if stat.S_ISBLK(os.stat(path).st_mode):
        raise BadInput(f"{path}: is a whole disk or a part of one, which is never written into; name a file")
    return open(path, "wb")


def _own_stream(path: Path) -> int | None:
    """The number of this process's open stream that a path names, as /dev/stdout and /dev/fd/3 do, or None."""
    for _ in range(MOST_LINKS):
        place = os.path.realpath(path.parent)
        named = OPEN_FILE.fullmatch(os.path.join(place, path.name))
        if named is not None:
            return int(named["number"]) if named["process"] in (None, str(os.getpid())) else None
        try:
            path = Path(place, os.readlink(path))
        except (OSError, ValueError):
            return None
    return None


def _regular(path: Path) -> os.stat_result | None:
    """What is known of the file that is there, or None where there is none. Raises `OSError` where it may not be
    replaced: it is a folder or a device, or its owner has taken the right to write away."""
    try:
        about = os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    number = errno.EACCES if stat.S_ISREG(about.st_mode) else errno.EISDIR
    if number == errno.EISDIR or not os.access(path, os.W_OK):
        raise OSError(number, os.strerror(number))
    return about


def _take_after(file: Path, before: os.stat_result | None) -> None:
    """Give a new file the owner and mode of the one that it will replace, as far as the system lets us."""
    if before is None:
        return
    with suppress(OSError, AttributeError):
        new = os.stat(file)
        if (new.st_uid, new.st_gid) != (before.st_uid, before.st_gid):
            os.chown(file, before.st_uid, before.st_gid)
    with suppress(OSError):
        os.chmod(file, stat.S_IMODE(before.st_mode))


def _overwrite(file: Path, data: bytes) -> None:
    """Write into a file that cannot be replaced; put back what was there if that fails."""
    before = file.read_bytes()
    try:
        file.write_bytes(data)
    except OSError:
        file.write_bytes(before)
        raise


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut, where the system can do that for folders."""
    with suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _explained(error: OSError, path: Path) -> Exception:
    if error.errno in USER_ERRORS:
        return BadInput(
            f"{USER_ERRORS[error.errno]} while writing {path}: nothing was changed; "
            f"make room or {_advice(path)}, then run the same command again"
        )
    return error


def _advice(path: Path) -> str:
    """How another folder is chosen: the cache's by a variable."""
    with suppress(BadInput, OSError):
        if os.path.abspath(path).startswith(os.path.abspath(cache_folder()) + os.sep):
            return "name another folder for the cache with IHBENCH_CACHE"
    return "choose another folder"


def _read_text(path: Path) -> str:
    try:
        return read_bytes(path, "a JSON file").decode("utf-8-sig")  # editors on Windows write a byte-order mark
    except UnicodeDecodeError as error:
        raise BadInput(
            f"{path}: not UTF-8 text at byte {error.start}; expected a JSON file, save it as UTF-8"
        ) from error


def _parsed(path: Path, text: str, where: str = "") -> Any:
    try:
        return decode(json.loads(text))
    except (ValueError, RecursionError) as error:
        detail = f"{error}" if isinstance(error, ValueError) else "nested too deeply"
        raise BadInput(
            f"{path}{where}: not valid JSON ({detail}); restore it from a copy, or move it away"
        ) from error
