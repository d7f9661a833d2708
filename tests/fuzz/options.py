"""Every option of every command with bad values: one line and a documented status, and nothing lost or left behind.

Options are read off the dataclasses that the commands give to tyro, so that new ones are covered by themselves. The
commands run in this process, in a small world of their own: a scene, predictions, a finished run, a home, and files
that nobody may touch. What would take minutes once its options are accepted is cut short.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import pkgutil
import random
import stat
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints
from unittest.mock import patch

import numpy as np
import tyro

from ihbench import registry
from ihbench.body import write_body
from ihbench.cli import COMMANDS, main
from ihbench.datasets.plain import plain_scene
from ihbench.errors import BadInput
from ihbench.scene.method_spec import usable_specs
from ihbench.stress.drawn_capture import a_camera, a_pose, the_body
from tests.fuzz.patience import TooLong, at_most
from tests.fuzz.records import make_run

SECONDS = 60  # for one command
STATUSES = {0, 1, 2}
SIZE = 16  # px of the scene's pictures

TEXTS = [
    *("", " ", "\0", "\x1b[2J", "\u202e", "\udcff", "x" * 300, "x" * 5000, "é" * 200, "a/b", "../..", "..", ".", "-"),
    *("²", "１２", "٣", "1_000", " 5", "+5", "0x10", "1e3", "1.", "0", "-0", "-1", "-1e9", "1e12", "1e400", "nan"),
    *("9" * 19, "9" * 30, "9" * 5000, str(2**31), str(2**63), str(2**64), "0.5", "1000000000", "None", "True", "[]"),
    *("a=b", "=", "a=", "=1", "a=1:1", "steps=1:1", "steps=", "levels=64:", "psnr=nan", "psnr=1e999", "psnr/x=1"),
    *("1:2", "2:1", "0:0", "::", "0:5:0", "-1:5", "0:1e9", "0:99999999999", "0:10:99999999999", "1:2:3:4", "a:b"),
    *("{", "}", "{}", "{0}", "{nosuch}", "{frame", "{frame:10000000000d}", "{frame:d}", "{frame.real}", "{frame!r}"),
    *("{frame:{index}d}", "{scene:5}", "~", "~nouser", "~nouser/x", "$NOSUCH/x", "$HOME", "%s", "*", "a\nb", "all"),
    *(
        "：",
        "0:5：",
        "--",
        "-inf",
        "{}{}",
        "list",
        "procedural",
        "standin-1",
        "standin-10000000000",
        "quick",
        "zju_occ",
    ),
]
PLACES = [
    *("data", "runs", "predictions", "runs/*", "file.txt", "folder", "pipe", "loop", "null", "zero", "full", "cwd"),
    *("nowhere/x", "file.txt/x", "readonly", "p.toml", "/proc/nope", "/proc/self/mem", "/proc/self/fd/0"),
]


@dataclass(frozen=True)
class Option:
    """One option of one command: the words before its value."""

    command: tuple[str, ...]
    flag: str  # empty for a positional one


def commands() -> list[tuple[str, ...]]:
    """Every command and registered verb, as it is called."""
    found = [(name,) for name in (*COMMANDS, *(name for spec in usable_specs() for name in spec.commands))]
    return found + [("report", verb) for verb in registry.names("report verb")]


def options() -> list[Option]:
    """Every option of every command."""
    found: list[Option] = []
    for command in commands():
        for words, kind in _kinds(command, _asked_for(command)):
            found += [Option(words, flag) for flag in _flags(kind, "--")]
    return found


def _asked_for(command: tuple[str, ...]) -> Any:
    """The type that a command gives to tyro."""
    asked: list[Any] = []

    def remember(kind: Any, **_: Any) -> Any:
        asked.append(kind)
        raise SystemExit(0)

    with patch.object(tyro, "cli", remember):
        assert main(list(command)) == 0
    return asked[0]


def _kinds(command: tuple[str, ...], kind: Any) -> Iterator[tuple[tuple[str, ...], type]]:
    """The dataclasses in what a command gives to tyro, and the words that lead to each."""
    if isinstance(kind, type):
        yield command, kind
        return
    for part in get_args(kind):
        dataclass_, about = get_args(part)[0], part.__metadata__[0]
        yield (*command, about.name), dataclass_


def _flags(kind: type, prefix: str) -> Iterator[str]:
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        marks = getattr(hint, "__metadata__", ())
        name = next(
            (m.name for m in marks if isinstance(getattr(m, "name", None), str)), field.name.replace("_", "-")
        )
        plain = hint
        while get_origin(plain) is not None and hasattr(plain, "__metadata__"):
            plain = get_args(plain)[0]
        if is_dataclass(plain):
            yield from _flags(plain, f"{prefix}{name}.")  # type: ignore[arg-type]
        else:
            yield "" if any("POSITIONAL" in repr(mark).upper() for mark in marks) else f"{prefix}{name}"


# -------------------------------------------------------------------------------------------------- a small world


@dataclass(frozen=True)
class World:
    """Folders and files of a user, and what nobody may touch."""

    root: Path

    def path(self, name: str) -> Path:
        if name == "runs/*":
            return next(self.path("runs").glob("*__*"))
        return Path(name) if name.startswith("/") else self.root / name

    @classmethod
    def make(cls, root: Path) -> World:
        world = cls(root)
        camera = a_camera(size=SIZE)
        poses = [a_pose(yaw) for yaw in np.linspace(0, 6, 6)]
        scene, picture = root / "data" / "tiny", np.full((SIZE, SIZE, 3), 90, np.uint8)
        mask = np.zeros((SIZE, SIZE), bool)
        mask[3:13, 6:10] = True
        for frame in range(6):
            plain_scene.write_frame(scene, frame, picture, mask)
            plain_scene.write_frame(root / "made", frame, picture, mask)
        plain_scene.write_cameras(scene, {"main": camera})
        plain_scene.write_poses(scene, poses, frames=list(range(6)))
        write_body(scene / "body.npz", the_body())
        (root / "predictions" / "main").mkdir(parents=True)
        for file in (root / "made" / "images").rglob("*.png"):
            file.rename(root / "predictions" / "main" / file.name)
        make_run(root / "runs", "good")
        protocol = registry.package_folder("protocol", "custom_occ") / "custom_occ.toml"
        text = protocol.read_text().replace("size = 256", f"size = {SIZE}").replace("size = 512", f"size = {SIZE}")
        (root / "p.toml").write_text(text)
        for name in ("cwd", "cwd/deep", "home", "folder", "readonly"):
            (root / name).mkdir()
            (root / name / "mine.txt").write_text("nobody touches this")
        (root / "readonly").chmod(0o500)
        (root / "file.txt").write_text("nor this")
        os.mkfifo(root / "pipe")
        (root / "loop").symlink_to("loop")
        for name, numbers in (("null", (1, 3)), ("zero", (1, 5)), ("full", (1, 7))):
            try:
                os.mknod(root / name, stat.S_IFCHR | 0o666, os.makedev(*numbers))
            except OSError:  # not everybody may
                (root / name).symlink_to(f"/dev/{name}")
        return world

    def seen(self) -> dict[str, Any]:
        """What lies there: kind and content of everything but the cache."""
        found: dict[str, Any] = {}
        for place, folders, files in os.walk(self.root):
            folders[:] = [name for name in folders if name not in ("cache", "tmp")]
            for name in (*folders, *files):
                path = Path(place, name)
                state = path.lstat()
                content: Any = state.st_rdev
                if stat.S_ISREG(state.st_mode):
                    content = path.read_bytes()
                elif stat.S_ISLNK(state.st_mode):
                    content = os.readlink(path)
                found[str(path.relative_to(self.root))] = stat.S_IFMT(state.st_mode), content
        return found

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Inside, this process is a user of this world."""
        own = {name: value for name, value in os.environ.items() if not name.startswith(("IHBENCH_", "XDG_"))}
        own |= {
            "HOME": str(self.root / "home"),
            "IHBENCH_CACHE": str(self.root / "cache"),
            "TORCH_HOME": str(self.root / "cache"),
            "MPLCONFIGDIR": str(self.root / "cache"),
        }
        (self.root / "tmp").mkdir(exist_ok=True)
        before = Path.cwd()
        with patch.dict(os.environ, own, clear=True), patch.object(tempfile, "tempdir", str(self.root / "tmp")):
            os.chdir(self.root / "cwd" / "deep")
            try:
                yield
            finally:
                os.chdir(before)


