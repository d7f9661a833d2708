"""One writer at a time, in whatever place: the system's file locks, and claims where a file system has none.

The system's lock ends with its process however that ends. Some network and container file systems refuse it (errors
37, 38, 95); there a process claims the place with a file that only one can create. A claim whose process is dead is
taken over, and so is one of another machine that has not been renewed for `STALE` seconds.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from ihbench.errors import BadInput

WAIT = 10.0  # s that a command waits for one that is about to end: its own workers, killed a moment ago
POLL = 0.1  # s
RENEWAL, STALE = 30.0, 600.0  # s between renewals of a claim, and without one until it counts as abandoned
NO_LOCKS = {errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP}
OWNER = ".owner"  # added to the lock's name: who holds it; where there are no locks, this file is the lock

_HERE: dict[str, str] = {}


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
            while (release := _taken(file)) is None:
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
        held.callback(release)
        yield


def is_held(file: Path) -> bool:
    """Whether somebody holds the lock, as far as can be seen from here: the locks of some file systems are not seen
    on other machines, but who holds renews its name. In a place that may not be written nobody here does."""
    if not os.path.exists(file) and not os.path.exists(_owner_file(file)):
        return False
    try:
        lock = _system_lock(file)
        if not _acquired(lock):
            return True
        lock.release()
    except (OSError, NotImplementedError):
        return not _abandoned(file)
    with suppress(OSError):
        owner = _read_owner(file)
        return owner is not None and owner["place"] != _here()["place"] and not _abandoned(file)
    return False


def _taken(file: Path) -> Callable[[], None] | None:
    """What ends the hold that has begun, or None where somebody else holds. Raises `OSError`."""
    try:
        lock = _system_lock(file)
        if not _acquired(lock):
            return None
    except (OSError, NotImplementedError) as error:
        if isinstance(error, OSError) and error.errno not in NO_LOCKS:
            raise
        return _claimed(file)
    try:
        forget = _kept_up(_owner_file(file), _write_owner(_owner_file(file), os.O_TRUNC))
    except OSError:  # the lock holds without it
        return lock.release

    def release() -> None:
        forget()
        lock.release()

    return release


def _system_lock(file: Path) -> Any:
    """A lock of the operating system. Raises `NotImplementedError` where Python knows none."""
    with warnings.catch_warnings(action="ignore"):  # it has none of its own then, which is seen below
        import filelock

    if filelock.FileLock is filelock.SoftFileLock:
        raise NotImplementedError("no file locks on this system")
    # no fallback: the claims below know other machines and take over what was left
    return filelock.FileLock(str(file), timeout=0, thread_local=False, fallback_to_soft=False)


def _acquired(lock: Any) -> bool:
    import filelock

    try:
        lock.acquire()
    except filelock.Timeout:
        return False
    return True


# --- claims ---


def _claimed(file: Path) -> Callable[[], None] | None:
    """As `_taken`, where the file system has no locks."""
    claim = _owner_file(file)
    if claim.exists():
        if not _abandoned(file):
            return None
        _take_away(claim)
    try:
        mine = _write_owner(claim, os.O_EXCL)
    except FileExistsError:
        return None
    return _kept_up(claim, mine)


def _kept_up(owner: Path, mine: str) -> Callable[[], None]:
    """Renew what says that this process holds, for those who cannot see that it lives, until the result is called."""
    over = threading.Event()

    def renew() -> None:
        while not over.wait(RENEWAL):
            with suppress(OSError):
                os.utime(owner)

    threading.Thread(target=renew, name="lock", daemon=True).start()

    def forget() -> None:
        over.set()
        with suppress(OSError):
            if owner.read_text(encoding="utf-8") == mine:  # not one that took over
                owner.unlink()

    return forget


def _take_away(claim: Path) -> None:
    """Remove an abandoned claim, and not the one that somebody quicker has made in its place meanwhile."""
    with suppress(OSError):
        before = claim.read_bytes()
        away = claim.with_name(f"{claim.name}.{secrets.token_hex(4)}")
        os.rename(claim, away)
        if away.read_bytes() != before and not claim.exists():
            os.rename(away, claim)
        else:
            away.unlink()


def _abandoned(file: Path) -> bool:
    """Whether the owner's file tells of nobody, or of a process that is no more."""
    try:
        owner = _read_owner(file)
        if owner is not None and owner["place"] == _here()["place"]:
            return not _runs(owner["process"], owner["since"])
        return _now_there(file.parent) - _owner_file(file).stat().st_mtime > STALE
    except FileNotFoundError:
        return True
    except OSError:
        return False


def _now_there(folder: Path) -> float:
    """The time by the clock of the machine that stores the folder, where it can be had."""
    probe = folder / f".clock.{os.getpid()}.{secrets.token_hex(4)}.tmp"
    try:
        probe.touch()
        return probe.stat().st_mtime
    except OSError:
        return time.time()
    finally:
        with suppress(OSError):
            probe.unlink()


# --- who ---


def _owner_file(file: Path) -> Path:
    return file.with_name(file.name + OWNER)


def _write_owner(path: Path, how: int) -> str:
    """Say that this process holds; never through a link. Gives what was written."""
    words = json.dumps(
        {"process": os.getpid(), "since": _started(os.getpid()), **_here(), "hold": secrets.token_hex(4)}
    )
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | how | getattr(os, "O_NOFOLLOW", 0), 0o666)
    try:
        with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
            stream.write(words)
    except OSError:  # a full disk: without words it would say for long that somebody holds
        with suppress(OSError):
            path.unlink()
        raise
    return words


def _read_owner(file: Path) -> dict[str, Any] | None:
    """None for a file that is being written this moment, or damaged. Raises `OSError` where there is none."""
    try:
        owner = json.loads(_owner_file(file).read_bytes()[:10_000])
    except (ValueError, RecursionError):
        return None
    known = {"process": int, "since": str, "place": str, "host": str}
    if not isinstance(owner, dict) or any(not isinstance(owner.get(key), kind) for key, kind in known.items()):
        return None
    return owner


def _holder(file: Path) -> str:
    try:
        owner = _read_owner(file)
    except OSError:
        owner = None
    if owner is None:
        return "another process"
    elsewhere = "" if owner["place"] == _here()["place"] else f" on {owner['host'][:64]!a}"
    return f"process {owner['process']}{elsewhere}"


def _here() -> dict[str, str]:
    """This machine, and what tells its process numbers from those of another boot or container."""
    if not _HERE:
        marks = [socket.gethostname()]
        with suppress(OSError):
            marks.append(Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip())
        with suppress(OSError):
            marks.append(os.readlink("/proc/self/ns/pid"))
        _HERE.update(host=marks[0], place=" ".join(marks))
    return _HERE


def _runs(process: int, since: str) -> bool:
    """Whether that very process is alive: numbers are given again."""
    if os.name == "nt":  # there a signal 0 would end it; and there are locks
        return True
    try:
        os.kill(process, 0)
    except PermissionError:
        pass
    except (OSError, OverflowError):
        return False
    return process > 0 and since == _started(process)


def _started(process: int) -> str:
    """When a process began, in the system's own unit; empty where the system does not say."""
    try:
        about = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    fields = about.rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]  # one that is dead and not yet cleared away
