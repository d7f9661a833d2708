"""The system's requests to end, taken as Ctrl-C is: the work stops, its end is recorded, and it can go on later.

SIGTERM comes from `kill`, batch systems and containers, SIGHUP from a terminal that closes, SIGXCPU from a limit on
processor time, SIGUSR1 and SIGUSR2 from batch systems that warn. A signal that is ignored (`nohup`) stays ignored,
and a handler of somebody else's stays in force.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

REQUESTS = ("SIGTERM", "SIGHUP", "SIGXCPU", "SIGUSR1", "SIGUSR2", "SIGBREAK")  # no system has all of them
SIGNALS = [getattr(signal, name) for name in ("SIGINT", *REQUESTS) if hasattr(signal, name)]
GRACE = 5.0  # s that a process without its parent has to record how it ended


class Terminated(KeyboardInterrupt):
    """Raised where the work stands when the system asks the process to end."""

    def __init__(self, number: int):
        super().__init__(f"interrupted by {signal.Signals(number).name}")
        self.number = number


_asked: KeyboardInterrupt | None = None  # what was raised, until it is dealt with


def asked() -> KeyboardInterrupt | None:
    """The interruption that has come and not been dealt with, once: libraries in C make other exceptions of it."""
    global _asked
    stop, _asked = _asked, None
    return stop


def check() -> None:
    """Raise again an interruption that a library has swallowed, as callbacks from C do."""
    if _asked is not None and threading.current_thread() is threading.main_thread():
        raise _asked


def status_of(stop: KeyboardInterrupt) -> int:
    """The exit status that shells know the end by: 128 and the signal's number."""
    return 128 + (stop.number if isinstance(stop, Terminated) else signal.SIGINT)


def reason_of(stop: KeyboardInterrupt) -> str:
    """How a run ended, for its record."""
    return str(stop) if isinstance(stop, Terminated) else "interrupted by the user"


@contextmanager
def interruptible() -> Iterator[None]:
    """Requests to end raise `Terminated` in this block. In a thread other than the main one nothing changes."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        owner = os.getpid()

        def stop(number: int, frame: object) -> None:
            global _asked
            if os.getpid() != owner and number != signal.SIGINT:  # forked: nobody there expects the exception
                signal.signal(number, signal.SIG_DFL)
                os.kill(os.getpid(), number)
                return
            _asked = KeyboardInterrupt() if number == signal.SIGINT else Terminated(number)
            raise _asked

        for number in SIGNALS:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                before[number] = signal.signal(number, stop)
    try:
        yield
    except BaseException as error:
        came = asked() if before else None
        if came is not None and came is not error:
            raise came from error  # a library has made something else of it
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if before:
            asked()  # swallowed, and the work done all the same: nothing of it may reach what comes next


@contextmanager
def undisturbed() -> Iterator[None]:
    """Interruptions wait until this short block has ended: a record, once begun, is written. Of a second one that
    comes while the first is dealt with nothing more is heard."""
    before: dict[int, Any] = {}
    came: list[tuple[int, Any]] = []
    if threading.current_thread() is threading.main_thread():

        def note(number: int, frame: object) -> None:
            came.append((number, frame))

        for number in SIGNALS:
            if callable(signal.getsignal(number)):
                before[number] = signal.signal(number, note)
    ended = False
    try:
        yield
        ended = True
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if ended and came:
            number, frame = came[0]
            before[number](number, frame)


def end_with_parent() -> None:
    """Let this process end soon after the one that started it, however that ends; SIGKILL tells nobody."""
    from multiprocessing import parent_process

    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)  # so that a run in progress is recorded
        time.sleep(GRACE)
        os._exit(128 + signal.SIGTERM)

    threading.Thread(target=watch, name="parent", daemon=True).start()