def _good_words(option: Option, world: World) -> list[str]:
    """Words with which the command would do its work, without those of the option itself."""
    scene = ["--protocol", world.path("p.toml"), "--data", world.path("data")]
    runs = ["--runs", world.path("runs")]
    run = str(world.path("runs/*"))
    known: dict[tuple[str, ...], list[Any]] = {
        ("run",): [*scene, *runs],
        ("plan",): [*scene, *runs],
        ("ablate",): [*scene, *runs, "--workers", "0"],
        ("score",): [*scene, "--predictions", world.path("predictions"), *runs],
        ("prepare",): [*scene, "--out", world.path("home") / "out"],
        ("paint",): [*scene],
        ("data", "check"): [world.path("data"), "--overlays", world.path("home") / "seen"],
        ("data", "standin"): ["--out", world.path("home") / "cast"],
        ("report",): runs,
        ("report", "table1"): runs,
        ("report", "table2"): runs,
        ("report", "lint"): [world.path("file.txt")],
        ("export",): [run],
        ("render",): [run, "--orbit", "2", "--size", "16"],
        ("figures",): ["visual", run, "--views", "1", "--out", world.path("home") / "figures"],
        ("site",): [run, "--out", world.path("home") / "site"],
        ("view",): [run],
        ("ceiling",): [run],
        ("train-mini",): ["--out", world.path("home") / "mini"],
        ("protocol", "show"): ["zju_occ"],
        ("protocol", "diff"): ["zju_occ", "novel_pose"],
        ("metrics",): ["check"],
        ("weights", "fetch"): ["lpips-alex"],
    }
    words = [str(word) for word in known.get(option.command, [])]
    while option.flag and option.flag in words:
        at = words.index(option.flag)
        del words[at : at + 2]
    if not option.flag:  # positional words stand first
        while words and not words[0].startswith("--"):
            del words[0]
    return words


