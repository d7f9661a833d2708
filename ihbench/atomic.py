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
import secrets
from pathlib import Path
from typing import Any

import numpy as np

from ihbench.errors import BadInput

NON_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}

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
}


def write_bytes(path: Path, data: bytes, durable: bool = True) -> None:
    """Write the file whole, or leave what was there. Missing parent folders are made.

    The data go to a file beside it, reach the disk, and only then take the name. `durable=False` skips the wait for
    the disk: for files by the thousand that can be made again; a killed process still leaves no half file. Raises
    `BadInput` when the disk is full or may not be written.
    """
    path = Path(path)
    temporary = _beside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise _explained(error, path) from error
    finally:
        _remove_file(temporary)
    if durable:
        _sync_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """`write_bytes` in UTF-8."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """`value` as indented strict JSON (NaN and infinity: see above). Raises `TypeError` for what JSON lacks."""
    write_text(path, json.dumps(encode(value), indent=2, allow_nan=False) + "\n")


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


def _beside(path: Path) -> Path:
    """A hidden name in the same folder, short enough whatever the file is called."""
    return path.parent / f".{path.name[:60]}.{os.getpid()}.{secrets.token_hex(4)}.tmp"


def _remove_file(path: Path) -> None:
    try:
        path.unlink()
    except OSError:  # the usual case: it has been renamed
        return


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power cut, where the system can do that for folders."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        return
    finally:
        os.close(descriptor)


def _explained(error: OSError, path: Path) -> Exception:
    if error.errno in USER_ERRORS:
        return BadInput(
            f"{USER_ERRORS[error.errno]} while writing {path}: nothing was changed; "
            f"make room or choose another folder, then run the same command again"
        )
    return error


def _read_text(path: Path) -> str:
    try:
        return Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}); expected a JSON file") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not UTF-8 text at byte {error.start}; expected a JSON file") from error


def _parsed(path: Path, text: str, where: str = "") -> Any:
    try:
        return decode(json.loads(text))
    except (ValueError, RecursionError) as error:
        detail = f"{error}" if isinstance(error, ValueError) else "nested too deeply"
        raise BadInput(f"{path}{where}: not valid JSON ({detail}); restore the file or remove it") from error
