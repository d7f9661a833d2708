"""A case that does not end is a fault like any other."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager


class TooLong(BaseException):
    """Not an `Exception`: nothing between the clock and the fuzz may take it for its own."""


@contextmanager
def at_most(seconds: int) -> Iterator[None]:
    """Raise `TooLong` inside the block when it takes longer; in the main thread only."""

    def stop(*_: object) -> None:
        raise TooLong(f"no answer after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
