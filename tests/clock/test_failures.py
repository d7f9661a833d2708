"""Whatever ends a command: one line, the documented exit status, no traceback, and with --json one object."""

import errno
import json
import os
import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from ihbench import cli, registry
from ihbench.errors import Diverged

ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith(("IHBENCH_", "PYTHON"))}


@pytest.fixture
def ends_with(monkeypatch, bench, tmp_path):
    """A command that raises; what it left behind."""

    def command(error, *words):
        def fail(_argv):
            raise error

        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        monkeypatch.setattr("ihbench.commands.list.main", fail)
        outcome = bench("list", *words)
        assert "Traceback" not in outcome.err
        assert len(outcome.err.splitlines()) == 1
        return outcome

    return command


class OutOfMemoryError(RuntimeError):
    """torch's, by its name."""


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (OSError(errno.EIO, "Input/output error", "/data/x.png"), 2, "input/output error: /data/x.png; check"),
        (OSError(errno.EMFILE, "Too many open files"), 2, "too many open files; check"),
        (PermissionError(errno.EACCES, "Permission denied", b"/a", None, "/b"), 2, "permission denied: /a -> /b"),
        (OSError("libjpeg.so: cannot open"), 2, "libjpeg.so: cannot open"),
        (MemoryError(), 2, "out of memory (MemoryError)"),
        (
            OutOfMemoryError("CUDA: no\nmore"),
            2,
            "out of memory (OutOfMemoryError: CUDA: no more)",
        ),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), 2, "out of memory"),
        (RuntimeError("CUDA error: an illegal memory access"), 2, "try --device cpu"),
        (UnicodeEncodeError("ascii", "ä", 0, 1, "no such sign"), 2, "text that cannot be read or written"),
        (SystemExit("gone\nwrong"), 2, "gone wrong"),
        (Diverged(3, "loss is nan"), 1, "diverged at step 3: loss is nan"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (
            RecursionError("too deep"),
            3,
            "a fault of ihbench, not of yours: RecursionError: too deep; the traceback",
        ),
        (KeyError("a\nb"), 3, "a fault of ihbench, not of yours: KeyError"),
        (AssertionError(), 3, "a fault of ihbench, not of yours: AssertionError; "),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_kind_of_failure_is_one_line(ends_with, error, status, words, tmp_path):
    outcome = ends_with(error, "--json")
    assert outcome.status == status
    assert words in outcome.err
    told = json.loads(outcome.out)
    assert (set(told), f"ihbench: {told['error']}\n") == ({"status", "error"}, outcome.err)
    kept = list(tmp_path.glob("ihbench-*-traceback.txt"))
    assert len(kept) == (status == 3)
    assert all(str(path) in outcome.err and "in fail" in path.read_text() for path in kept)


def test_the_traceback_is_printed_when_asked_for(monkeypatch, bench, capsys):
    monkeypatch.setattr("ihbench.commands.list.main", lambda _: 1 / 0)
    with bench.in_its_world():
        monkeypatch.setenv("IHBENCH_DEBUG", "1")
        assert cli.main(["list"]) == 3
    assert "Traceback (most recent call last)" in capsys.readouterr().err


OTHERS = {
    "raises": "raise OSError('no such library\\n at all')",
    "exits": "raise SystemExit(4)",
    "not_whole": "",
    "fails": "def main(argv): return [][1]",
    "leaves": "def main(argv): raise SystemExit('not today')",
}
SPEC = """from ihbench.scene.method_spec import Command, MethodSpec
commands = {"NAME": Command("a command", "others_NAME.command:main")}
SPEC = MethodSpec(name="others", title="", summary="", method="ihbench.x:X", profiles={}, commands=commands)
"""


@pytest.mark.parametrize(
    ("name", "status", "words"),
    [
        ("raises", 2, "others_raises.command:main cannot be loaded: OSError('no such library\\n at all')"),
        ("exits", 2, "others_exits.command:main cannot be loaded: SystemExit(4)"),
        ("not_whole", 2, "others_not_whole.command:main cannot be loaded: AttributeError"),
        ("fails", 3, "a fault of the package others_fails, not of yours: IndexError"),
        ("leaves", 2, "not today"),
    ],
)
def test_commands_of_other_packages_that_misbehave(name, status, words, bench, monkeypatch, tmp_path):
    (tmp_path / f"others_{name}").mkdir()
    (tmp_path / f"others_{name}" / "command.py").write_text(OTHERS[name])
    (tmp_path / f"others_{name}" / "spec.py").write_text(SPEC.replace("NAME", name))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    found = registry._found
    point = EntryPoint("others", f"others_{name}.spec:SPEC", registry.GROUPS["method"])
    monkeypatch.setattr(
        registry, "_found", lambda kind: found(kind) | ({"others": point} if kind == "method" else {})
    )
    outcome = bench(name)
    assert (outcome.status, len(outcome.err.splitlines())) == (status, 1)
    assert words in outcome.err
    assert (bench("--help").status, bench("--help").err) == (0, "")


# ------------------------------------------------------------------------------------- stdout as it may be


def shell(line, **variables):
    """`line` in a shell, with $IHBENCH as the command; nothing of the terminal it is run from."""
    environment = ENVIRONMENT | {"IHBENCH": f"{sys.executable} -m ihbench"} | variables
    done = subprocess.run(["bash", "-c", line], capture_output=True, env=environment, timeout=300, check=False)
    return done.returncode, done.stdout, done.stderr.decode()


def test_json_stays_one_object_when_something_fails_after_the_result(monkeypatch, bench):
    def late(_argv):
        print(json.dumps({"result": 1}))
        raise OSError(errno.EIO, "Input/output error", "/x")

    monkeypatch.setattr("ihbench.commands.list.main", late)
    outcome = bench("list", "--json")
    assert (outcome.status, json.loads(outcome.out)) == (2, {"result": 1})


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_an_encoding_that_lacks_signs_loses_no_number(encoding):
    status, out, err = shell("$IHBENCH list --json && $IHBENCH list metrics", PYTHONIOENCODING=encoding)
    assert (status, err) == (0, "")
    first, rest = out.decode(encoding).split("\n", 1)
    assert "7×7" in json.dumps(json.loads(first), ensure_ascii=False)
    assert ("7×7" if encoding != "ascii" else "7\\u00d77") in rest


def test_a_name_that_is_no_text_is_answered():
    status, _, err = shell("$IHBENCH $'\\xff'")
    assert (status, err.count("\n")) == (2, 1)
    assert "unknown command '\\udcff'" in err


@pytest.mark.parametrize(
    ("line", "status", "words"),
    [
        ("$IHBENCH list metrics --json > /dev/full", 2, "standard output cannot be written (no space"),
        ("$IHBENCH run --help > /dev/full", 2, "standard output cannot be written"),
        ("$IHBENCH nosuch --json > /dev/full", 2, "unknown command"),
        ("$IHBENCH nosuch 2> /dev/full", 2, ""),
        ("$IHBENCH list >&-", 0, ""),
        ("$IHBENCH list <&- >&- 2>&-", 0, ""),
        ("$IHBENCH nosuch --json 2>&- | grep -q 'bad input'; exit ${PIPESTATUS[0]}", 2, ""),
        ("set -o pipefail; $IHBENCH list metrics | true", 0, ""),
        ("set -o pipefail; $IHBENCH run --help | true", 0, ""),
    ],
)  # fmt: skip
def test_stdout_that_is_full_closed_or_not_read(line, status, words):
    told, _, err = shell(line)
    assert told == status
    assert err.count("\n") == bool(words), err
    assert words in err
