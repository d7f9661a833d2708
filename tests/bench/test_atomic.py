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

from ihbench import atomic
from ihbench.errors import BadInput


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
        "import resource, signal, sys; from pathlib import Path; from ihbench import atomic, errors\n"
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
        "import os, signal, sys; from pathlib import Path; from ihbench import atomic\n"
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
