"""Asked to end by the system, killed, orphaned: what is recorded, and who is still running afterwards."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest

from ihbench.clock import interruption
from ihbench.clock.interruption import Terminated, interruptible, undisturbed
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files.atomic import read_json
from ihbench.record.index import Index
from ihbench.record.results import read_result
from ihbench.record.store import KILLED, RunFolder
from ihbench.runner.recorded_run import RecordedRun, recorded
from tests.record.test_store import IDENTITY

# a run that waits for its end, as `ihbench run` makes one
WAITS = """\
import sys, time
from pathlib import Path
from ihbench import cli; from ihbench.runner import recorded_run
from tests.record.test_store import IDENTITY

class Waits(recorded_run.RecordedRun):
    def work(self):
        print("works", flush=True)
        time.sleep(600)

def command(argv):
    from ihbench.clock.progress import Progress
    make = lambda folder: Waits(folder, Progress.silent())
    recorded_run.recorded(Path(sys.argv[1]), IDENTITY, {"standin": "", "variant": ""}, False, make)

cli._run = command
sys.exit(cli.main(["run"]))
"""

# a command with two workers, each of which holds a run's lock
WORKERS = """\
import sys
from pathlib import Path
from ihbench.runner import executor
from ihbench.runner.executor import Cell, run_cells
from ihbench.clock.progress import Progress

def child(connection, request, source, scene, threads):
    from tests.clock.test_interruption import hold
    hold(Path(request), scene)

executor._child = child
if __name__ == "__main__":
    run_cells([Cell(s, sys.argv[1], None, s) for s in ("a", "b")], 2, 1, Progress.silent())
"""


def hold(runs, scene):
    """A worker's life: it writes a run until it is told to end."""

    class Waits(RecordedRun):
        def work(self):
            (self.folder.path / f"worker-{os.getpid()}").touch()
            while True:
                time.sleep(0.1)

    interruption.end_with_parent()
    identity = replace(IDENTITY, scene=scene)
    recorded(runs, identity, {}, False, lambda folder: Waits(folder, Progress.silent()))


def started(code, folder, number=signal.SIGINT, handler=signal.default_int_handler):
    """A process of its own that begins with this handler of one signal."""
    return subprocess.Popen(
        [sys.executable, *code, str(folder)],
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(number, handler),
    )


def until(condition, seconds=60):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def only_record(runs):
    (file,) = runs.glob("*/run.json")
    return read_json(file)["outcome"]


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT", "SIGUSR1", "SIGXCPU"])
def test_a_run_asked_to_end_records_that_and_the_status_says_by_what(tmp_path, name):
    number = getattr(signal, name)
    with started(["-c", WAITS], tmp_path) as run:
        assert run.stdout.readline() == "works\n"  # pyright: ignore
        run.send_signal(number)
        _, said = run.communicate(timeout=60)
    assert run.returncode == 128 + number
    how = "interrupted" if name == "SIGINT" else f"interrupted by {name}"
    assert said == f"ihbench: {how}; the same command continues where it stopped\n"
    record = only_record(tmp_path)
    assert record["status"] == "interrupted"
    assert record["reason"] == ("interrupted by the user" if name == "SIGINT" else f"interrupted by {name}")


@pytest.mark.parametrize("before", ["", "running", "done"])
@pytest.mark.parametrize("where", ["save", "lock", "make"])
@pytest.mark.parametrize("error", [Terminated(signal.SIGTERM), BadInput("disk full")])
def test_what_ends_a_run_before_its_work_begins_is_recorded_too(tmp_path, monkeypatch, before, where, error):
    """Between the first record and the guarded work lie the lock, its wait, and what makes the run ready. A finished
    run that a forced one would have replaced is there again."""
    if before:
        (RunFolder.create(tmp_path, IDENTITY).path / "scores.jsonl").write_text(before)
        RunFolder.create(tmp_path, IDENTITY).set_status(before)

    def ends(*words):
        raise error

    if where != "make":
        monkeypatch.setattr(RunFolder, where, ends)
    with pytest.raises(type(error)):
        recorded(tmp_path, IDENTITY, {}, before == "done", ends)
    monkeypatch.undo()
    stopped = isinstance(error, Terminated)
    if before == "done" and (stopped or where != "lock"):  # somebody else's hold of the lock leaves all to them
        (scores,) = tmp_path.glob("*/scores.jsonl")
        assert (only_record(tmp_path)["status"], scores.read_text()) == ("done", "done")
        assert not list((tmp_path / "replaced").glob("*"))
    elif (before, where) == ("", "save"):
        assert not list(tmp_path.rglob("run.json"))
    else:
        outcome = {
            "make": ("interrupted", "interrupted by SIGTERM") if stopped else ("failed", "disk full"),
            "lock": ("interrupted", "interrupted by SIGTERM") if stopped else ("running", ""),
            "save": ("running", ""),
        }
        assert (only_record(tmp_path)["status"], only_record(tmp_path)["reason"]) == outcome[where]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("made_of_it", [SystemError("returned a result with an exception set"), None])
