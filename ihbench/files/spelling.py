"""Names that differ in case or in the form of their accents only: of other systems, cameras and archives."""

from __future__ import annotations

import os
import unicodedata
from pathlib import Path

from ihbench.errors import BadInput


def same_name(name: str) -> str:
    """What two spellings of one name share: macOS stores é as two characters, Windows and cameras write .PNG."""
    return unicodedata.normalize("NFC", name).casefold()


def as_stored(path: Path) -> Path:
    """The file or folder in the spelling of its folder; the path itself where that exists, or nothing is alike."""
    if os.path.lexists(path):
        return path
    try:
        alike = [name for name in os.listdir(path.parent) if same_name(name) == same_name(path.name)]
    except OSError:
        return path
    return path.with_name(alike[0]) if len(alike) == 1 else path


def missing_file(path: Path, expected: str, kind: str = "no such file") -> BadInput:
    """The error that a file is missing, with the one that is spelled otherwise, if there is one."""
    stored = as_stored(path)
    other = f"; there is {stored.name!r}, rename it to {path.name!r}" if stored.name != path.name else ""
    return BadInput(f"{path}: {kind}{other}; {expected}")
