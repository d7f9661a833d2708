"""Files as they are let in: ordinary ones, of a size that can be read. Devices, pipes and folders have no end."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from ihbench.errors import BadInput

LARGEST_TEXT = 2**28  # bytes; of files that are text


def regular_file(path: str | Path, what: str = "a file") -> Path:
    """The path itself. Raises `BadInput` where nothing is, and where it is no ordinary file.

    `what` says what was expected, such as "a protocol file".
    """
    path = Path(path)
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        raise BadInput(f"{path}: cannot be opened ({error.strerror}); expected {what}, check the path") from error
    except ValueError as error:  # a zero byte in the name
        raise BadInput(f"{os.fspath(path)!r}: no possible path ({error}); expected {what}") from error
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a device, a pipe or a socket"
        raise BadInput(f"{path}: {kind}; expected {what}")
    return path


def opened(path: str | Path, what: str = "a file") -> BinaryIO:
    """The file, open for reading. Raises `BadInput` as `regular_file`, and for one that cannot be opened."""
    try:
        return open(regular_file(path, what), "rb")
    except OSError as error:
        raise BadInput(f"{path}: cannot be opened ({error.strerror}); expected {what}, check the path") from error


def read_bytes(path: str | Path, what: str = "a file", most: int | None = None) -> bytes:
    """The file's bytes, at most `most`. Raises `BadInput` as `opened` does, and for a larger file."""
    with opened(path, what) as file:
        try:
            if most is not None and os.fstat(file.fileno()).st_size > most:
                raise BadInput(f"{path}: larger than {most // 2**20} MiB; expected {what}")
            return file.read()
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror}); expected {what}, copy it again") from error


def read_text(path: str | Path, what: str = "a text file", most: int = LARGEST_TEXT) -> str:
    """The file's text, UTF-8 with or without a byte-order mark. Raises `BadInput` as `read_bytes`, and for others."""
    try:
        return read_bytes(path, what, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: not UTF-8 text at byte {error.start}; expected {what}, save it as UTF-8") from error


def read_toml(path: str | Path, what: str) -> dict:
    """The tables of a TOML file. Raises `BadInput` as `read_text`, and where it is not TOML."""
    import tomllib

    try:
        return tomllib.loads(read_text(path, what))
    except (ValueError, RecursionError) as error:
        detail = "nested too deeply" if isinstance(error, RecursionError) else " ".join(str(error).split())
        raise BadInput(f"{path}: not valid TOML ({detail}); expected {what}") from error