def import_all() -> None:
    """Import every module of the bench that can be imported here."""
    for room in ("ihbench", *(f"ihbench.{room}" for room in registry.ROOMS)):
        for found in pkgutil.walk_packages(import_module(room).__path__, f"{room}."):
            if not found.name.endswith("__main__"):
                with contextlib.suppress(ImportError):
                    import_module(found.name)


@contextlib.contextmanager
def cut_short() -> Iterator[None]:
    """Options are read and checked as ever; the work of minutes behind them is not done."""

    def too_long(*_: Any, **__: Any) -> Any:
        raise BadInput("cut short: this would be minutes of work")

    import_all()  # a module imported inside would keep what stands here for good

    places = (
        *(
            "ihbench.runner.run_loop.run_scene",
            "ihbench.runner.executor.run_scene",
            "ihbench.metrics.oracles.check.check",
        ),
        *("ihbench.stress.run.run_cases", "ihbench.kernels.table.run_kernels", "ihbench.metrics.weights.fetch"),
        "ihbench.methods.inpainthuman.studies.paint_table.paint_scene",
        "ihbench.diffusion.crops.crop_dataset.CropDataset.make",
        "ihbench.datasets.standin.photograph.photograph",
        "ihbench.reports.site.server.serve_followed",
    )
    with contextlib.ExitStack() as stack:
        for place in places:
            with contextlib.suppress(AttributeError, ImportError):
                stack.enter_context(patch(place, too_long))
        for name in registry.names("stand-in"):
            stack.enter_context(patch.object(registry.load("stand-in", name), "ensure", too_long))
        yield


