"""~ and $VARIABLES as a shell takes them; what cannot be meant is one line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from ihbench.datasets.plain.plain_scene import PlainScene
from ihbench.datasets.zju_mocap.original import ZjuMocap
from ihbench.errors import BadInput
from ihbench.files.paths import user_path


def test_what_a_shell_would_make_of_it(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DATA", str(tmp_path / "d"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "$DATA").mkdir()
    assert user_path("a/b") == Path("a/b")
    assert user_path("~/x/") == tmp_path / "x"
    assert user_path(Path("${DATA}/x")) == tmp_path / "d" / "x"
    assert user_path("$DATA") == Path("$DATA")  # it is there


@pytest.mark.parametrize(
    ("named", "words"),
    [("~nobody_of_that_name/x", "no user 'nobody_of_that_name'"), ("$NOT_SET/x", "$NOT_SET is not")],
)
@pytest.mark.parametrize("read", [user_path, PlainScene, ZjuMocap])
def test_what_cannot_be_meant(named, words, read, monkeypatch):
    monkeypatch.delenv("NOT_SET", raising=False)
    with pytest.raises(BadInput) as error:
        read(named)
    assert words in str(error.value)


KERNELS = """
import os, sys
real = os.access
os.access = lambda path, *a: False if "ihbench" in str(path) else real(path, *a)  # a read-only installation
import ihbench
print(os.environ.get("NUMBA_CACHE_DIR"))
"""


@pytest.mark.parametrize("with_cache", [True, False])
def test_kernels_are_kept_where_something_may_be_written(with_cache, tmp_path):
    """Beside the sources, in the user's cache, in the bench's, else in a private temporary folder."""

    def place(**variables):
        environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        command = [sys.executable, "-c", KERNELS]
        done = subprocess.run(command, env=environment | variables, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    (tmp_path / "temporary").mkdir()
    assert place(HOME=str(tmp_path)) == "None"
    variables = {"IHBENCH_CACHE": str(tmp_path / "own")} if with_cache else {}
    found = place(HOME="/proc/nope", TMPDIR=str(tmp_path / "temporary"), **variables)
    if with_cache:
        assert found == str(tmp_path / "own" / "kernels")
    else:
        assert Path(found).parent == tmp_path / "temporary"
        assert Path(found).stat().st_mode & 0o077 == 0
        Path(found).chmod(0o777)  # somebody else may have put code there
        again = place(HOME="/proc/nope", TMPDIR=str(tmp_path / "temporary"))
        assert again != found
