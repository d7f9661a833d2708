"""Threads of libraries, kept from standing in each other's way."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Event, Lock, Thread

# what OpenMP's threads do at the end of a loop: by default they wait for the next one at full speed for a millisecond
# (GNU) or for 200 (LLVM, Intel), on cores that somebody else needs
WAITING = {"GOMP_SPINCOUNT": "10000", "KMP_BLOCKTIME": "1"}  # turns, some 30 µs; ms
WORDS = ("OMP_WAIT_POLICY", *WAITING)  # of the environment; whoever sets one of them has decided

_lock = Lock()
_users = 0
_restore: list = []


def bound_spinning() -> None:
    """Let torch's OpenMP threads sleep soon when they have nothing to do.

    The renderer's own threads take turns with torch's on the same cores. Where those spin on, each waits for the
    other: on a busy machine an image took five times the processor time, and a fit two to four times the seconds.
    OpenMP reads its settings while torch is being imported. In a process that has torch already the GNU library is
    told otherwise, see `_outnumber_cores`; Intel's and LLVM's can be asked.
    """
    if any(word in os.environ for word in WORDS):
        return
    os.environ |= WAITING
    if "torch" in sys.modules:
        _bound_spinning_now()


def _bound_spinning_now() -> None:
    from threadpoolctl import ThreadpoolController

    for library in ThreadpoolController().select(user_api="openmp").lib_controllers:
        if library.prefix == "libgomp":
            _outnumber_cores()
        elif hasattr(library.dynlib, "kmp_set_blocktime"):
            library.dynlib.kmp_set_blocktime(int(WAITING["KMP_BLOCKTIME"]))


@cache
def _outnumber_cores() -> None:
    """Give libgomp more threads than there are cores, after which it spins a three-hundredth as long (its "throttled"
    count): a second team, which did one loop and sleeps for as long as the thread that it belongs to does."""
    import torch

    began = Event()

    def sleeper() -> None:
        torch.ones(2**18, device="cpu").sum()  # long enough for torch to share it out
        began.set()
        Event().wait()

    Thread(target=sleeper, name="ihbench-outnumbers-cores", daemon=True).start()
    began.wait()


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch works on one thread: tensors that are small wait longer for a second one than they work."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def begin_on_one_thread() -> None:
    """For a worker process, one of as many as there are cores: torch, BLAS, OpenCV and numba work on one thread each
    from now on. Otherwise sixteen workers have 256 threads, and all of them wait."""
    import cv2
    import numba
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    numba.set_num_threads(1)
    cv2.setNumThreads(1)
    threadpool_limits(1)


@contextmanager
def single_threaded_libraries() -> Iterator[None]:
    """BLAS and OpenCV work on one thread each while the caller's own threads do the work side by side.

    Otherwise every one of those threads calls up as many again, which wait for each other by spinning: on two cores,
    scoring a frame took twice as long. torch is left as it is. Safe to nest and to enter from several threads.
    """
    global _users
    with _lock:
        _users += 1
        if _users == 1:
            from threadpoolctl import threadpool_limits

            _restore.append(threadpool_limits(1, user_api="blas").restore_original_limits)
            import cv2

            before = cv2.getNumThreads()
            cv2.setNumThreads(1)
            _restore.append(lambda: cv2.setNumThreads(before))
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0:
                while _restore:
                    _restore.pop()()