# ---------------------------------------------------------------------------------------------------------- faults


def faults(folder: Path, n: int, seed: int) -> Iterator[str]:
    """Call `n` commands with one bad value each; what went wrong, a line each."""
    draw, world, every = random.Random(seed), World.make(folder), options()
    draw.shuffle(every)
    with world.entered(), cut_short():
        for case in range(n):
            option = every[case % len(every)]
            value = draw.choice(TEXTS) if draw.random() < 0.7 else str(world.path(draw.choice(PLACES)))
            words = [*option.command, *_good_words(option, world)]
            if not option.flag:
                words = [*option.command, value, *words[len(option.command) :]]
            elif draw.random() < 0.5:
                words += [option.flag, value]
            else:
                words.append(f"{option.flag}={value}")
            words += ["--json"] * (draw.random() < 0.2 and "--json" not in words)
            for fault in attack(world, words, value):
                yield f"{' '.join(words)[-300:]!a} (case {case}): {fault}"


def attack(world: World, words: list[str], value: str) -> Iterator[str]:
    """Call a command; what went wrong. The world is put right again."""
    before, out, err = world.seen(), io.StringIO(), io.StringIO()
    status: int | None = None
    try:
        with at_most(SECONDS), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = main(words)
    except (Exception, TooLong) as error:
        yield f"{type(error).__name__}: {error}"
    told, text = err.getvalue(), out.getvalue()
    lines = [line for line in told.splitlines() if line.startswith("ihbench: ")]
    if value.endswith("pipe") and "TooLong" in told:
        status = 2  # a pipe that nobody reads is waited for, as everywhere
    if status not in STATUSES:
        yield f"status {status}: {told[-300:]}"
    if "Traceback" in told + text:
        yield f"a traceback: {told[-300:]}"
    if status == 2 and not lines:
        yield f"status 2 without a word: {told[-300:]}"
    late = words[0] == "ablate"  # shows what hours have made before it is written
    if status == 2 and text and "--json" not in words and not late:
        yield f"status 2, but stdout has {text[:100]!r}"
    if "--json" in words and text and "usage:" not in text:
        try:
            json.loads(text)
        except ValueError:
            if lines or status == 2:
                yield f"--json, but stdout is not one object: {text[:100]!r}"
    removes = words[:2] == ["runs", "rm"] and status == 0  # what it is for
    faults_of_files = list(_changes(world, before, status, value, worked="cut short" in told))
    yield from (fault for fault in faults_of_files if not (removes and fault.startswith("runs/")))


def _changes(world: World, before: dict[str, Any], status: int | None, value: str, worked: bool) -> Iterator[str]:
    """What the command removed, changed, or left although it was refused before it `worked`; then everything is as it
    was."""
    after = world.seen()
    for name, content in before.items():
        if after.get(name) == content:
            continue
        path = world.root / name
        named = os.path.realpath(value) == os.path.realpath(path) if "\0" not in value else False
        ours = name.endswith(("runs.sqlite", "lock")) or "/presets" in name
        if not (status == 0 and named) and not ours:
            yield f"{name} was {'changed' if name in after else 'removed'}"
        if path.is_dir() or not stat.S_ISREG(content[0]):
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content[1])
    new = sorted(name for name in after if name not in before)
    if status == 2 and not worked:
        kept = [name for name in new if not name.endswith(("runs.sqlite", "lock"))]
        if kept:
            yield f"refused, but left {', '.join(kept[:5])}"
    for name in reversed(new):
        path = world.root / name
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink()
