"""Standard output and error wherever the bench runs: closed, full, without a reader, in a poor encoding."""

from __future__ import annotations

import codecs
import io
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from ihbench.errors import visible

STYLE = re.compile(r"(\x1b\[[0-9;]*m)")  # what colours and weighs text on a terminal


def _escaped(error: UnicodeError) -> tuple[str, int]:
    r"""What an encoding lacks, as \uXXXX: unlike Python's own escapes that is what JSON calls it, too."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    units = error.object[error.start : error.end].encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k : k + 2].hex()}" for k in range(0, len(units), 2)), error.end


codecs.register_error("ihbench.escaped", _escaped)


class Stdout(io.TextIOWrapper):
    """Standard output that remembers why it could not be written: the exception itself does not name its file."""

    failure: OSError | None = None
    used = False  # whether anything has been printed

    def __init__(self, plain: io.TextIOWrapper):
        super().__init__(plain.buffer, plain.encoding, plain.errors)
        self.reconfigure(line_buffering=plain.line_buffering, write_through=plain.write_through)
        self.plain = plain  # would close what both write to when nobody held it

    def write(self, text: str, /) -> int:
        self.used = self.used or bool(text)
        try:
            return super().write(text)
        except OSError as error:
            self.failure = error
            raise

    def flush(self) -> None:
        try:
            super().flush()
        except OSError as error:
            self.failure = error
            raise


def settle() -> None:
    """Make both streams bear any text, and put the null device in the place of what is closed.

    Otherwise the next file that is opened would get the number of the closed stream, and everything that is printed.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            with suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # the lowest free number: this one
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="ihbench.escaped")
    out = sys.stdout
    if type(out) is io.TextIOWrapper:  # not what tests and notebooks put there
        sys.stdout = Stdout(out)


@contextmanager
def shown() -> Iterator[None]:
    """What is printed inside brings no unseen character of anybody's names to the streams; see `styled`.

    A terminal's stderr is left alone: progress bars move its cursor, and show what they say as it should be.
    """
    guarded: list[Any] = [stream for stream in (sys.stdout, sys.stderr) if stream is not None]
    if sys.stderr is not None and sys.stderr.isatty():
        guarded.remove(sys.stderr)
    before = [(stream, stream.write) for stream in guarded]
    try:
        for stream, write in before:
            stream.write = _showing(write, stream.isatty())
        yield
    finally:
        for stream, write in before:
            stream.write = write


def _showing(write: Any, terminal: bool) -> Any:
    def show(text: str) -> int:
        if not text.isprintable():
            parts = STYLE.split(text) if terminal and _styled else [text]
            text = "".join(part if k % 2 else visible(part, keep="\n\t") for k, part in enumerate(parts))
        return write(text)

    return show


_styled = False


@contextmanager
def styled() -> Iterator[None]:
    """Text printed inside is the bench's own, and may be in colours where it goes to a terminal."""
    global _styled
    before, _styled = _styled, True
    try:
        yield
    finally:
        _styled = before


def failure() -> OSError | None:
    """Why stdout cannot be written, where that has happened."""
    return getattr(sys.stdout, "failure", None)


def used() -> bool:
    """Whether anything has been printed on stdout, as far as it can be told: a file's own lines are not counted."""
    out = sys.stdout
    return out.used if isinstance(out, Stdout) else isinstance(out, io.StringIO) and out.tell() > 0


def drop(stream: TextIO) -> None:
    """Let what is still in a stream go nowhere, so that the end of the process does not complain of it."""
    with suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def say(text: str, stream: TextIO) -> bool:
    """Print a line on stderr. What nobody can read must not end what it tells of: False when it cannot be printed."""
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError):  # full, without a reader, closed
        drop(stream)
        return False
    return True
