"""What a command says when something has gone wrong that nobody caught: one line for every kind of exception."""

from __future__ import annotations

import errno
import os
import sys
import tempfile
import traceback
from dataclasses import dataclass

from ihbench import registry
from ihbench.clock import streams
from ihbench.clock.interruption import reason_of, status_of
from ihbench.errors import BadInput, Diverged, visible

DEBUG = "IHBENCH_DEBUG"  # environment variable: print tracebacks, too
REPORT_TO = "please report it with that traceback"


@dataclass(frozen=True)
class Failure:
    code: int  # exit status
    status: str  # one word or two, for --json
    text: str  # one line


def explained(error: BaseException) -> Failure | None:
    """How a command ends that this exception ended; None when only the reader of its output went away."""
    if os.environ.get(DEBUG) and not isinstance(error, BrokenPipeError):
        traceback.print_exception(error, file=sys.stderr)
    match error:
        case BadInput():
            return Failure(2, "bad input", one_line(str(error)))
        case Diverged():  # outside of a recorded run
            return Failure(1, "diverged", one_line(str(error)))
        case KeyboardInterrupt():
            how = reason_of(error).removesuffix(" by the user")
            return Failure(status_of(error), "interrupted", f"{how}; the same command continues where it stopped")
        case OSError():
            return _system_error(error)
        case UnicodeError():
            return Failure(2, "bad input", f"text that cannot be read or written as such: {one_line(str(error))}")
    if out_of_memory(error):
        return Failure(
            2, "out of memory", f"out of memory ({_named(error)}); ask for smaller images, or fewer of them"
        )
    if type(error).__module__.partition(".")[0] == "torch" or "CUDA error" in str(error):
        return Failure(2, "device failed", f"the device failed: {_named(error)}; try --device cpu")
    return Failure(3, "fault", f"a fault of {_owner(error)}, not of yours: {_named(error)}; {_kept(error)}")


def out_of_memory(error: BaseException) -> bool:
    """Python's, numpy's and torch's ways to say so, without importing torch."""
    return (
        isinstance(error, MemoryError)
        or type(error).__name__ == "OutOfMemoryError"
        or (isinstance(error, RuntimeError) and "can't allocate memory" in str(error))
    )


def one_line(text: str) -> str:
    return visible(" ".join(text.split()))


def system_words(error: OSError) -> str:
    """What the system said of which file: "no space left on device: /data/x"."""
    what = one_line(error.strerror or str(error) or type(error).__name__)
    names = (error.filename, error.filename2)
    files = [os.fsdecode(name) for name in names if isinstance(name, str | bytes | os.PathLike)]
    return f"{what[:1].lower()}{what[1:]}" + (f": {' -> '.join(files)}" if files else "")


def _system_error(error: OSError) -> Failure | None:
    if error is streams.failure():
        if error.errno == errno.EPIPE:
            return None
        text = f"standard output cannot be written ({system_words(error)}); send it elsewhere"
        return Failure(2, "output failed", text)
    if error.errno == errno.ENOENT and _is_homeless():
        return Failure(2, "system error", "the current folder has been removed; go to another one, then run it again")
    text = f"{system_words(error)}; check that path, its permissions and the disk, then run the same command again"
    return Failure(2, "system error", text)


def _is_homeless() -> bool:
    try:
        os.getcwd()
    except OSError:
        return True
    return False


def _named(error: BaseException) -> str:
    return one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)[:500]


def _owner(error: BaseException) -> str:
    """The package of somebody else that the traceback goes through, else the bench."""
    others = registry.other_packages()
    for frame, _ in traceback.walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package in others:
            return f"the package {others[package]}"
    return "ihbench"


def _kept(error: BaseException) -> str:
    """Keep the traceback in a file of its own, and say where."""
    text = "".join(traceback.format_exception(error))
    try:
        number, path = tempfile.mkstemp(prefix="ihbench-", suffix="-traceback.txt")
        with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    except OSError:
        return f"{DEBUG}=1 prints the traceback, {REPORT_TO}"
    return f"the traceback is in {path}, {REPORT_TO}"
