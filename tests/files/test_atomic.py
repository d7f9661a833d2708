"""A file is the old one or the new one, whatever goes wrong; JSON comes back as it went in and parses anywhere."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.errors import BadInput
from ihbench.files import atomic


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_writes_replace_and_make_folders(tmp_path):
    path = tmp_path / "a" / "b.txt"
    atomic.write_text(path, "old")
    atomic.write_text(path, "newer °")
    assert path.read_bytes() == "newer °".encode()
    assert names(path.parent) == ["b.txt"]


@pytest.mark.parametrize(("number", "words"), [(errno.ENOSPC, "disk full"), (errno.EROFS, "read-only file system")])
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch, number, words, step):
    path = tmp_path / "run.json"
    atomic.write_text(path, "old")

    def fails(*arguments):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, step, fails)
    with pytest.raises(BadInput, match=f"{words} while writing .*run.json") as caught:
        atomic.write_text(path, "new")
    monkeypatch.undo()
    assert "\n" not in str(caught.value)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["run.json"]


def test_a_real_limit_on_file_size(tmp_path):
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from ihbench import errors; from ihbench.files import atomic\n"
        "path = Path(sys.argv[1]); atomic.write_bytes(path, b'old')\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "try: atomic.write_bytes(path, bytes(100_000))\n"
        "except errors.BadInput as error: print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "f")], capture_output=True, text=True, check=True
    )
    assert "larger than allowed" in done.stdout
    assert (tmp_path / "f").read_bytes() == b"old"
    assert names(tmp_path) == ["f"]


def test_killed_while_writing_leaves_the_old_file(tmp_path):
    path = tmp_path / "f"
    path.write_text("old")
    code = (
        "import os, signal, sys; from pathlib import Path; from ihbench.files import atomic\n"
        "os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)\n"
        "atomic.write_text(Path(sys.argv[1]), 'new')"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], check=False)
    assert done.returncode == -signal.SIGKILL
    assert path.read_text() == "old"


def test_other_errors_are_not_disguised(tmp_path, monkeypatch):
    def fails(*arguments):
        raise OSError(errno.EIO, "broken disk")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="broken disk"):
        atomic.write_text(tmp_path / "f", "x")
    assert names(tmp_path) == []


def test_a_folder_or_a_file_in_the_way_is_bad_input(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("x")
    with pytest.raises(BadInput, match="a folder stands where"):
        atomic.write_text(tmp_path / "folder", "x")
    with pytest.raises(BadInput, match="a file stands where"):
        atomic.write_text(tmp_path / "file" / "inner", "x")
    assert names(tmp_path) == ["file", "folder"]


# --- what is no regular file ---


def write_through(path: str, to: object) -> subprocess.CompletedProcess:
    """`write_text` in a process of its own, with prints before and after, as a command has them."""
    code = (
        "import sys; from pathlib import Path; from ihbench.files import atomic\n"
        "print('before'); atomic.write_text(Path(sys.argv[1]), 'written\\n'); print('after')"
    )
    return subprocess.run([sys.executable, "-c", code, path], stdout=to, stderr=subprocess.PIPE, text=True)  # pyright: ignore


@pytest.mark.parametrize("path", ["/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "link"])
def test_the_standard_output_is_written_into(tmp_path, path):
    (tmp_path / "link").symlink_to("/dev/stdout")
    path = str(tmp_path / path)
    assert write_through(path, subprocess.PIPE).stdout == "before\nwritten\nafter\n"
    (tmp_path / "all").write_text("earlier\n")
    with open(tmp_path / "all", "a") as file:  # as `>>` does
        assert write_through(path, file).returncode == 0
    assert (tmp_path / "all").read_text() == "earlier\nbefore\nwritten\nafter\n"
    assert (tmp_path / "link").is_symlink()
    assert names(tmp_path) == ["all", "link"]


def test_a_device_stays_one(tmp_path):
    about = os.stat("/dev/null")
    atomic.write_text(Path("/dev/null"), "x")
    (tmp_path / "null").symlink_to("/dev/null")
    atomic.write_text(tmp_path / "null", "x")
    with pytest.raises(BadInput, match="disk full while writing /dev/full"):
        atomic.write_text(Path("/dev/full"), "x")
    assert (os.stat("/dev/null").st_rdev, os.stat("/dev/null").st_ino) == (about.st_rdev, about.st_ino)
    assert (tmp_path / "null").is_symlink()


def test_a_pipe_is_written_into(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with subprocess.Popen(["cat", str(tmp_path / "pipe")], stdout=subprocess.PIPE, text=True) as reader:
        atomic.write_text(tmp_path / "pipe", "through")
        assert reader.communicate()[0] == "through"
    assert (tmp_path / "pipe").is_fifo()
    assert names(tmp_path) == ["pipe"]


def test_a_disk_and_a_socket_are_left(tmp_path, monkeypatch):
    import socket

    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        with pytest.raises(BadInput, match="nobody reads there"):
            atomic.write_text(tmp_path / "s", "x")
    (tmp_path / "disk").write_text("partition table")
    monkeypatch.setattr(atomic, "is_stream", lambda path: True)
    monkeypatch.setattr(atomic.stat, "S_ISBLK", lambda mode: True)
    with pytest.raises(BadInput, match="never written into; name a file"):
        atomic.write_text(tmp_path / "disk", "x")
    assert (tmp_path / "disk").read_text() == "partition table"


def test_links_are_followed_and_stay(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("old")
    (tmp_path / "link").symlink_to(Path("there") / "file")
    (tmp_path / "second").symlink_to("link")
    (tmp_path / "dangling").symlink_to(tmp_path / "new" / "folder" / "file")
    atomic.write_text(tmp_path / "second", "new")
    atomic.write_text(tmp_path / "dangling", "made")
    assert (tmp_path / "there" / "file").read_text() == "new"
    assert (tmp_path / "new" / "folder" / "file").read_text() == "made"
    assert all((tmp_path / name).is_symlink() for name in ("link", "second", "dangling"))
    (tmp_path / "circle").symlink_to("circle")
    (tmp_path / "folder").symlink_to("there")
    with pytest.raises(BadInput, match="links that lead in a circle"):
        atomic.write_text(tmp_path / "circle", "x")
    with pytest.raises(BadInput, match="a folder stands where"):
        atomic.write_text(tmp_path / "folder", "x")
    assert names(tmp_path / "there") == ["file"]


@pytest.mark.parametrize("mode", [0o600, 0o640, 0o755, 0o666])
def test_a_file_keeps_its_mode_and_a_new_one_obeys_the_umask(tmp_path, mode):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(mode)
    atomic.write_text(path, "new")
    assert path.stat().st_mode & 0o7777 == mode
    before = os.umask(0o027)
    try:
        atomic.write_text(tmp_path / "new", "x")
    finally:
        os.umask(before)
    assert (tmp_path / "new").stat().st_mode & 0o7777 == 0o640


def test_what_replaces_a_private_file_is_private_from_the_start(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")
    path.chmod(0o600)
    with atomic.replaced(path) as temporary:
        assert temporary.stat().st_mode & 0o777 == 0o600


def test_other_names_of_a_file_keep_what_they_had(tmp_path):
    (tmp_path / "run").write_text("old")
    os.link(tmp_path / "run", tmp_path / "backup")
    atomic.write_text(tmp_path / "run", "new")
    assert [(tmp_path / name).read_text() for name in ("run", "backup")] == ["new", "old"]


def test_a_file_whose_right_to_write_was_taken_away_is_left(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write whatever the mode
    with pytest.raises(BadInput, match="permission denied while writing"):
        atomic.write_text(path, "new")
    assert path.read_text() == "old"


@pytest.mark.parametrize("fails", [False, True])
def test_a_file_that_is_a_mount_of_its_own_is_written_in_place(tmp_path, monkeypatch, fails):
    path = tmp_path / "file"
    path.write_text("old")

    def busy(*_):
        if fails:
            Path.write_bytes, before = (lambda *a: setattr(Path, "write_bytes", before) or full()), Path.write_bytes
        raise OSError(errno.EBUSY, "busy")

    def full():
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "replace", busy)
    if fails:
        with pytest.raises(BadInput, match="disk full"):
            atomic.write_text(path, "new")
    else:
        atomic.write_text(path, "new")
    assert path.read_text() == ("old" if fails else "new")
    assert names(tmp_path) == ["file"]


@pytest.mark.parametrize("path", ["", ".", "/", "/proc/nope/file", "/proc/version", "/sys/x", "x" * 300])
def test_impossible_places_are_one_line(path):
    with pytest.raises(BadInput) as refused:
        atomic.write_text(Path(path), "x")
    assert "\n" not in str(refused.value)


# --- JSON ---

VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text()
    | st.sampled_from(["nan", "inf", "-inf", "'nan", "''-inf", "NaN", "\ud800", "\u2028"]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


def same(a, b) -> bool:
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return isinstance(b, list) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


def refuse(constant: str):
    raise AssertionError(f"{constant} is not strict JSON")


@given(VALUES)
@settings(deadline=None, derandomize=True, max_examples=300)
def test_json_comes_back_as_it_went_in_and_is_strict(value):
    text = json.dumps(atomic.encode(value), allow_nan=False)
    json.loads(text, parse_constant=refuse)
    assert same(value, atomic.decode(json.loads(text)))


def test_files_of_json_come_back(tmp_path):
    value = {"psnr": math.inf, "ssim": math.nan, "name": "nan", "odd": "\ud800 \u2028 ×"}
    atomic.write_json(tmp_path / "a.json", value)
    assert same(value, atomic.read_json(tmp_path / "a.json"))
    atomic.write_json_lines(tmp_path / "a.jsonl", [value, [1], value])
    assert all(map(same, [value, [1], value], atomic.read_json_lines(tmp_path / "a.jsonl")))
    (tmp_path / "a.json").read_bytes().decode("ascii")
    atomic.write_json_lines(tmp_path / "a.jsonl", [])
    assert atomic.read_json_lines(tmp_path / "a.jsonl") == []


def test_numpy_paths_and_dataclasses_are_unpacked():
    @dataclass(frozen=True)
    class Config:
        rate: np.float32
        steps: tuple[int, ...]

    value = {"config": Config(np.float32(0.5), (1, 2)), "array": np.array([1.0, np.inf]), "path": Path("a/b")}
    assert atomic.encode({**value, "flag": np.bool_(True), "count": np.int64(3)}) == {
        "config": {"rate": 0.5, "steps": [1, 2]}, "array": [1.0, "inf"], "path": "a/b", "flag": True, "count": 3,
    }  # fmt: skip


@pytest.mark.parametrize("value", [{1: 2}, {"a": object()}, {"a": {1, 2}}])
def test_what_json_lacks_is_refused_before_anything_is_written(tmp_path, value):
    with pytest.raises(TypeError):
        atomic.write_json(tmp_path / "a.json", value)
    assert names(tmp_path) == []


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 200_000, b"1" * 10_000])
def test_damaged_json_is_one_clear_line(tmp_path, content):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=r"a\.json") as caught:
        atomic.read_json(path)
    assert "\n" not in str(caught.value)


def test_damaged_json_lines_name_the_line(tmp_path):
    (tmp_path / "a.jsonl").write_text('{"a": 1}\n{"a": \n')
    with pytest.raises(BadInput, match="line 2"):
        atomic.read_json_lines(tmp_path / "a.jsonl")


def test_a_missing_file_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match=r"nothing\.json"):
        atomic.read_json(tmp_path / "nothing.json")
