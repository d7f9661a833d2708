"""Threads of libraries, kept from standing in each other's way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

_lock = Lock()
_users = 0
_restore: list = []


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
