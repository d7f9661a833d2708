"""One writer at a time: with the system's locks, without them, after kills, across machines."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from ihbench.errors import BadInput
from ihbench.files import locks
from ihbench.files.locks import is_held, locked

# errors of network file systems, of old container ones, of some FUSE ones; and a system that has locks
KINDS = [0, errno.ENOLCK, errno.ENOSYS, errno.ENOTSUP]
WITHOUT = (
    "import errno, fcntl, os\ndef refuse(*_): raise OSError({number}, os.strerror({number}))\nfcntl.flock = refuse\n"
)
HOLD = (
    "import sys, time; from pathlib import Path; from ihbench.files.locks import locked\n"
    "with locked(Path(sys.argv[1]), ''):\n"
    "    print('held', flush=True); sys.stdin.read()"
)


@pytest.fixture(params=KINDS, ids=["locks", "ENOLCK", "ENOSYS", "ENOTSUP"])
def kind(request, monkeypatch):
    """Locks, or the error that a place without them answers with."""
    monkeypatch.setattr(locks, "WAIT", 0.0)
    if request.param:

        def refuse(*_):
            raise OSError(request.param, os.strerror(request.param))

        monkeypatch.setattr(fcntl, "flock", refuse)
    return request.param


@pytest.fixture
def file(tmp_path):
    return tmp_path / "new" / "run" / "lock"


def rival(file, kind):
    """A process that holds until its input ends or it is killed."""
    code = (WITHOUT.format(number=kind) if kind else "") + HOLD
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(file)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def grow_old(owner):
    long_ago = time.time() - 2 * locks.STALE
    os.utime(owner, (long_ago, long_ago))


def refused(file):
    with pytest.raises(BadInput, match="being written by") as error, locked(file, "go elsewhere"):
        pass
    assert "\n" not in str(error.value)
    return str(error.value)


def test_one_at_a_time_and_released_by_an_error(file, kind):
    def fail():
        with locked(file, ""):
            assert is_held(file)
            assert f"process {os.getpid()}; wait for it to end, or go elsewhere" in refused(file)
            raise ZeroDivisionError

    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            fail()
        assert not is_held(file)
    assert [path.name for path in file.parent.iterdir()] in (["lock"], [])


def test_another_process_is_named_and_a_dead_one_is_not_in_the_way(file, kind):
    with rival(file, kind) as process:
        assert is_held(file)
        assert f"process {process.pid};" in refused(file)
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not is_held(file)
    with locked(file, ""):
        assert is_held(file)


def test_one_that_is_about_to_end_is_waited_for(file, kind):
    told = []
    with rival(file, kind) as process:

        def end():
            while not told:
                time.sleep(0.01)
            process.kill()
            process.wait()

        thread = threading.Thread(target=end)
        thread.start()
        with locked(file, "", wait=60, on_wait=told.append):
            thread.join()
    assert told == [f"waiting for process {process.pid}, which is writing {file.parent}"]


@pytest.mark.parametrize("kind", [0, errno.ENOLCK], indirect=True)
def test_another_machine_is_believed_while_it_renews_its_claim(file, kind, monkeypatch):
    """Also where there are locks, which may not be seen on other machines."""
    monkeypatch.setattr(locks, "RENEWAL", 0.01)
    owner = file.with_name("lock.owner")
    with locked(file, ""):
        os.utime(owner, (0, 0))
        while owner.stat().st_mtime == 0:
            time.sleep(0.01)
        monkeypatch.setattr(locks.socket, "gethostname", lambda: "other")
        assert is_held(file)
        assert "on '" in refused(file)
        words = owner.read_text()
    owner.write_text(words)  # killed there; the lock is free
    assert is_held(file)
    grow_old(owner)
    assert not is_held(file)
    with locked(file, ""):
        pass


def test_a_place_that_takes_nothing_is_one_sentence(file, kind, monkeypatch):
    def denied(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", denied)
    with (
        pytest.raises(BadInput, match=r"cannot be written \(.*\); go elsewhere") as error,
        locked(file, "go elsewhere"),
    ):
        pass
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("place", ["/proc/nope/lock", "/sys/nope/lock"])
def test_impossible_places(place):
    from pathlib import Path

    with pytest.raises(BadInput, match="cannot be written"), locked(Path(place), ""):
        pass
    assert not is_held(Path(place))


def test_without_the_module_that_windows_lacks(file):
    """Nothing but a lock itself asks for it, and a lock does without."""
    code = (
        "import sys; sys.modules['fcntl'] = None\n"
        "import ihbench.record.store, ihbench.record.index, ihbench.runner.recorded_run\n"
        "import ihbench.data.prepare, ihbench.runner.executor\n" + HOLD
    )
    done = subprocess.run([sys.executable, "-c", code, str(file)], input="", capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("held\n", "")


def test_a_lock_never_writes_through_a_link(file, tmp_path):
    (tmp_path / "precious").write_text("x")
    file.parent.mkdir(parents=True)
    file.with_name("lock.owner").symlink_to(tmp_path / "precious")
    with locked(file, ""):
        pass
    assert (tmp_path / "precious").read_text() == "x"