def test_what_libraries_in_c_make_of_an_interruption_is_one(tmp_path, number, made_of_it):
    """numba's unpickling makes a SystemError of it; callbacks, such as llvmlite's, print and forget it."""

    class Compiles(RecordedRun):
        def work(self):
            try:
                os.kill(os.getpid(), number)
                time.sleep(5)
            except KeyboardInterrupt:
                if made_of_it is not None:
                    raise made_of_it from None
            with self.ledger.stage("fit"):
                pytest.fail("the run went on")

    with pytest.raises(KeyboardInterrupt):
        recorded(tmp_path, IDENTITY, {}, False, lambda folder: Compiles(folder, Progress.silent()))
    assert only_record(tmp_path)["status"] == "interrupted"
    assert interruption.asked() is None


def test_a_forced_rival_may_make_room_between_the_record_and_the_lock(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    (run.path / "run.json").unlink()
    with run.lock():
        assert only_record(tmp_path)["status"] == "running"


def test_a_hang_up_that_nohup_ignores_stays_ignored(tmp_path):
    with started(["-c", WAITS], tmp_path, signal.SIGHUP, signal.SIG_IGN) as run:
        assert run.stdout.readline() == "works\n"  # pyright: ignore
        run.send_signal(signal.SIGHUP)
        time.sleep(0.3)
        assert run.poll() is None
        run.terminate()
        run.communicate(timeout=60)
    assert only_record(tmp_path)["reason"] == "interrupted by SIGTERM"


def test_a_killed_run_is_seen_as_interrupted_and_a_running_one_as_running(tmp_path):
    with started(["-c", WAITS], tmp_path) as run:
        assert run.stdout.readline() == "works\n"  # pyright: ignore
        (folder,) = (path.parent for path in tmp_path.glob("*/run.json"))
        assert read_result(folder).status == "running"
        assert [row.status for row in Index(tmp_path).query()] == ["running"]
        run.kill()
        run.communicate()
    assert only_record(tmp_path)["status"] == "running"  # what it could say last
    seen = read_result(folder)
    assert (seen.status, seen.reason) == ("interrupted", KILLED)
    assert [row.status for row in Index(tmp_path).query(status="interrupted")] == ["interrupted"]
    assert Index(tmp_path).query(status="running") == []


def alive(number):
    try:
        os.kill(number, 0)
    except OSError:
        return False
    with open(f"/proc/{number}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] not in "ZX"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_workers_end_with_the_one_who_started_them_and_record_it(tmp_path, how):
    (tmp_path / "main.py").write_text(WORKERS)
    runs = tmp_path / "runs"
    with started([str(tmp_path / "main.py")], runs) as command:
        until(lambda: len(list(runs.glob("*/worker-*"))) == 2 or command.poll() is not None)
        workers = [int(path.name.partition("-")[2]) for path in runs.glob("*/worker-*")]
        assert len(workers) == 2, command.stderr.read()  # pyright: ignore
        command.send_signal(how)
        command.communicate(timeout=60)
    until(lambda: not any(map(alive, workers)))
    records = [read_json(file) for file in runs.glob("*/run.json")]
    assert [(record["outcome"]["status"], record["outcome"]["reason"]) for record in records] == [
        ("interrupted", "interrupted by SIGTERM")
    ] * 2


def test_handlers_come_back_and_those_of_others_stay():
    before = {name: signal.getsignal(getattr(signal, name)) for name in ("SIGTERM", "SIGHUP", "SIGINT")}
    with interruptible(), interruptible():
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        with pytest.raises(Terminated, match="interrupted by SIGTERM"):
            signal.raise_signal(signal.SIGTERM)
    interruption.check()  # dealt with: nothing of it is left for later
    assert {name: signal.getsignal(getattr(signal, name)) for name in before} == before
    heard = []
    signal.signal(signal.SIGUSR2, lambda number, frame: heard.append(number))
    try:
        with interruptible():
            signal.raise_signal(signal.SIGUSR2)
    finally:
        signal.signal(signal.SIGUSR2, signal.SIG_DFL)
    assert heard == [signal.SIGUSR2]


def test_other_threads_change_nothing():
    found = []

    def look():
        with interruptible(), undisturbed():
            found.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert found == [signal.SIG_DFL]


def test_a_record_once_begun_is_written():
    steps = []

    def record():
        with interruptible(), undisturbed():
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)
            steps.append("written")
        steps.append("never")

    with pytest.raises(Terminated):
        record()
    assert steps == ["written"]


def test_a_forked_process_ends_by_the_signal_itself():
    code = (
        "import os, signal; from ihbench.clock.interruption import interruptible\n"
        "with interruptible():\n"
        "    child = os.fork()\n"
        "    if child == 0: signal.raise_signal(signal.SIGTERM); os._exit(7)\n"
        "    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"-{int(signal.SIGTERM)}\n", "")
