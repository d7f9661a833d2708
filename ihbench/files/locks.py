"""One writer at a time, in whatever place: the system's file locks, and claims where a file system has none.

The system's lock ends with its process however that ends. Some network and container file systems refuse it (errors
37, 38, 95); there filelock's `SoftFileLock` claims the place with a file that only one can create, and takes over one
whose process is dead. Whoever holds writes its name beside and renews it: other machines may not see the lock itself.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput
from ihbench.files import removal

WAIT = 10.0  # s that a command waits for one that is about to end: its own workers, killed a moment ago
POLL = 0.1  # s
RENEWAL, STALE = 30.0, 600.0  # s between renewals of a name, and without one until it counts for nothing
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
OWNER, CLAIM = ".owner", ".claim"  # added to the lock's name: who holds it, and what stands for it without locks


@contextmanager
def locked(
    file: Path, advice: str, wait: float | None = None, on_wait: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Hold the lock `file`; its folder is made. Another holder is waited for `wait` seconds, `WAIT` without it, and
    `on_wait` is told of that once.

    Raises `BadInput` naming the holder, or why the folder cannot be written, with `advice` on what to do.
    """
    with ExitStack() as held:
        deadline = time.monotonic() + (WAIT if wait is None else wait)
        waiting = False
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            while (lock := _acquired(file)) is None:
                if time.monotonic() >= deadline:
                    raise BadInput(
                        f"{file.parent}: being written by {_holder(file)}; wait for it to end, or {advice}"
                    )
                if not waiting and on_wait is not None:
                    on_wait(f"waiting for {_holder(file)}, which is writing {file.parent}")
                waiting = True
                time.sleep(POLL)
        except OSError as error:
            raise BadInput(f"{file.parent}: cannot be written ({error.strerror or error}); {advice}") from error
        held.callback(lock.release)
        held.enter_context(_named(file.with_name(file.name + OWNER)))
        yield


def is_held(file: Path) -> bool:
    """Whether somebody holds the lock, as far as can be seen from here: the locks of some file systems are not seen
    on other machines, but who holds renews its name. In a place that may not be written nobody here does."""
    if not any(os.path.exists(file.with_name(file.name + end)) for end in ("", OWNER, CLAIM)):
        return False
    with suppress(OSError):
        if (lock := _acquired(file)) is None:
            return True
        lock.release()
    return _owner(file).get("host", socket.gethostname()) != socket.gethostname()


def _acquired(file: Path) -> Any:
    """The lock, which is held from now on, or None where somebody else holds it. Raises `OSError`."""
    with warnings.catch_warnings(action="ignore"):  # of a system that has no locks
        import filelock

    options: dict[str, Any] = {"timeout": 0, "thread_local": False}
    try:
        try:
            lock: Any = filelock.FileLock(str(file), fallback_to_soft=False, **options)
            lock.acquire()
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            lock = filelock.SoftFileLock(f"{file}{CLAIM}", **options)
            lock.acquire()
    except filelock.Timeout:
        return None
    return lock


@contextmanager
def _named(owner: Path) -> Iterator[None]:
    """Keep up a file that says that this process holds; never through a link, and not where the disk is full."""
    over = threading.Event()

    def renew() -> None:
        while not over.wait(RENEWAL):
            with suppress(OSError):
                os.utime(owner)

    removal.discard_file(owner)
    with suppress(OSError):
        with owner.open("x", encoding="utf-8") as stream:
            json.dump({"process": os.getpid(), "host": socket.gethostname()}, stream)
        threading.Thread(target=renew, name="lock", daemon=True).start()
    try:
        yield
    finally:
        over.set()
        removal.discard_file(owner)


def _owner(file: Path) -> dict[str, Any]:
    """Who says that it holds; empty for nobody, one that is no more, and words that nobody understands."""
    owner = file.with_name(file.name + OWNER)
    try:
        words = json.loads(owner.read_bytes()) if time.time() - owner.stat().st_mtime < STALE else {}
    except (OSError, ValueError):
        return {}
    return words if isinstance(words, dict) else {}


def _holder(file: Path) -> str:
    owner = _owner(file)
    if not isinstance(owner.get("process"), int):
        return "another process"
    elsewhere = "" if owner.get("host") == socket.gethostname() else f" on {str(owner.get('host'))[:64]!a}"
    return f"process {owner['process']}{elsewhere}"
