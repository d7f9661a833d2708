"""Shared by the end-to-end tests: a tiny protocol, the stand-in pictures it reads, the command line, a finished run.

Everything lies in temporary folders; nobody's cache, data or runs are touched.
"""

from __future__ import annotations

import gc
import io
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import EntryPoint
from pathlib import Path
from unittest.mock import patch

import pytest
from filelock import FileLock

if "PYTEST_XDIST_WORKER" in os.environ:  # a process a core: more threads would only wait for each other
    os.environ.setdefault("OMP_NUM_THREADS", "1")

from ihbench import registry
from ihbench.cli import main
from ihbench.scene.data_source import STANDIN_SEED, standin_root, wanted_frames
from ihbench.scene.protocol import load_protocol

OWN_METHOD = Path(__file__).parent / "examples" / "own_method"

# 5 training views (4 of them occluded), 2 × 2 test views, 64 px
TINY_PROFILE = """[profile.quick]
image = { size = 64 }
train = { frames = { step = 100 } }
test = { cameras = { step = 8 }, frames = { step = 480 } }
"""
# the second level is finer than 64 px can show; it is set here, so the plan leaves it
TINY_SWITCHES = [
    *("--method.precision", "float32"),  # else as the machine has it
    *("--method.texels", "32", "--method.levels", "16", "256", "--method.decoder-width", "32"),
    *("--method.position-map", "16", "--method.steps", "8", "--method.inpaint.no-on"),
]
SCENES = ["standin-1", "standin-2"]


def tiny_protocol(path: Path, *changes: tuple[str, str]) -> Path:
    """Write zju_occ with a tiny quick profile, and with some (old, new) texts of the file replaced."""
    text = (registry.package_folder("protocol", "zju_occ") / "zju_occ.toml").read_text(encoding="utf-8")
    text = text[: text.index("[profile.quick]")] + TINY_PROFILE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")
    return path


@dataclass(frozen=True)
class Outcome:
    """What a command left behind."""

    status: int
    out: str
    err: str


@dataclass(frozen=True)
class Bench:
    """The command line in this process, on the tiny protocol."""

    protocol: Path
    cache: Path
    runs: Path
    threads: int = field(default=1)  # tiny tensors: more threads only wait for each other

    @property
    def environment(self) -> dict[str, str]:
        private = {name: value for name, value in os.environ.items() if not name.startswith("IHBENCH_")}
        own = {"IHBENCH_CACHE": str(self.cache), "TORCH_HOME": "/nowhere", "OMP_NUM_THREADS": str(self.threads)}
        return private | own  # nobody's weights are looked for either

    @contextmanager
    def in_its_world(self) -> Iterator[None]:
        import torch

        before = torch.get_num_threads()
        torch.set_num_threads(self.threads)
        try:
            with patch.dict(os.environ, self.environment, clear=True):
                yield
        finally:
            torch.set_num_threads(before)

    def __call__(self, *words: object) -> Outcome:
        """`ihbench WORDS`."""
        out, err = io.StringIO(), io.StringIO()
        with self.in_its_world(), redirect_stdout(out), redirect_stderr(err):
            status = main([str(word) for word in words])
        return Outcome(status, out.getvalue(), err.getvalue())

    def run_words(self, *more: object, scene: str = "standin-1", method: str = "inpainthuman") -> list[str]:
        words = ["run", "--protocol", self.protocol, "--runs", self.runs, "--scene", scene, "--method", method]
        words += TINY_SWITCHES if method == "inpainthuman" else []
        return [str(word) for word in (*words, "--full", *more)]

    def run(self, *more: object, scene: str = "standin-1", method: str = "inpainthuman") -> Outcome:
        """`ihbench run` under the tiny protocol."""
        return self(*self.run_words(*more, scene=scene, method=method))

    def folders(self) -> list[Path]:
        """Run folders, oldest first."""
        return sorted((p.parent for p in self.runs.glob("*/run.json")), key=lambda p: p.stat().st_ctime_ns)


@dataclass(frozen=True)
class Finished:
    """A finished run of standin-1, seed 0. Read it, copy it, never write into it."""

    folder: Path
    outcome: Outcome


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first of the test processes to ask for it fills by `make`; the others wait and find it."""
    together = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        together = together.parent  # each process has a folder of its own in there
    folder = together / name
    with FileLock(together / f"{name}.lock"):
        if not (folder / "made").exists():
            shutil.rmtree(folder, ignore_errors=True)  # of a process that failed
            folder.mkdir()
            make(folder)
            (folder / "made").touch()
    return folder


@pytest.fixture(scope="session")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """The tiny protocol, and a cache that at first holds the stand-in pictures it reads and no more."""

    def in_folder(home: Path) -> Bench:
        return Bench(home / "tiny.toml", home / "cache", home / "runs")

    def make(home: Path) -> None:
        tiny_protocol(home / "tiny.toml")
        standin = registry.load("stand-in", "zju_mocap")
        with in_folder(home).in_its_world():
            wanted = wanted_frames(load_protocol(str(home / "tiny.toml")), standin)
            standin.ensure(standin_root("zju_mocap"), STANDIN_SEED, SCENES, wanted)

    return in_folder(made_once(tmp_path_factory, "studio", make))


@pytest.fixture(scope="session")
def finished(studio: Bench, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    def make(folder: Path) -> None:
        outcome = replace(studio, runs=folder / "runs").run()
        assert outcome.status == 0, outcome.err
        (folder / "outcome.json").write_text(json.dumps(asdict(outcome)), encoding="utf-8")

    home = made_once(tmp_path_factory, "finished", make)
    (folder,) = replace(studio, runs=home / "runs").folders()
    return Finished(folder, Outcome(**json.loads((home / "outcome.json").read_text(encoding="utf-8"))))


@pytest.fixture
def bench(studio: Bench, tmp_path: Path) -> Bench:
    """The command line with an empty runs folder of its own."""
    return replace(studio, runs=tmp_path / "runs")


@pytest.fixture
def bench_with_run(bench: Bench, finished: Finished) -> Bench:
    """The command line with a copy of the finished run in its runs folder."""
    shutil.copytree(finished.folder, bench.runs / finished.folder.name)
    return bench


@pytest.fixture
def mannequin(monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a second method, registered as its package registers it; it fits in no time."""
    monkeypatch.syspath_prepend(OWN_METHOD)
    registered, point = registry._found, EntryPoint("mannequin", "own_method.spec:SPEC", registry.GROUPS["method"])
    monkeypatch.setattr(
        registry, "_found", lambda kind: registered(kind) | ({"mannequin": point} if kind == "method" else {})
    )
    return "mannequin"


@pytest.fixture
def broken_mannequin(mannequin: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """The same, failing with seed 0."""
    from own_method.method import Mannequin  # pyright: ignore[reportMissingImports]

    whole = Mannequin.fit

    def fit(self: object, *training: object, seed: int, **more: object) -> object:
        if seed == 0:
            raise RuntimeError("a leg fell off\nand rolled away")
        return whole(self, *training, seed=seed, **more)

    monkeypatch.setattr(Mannequin, "fit", fit)
    return mannequin


def contents(folder: Path) -> dict[str, bytes]:
    """Relative path -> bytes of every file below a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def pytest_collection_finish() -> None:
    """What importing made stays; collections of garbage, and every run makes a whole one, need not look at it."""
    gc.collect()
    gc.freeze()
