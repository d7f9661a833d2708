"""Nothing goes that the bench did not write itself, whatever a command is given for a place."""

from __future__ import annotations

import ast
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from ihbench.cli import main
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.data.prepare import prepare
from ihbench.errors import BadInput
from ihbench.files import locks, removal
from ihbench.record import store
from ihbench.record.store import RunFolder
from ihbench.scene.views import open_scene
from tests.bench.fake_capture import fake_protocol, the_body, turning_capture
from tests.conftest import contents
from tests.record.test_store import IDENTITY

ROOT = Path(removal.__file__).parents[2]


# ----------------------------------------------------------------------------------------------------- in the code


def test_only_one_module_removes():
    """Every other one goes through it. Those that rename a file of their own into place are listed."""
    removers = {"rmtree", "unlink", "rmdir", "removedirs", "renames", "move", "rename", "replace", "remove"}
    found = {}
    for room in ("ihbench", "datasets", "protocols", "methods", "reports"):
        for path in sorted((ROOT / room).rglob("*.py")):
            for call in (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)):
                match call:
                    case ast.Call(func=ast.Attribute(value=ast.Name(id="os" | "shutil" as module), attr=name)):
                        name = f"{module}.{name}" if name in removers else ""
                    case ast.Call(func=ast.Attribute(attr="unlink" | "rmdir" | "rmtree" as name)):
                        pass
                    case ast.Call(func=ast.Attribute(attr="rename" | "replace" as name), args=[_], keywords=[]):
                        pass  # of a path: of a text it has two arguments, of a dataclass keywords
                    case _:
                        name = ""
                if name:
                    found.setdefault(path.relative_to(ROOT).as_posix(), set()).add(name)
    assert found == {
        "ihbench/files/atomic.py": {"os.replace"},
        "ihbench/data/prepare.py": {"os.rename", "rmdir"},
        "ihbench/files/removal.py": {"os.replace", "rmdir", "shutil.rmtree", "unlink"},
        "ihbench/record/store.py": {"os.rename", "rmdir"},
    }


# ----------------------------------------------------------------------------------------------------- prepare


@pytest.fixture(scope="module")
def scene():
    return open_scene(turning_capture(3), fake_protocol(n_frames=3))


def handed(scene, out, force=False, sources=()):
    return prepare(scene, the_body(), out, "humannerf", Progress.silent(), force, sources)


def test_force_replaces_what_it_wrote_and_leaves_nothing_beside(scene, tmp_path):
    folder = handed(scene, tmp_path)
    before = contents(tmp_path)
    (folder / "test_views.json").unlink()  # files that are missing are nobody's loss
    masks = next(folder.rglob("masks"))
    shutil.rmtree(masks)
    masks.mkdir()
    assert handed(scene, tmp_path, force=True) == folder
    assert contents(tmp_path) == before


def a_stranger(folder):
    (folder / "notes.txt").write_text("mine")


def an_edited_file(folder):
    (folder / "test_views.json").write_text("[]")


def an_empty_folder(folder):
    (folder / "images" / "mine").mkdir(parents=True)


def a_link(folder):
    (folder / "test_views.json").unlink()
    (folder / "test_views.json").symlink_to(folder.parent / "elsewhere")


def no_manifest(folder):
    (folder / "manifest.json").unlink()


def a_foreign_manifest(folder):
    (folder / "manifest.json").write_text(json.dumps({"files": {}, "made_by": "somebody"}))


def a_damaged_manifest(folder):
    (folder / "manifest.json").write_text("{")


def a_manifest_of_a_wrong_kind(folder):
    (folder / "manifest.json").write_text('{"made_by": "ihbench 0.1", "files": ["a"]}')


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize(
    "change",
    [a_stranger, an_edited_file, an_empty_folder, a_link, no_manifest, a_foreign_manifest, a_damaged_manifest,
     a_manifest_of_a_wrong_kind],
)  # fmt: skip
def test_a_folder_that_holds_anything_else_is_left_and_its_removal_not_proposed(scene, tmp_path, change, force):
    change(handed(scene, tmp_path))
    before = contents(tmp_path)
    with pytest.raises(BadInput, match="not just what ihbench prepare wrote") as refused:
        handed(scene, tmp_path, force)
    assert "--force" not in str(refused.value)
    assert "\n" not in str(refused.value)
    assert contents(tmp_path) == before


@pytest.mark.parametrize("force", [False, True])
def test_a_target_that_is_a_link_is_left(scene, tmp_path, force):
    folder = handed(scene, tmp_path / "real")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / scene.capture.name).symlink_to(folder)
    before = contents(tmp_path / "real")
    with pytest.raises(BadInput, match="it is a link"):
        handed(scene, tmp_path / "out", force)
    assert contents(tmp_path / "real") == before


@pytest.mark.parametrize("where", ["", "in/side", "alias", "alias/in", "in/..", "in/../../data"])
def test_nothing_is_written_into_the_data_or_around_them(scene, tmp_path, where):
    """Not even where they are a training set that an earlier call wrote."""
    data = handed(scene, tmp_path / "data").parent
    (data / "in" / "side").mkdir(parents=True)
    (tmp_path / "data" / "alias").symlink_to(tmp_path / "other")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "in").symlink_to(data)
    before = contents(tmp_path)
    out = data if where == "alias" else data / where
    if where.startswith("alias"):
        (tmp_path / "link").symlink_to(data)
        out = tmp_path / "link"
    with pytest.raises(BadInput, match="which is only read; name another folder with --out"):
        handed(scene, out, True, [data])
    with pytest.raises(BadInput, match="which is only read"):
        handed(scene, tmp_path / "data", True, [data / scene.capture.name / "test_views.json"])
    assert contents(tmp_path) == before


def test_the_current_folder_is_not_taken_away(scene, tmp_path, monkeypatch):
    folder = handed(scene, tmp_path)
    monkeypatch.chdir(folder)
    with pytest.raises(BadInput, match="name another folder"):
        handed(scene, tmp_path, True)
    assert (folder / "manifest.json").is_file()


def test_what_killed_calls_left_goes_and_what_looks_like_it_stays(scene, tmp_path):
    name = scene.capture.name
    handed(scene, tmp_path / "elsewhere")
    strangers = [
        f".{name}.{word}" for word in ("mine.partial", "0123abcx.partial", "0123abcd.notes", "00000001.before")
    ]
    for part in (f".{name}.0123abcd.partial", *strangers):
        (tmp_path / part).mkdir()
        (tmp_path / part / "file").touch()
    (tmp_path / f".{name}.0123abcd.lock").touch()
    shutil.copytree(tmp_path / "elsewhere" / name, tmp_path / f".{name}.00000002.before")  # killed while replacing
    handed(scene, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {name, "elsewhere", *strangers}
    with locks.locked(tmp_path / f".{name}.0123abcd.lock", ""):
        (tmp_path / f".{name}.0123abcd.partial").mkdir()
        handed(scene, tmp_path, True)
        assert (tmp_path / f".{name}.0123abcd.partial").is_dir()


def test_the_command_does_not_touch_the_data(bench, tmp_path):
    """The fault as it was found: the data's own folder as --out."""
    with bench.in_its_world():
        from ihbench.scene.data_source import standin_root

        data = standin_root("zju_mocap")
    before = {path: path.stat().st_mtime_ns for path in data.rglob("*")}
    for out in (data, data / "..", tmp_path / "link"):
        (tmp_path / "link").unlink(missing_ok=True)
        (tmp_path / "link").symlink_to(data)
        words = ("--data", data, "--out", out, "--profile", "quick", "--scene", "standin-1", "--force")
        if out.name == "..":
            (data.parent / "standin-1").mkdir(exist_ok=True)
        outcome = bench("prepare", "--protocol", bench.protocol, *words)
        assert outcome.status == 2, outcome.out
        assert "name another folder with --out" in outcome.err
    (data.parent / "standin-1").rmdir()
    assert {path: path.stat().st_mtime_ns for path in data.rglob("*")} == before


# ----------------------------------------------------------------------------------------------------- run folders

THEIRS = ["notes.txt", "figure.png", "renders/mine.txt", "renders/1/best.png", "avatar/edited.ply", "backup/run.json"]
OURS = ["scores.jsonl", "renders/1/000030.png", "avatar/avatar.safetensors"]


@pytest.mark.parametrize("status", ["done", "interrupted"])
@pytest.mark.parametrize("keep_new", [True, False])
def test_a_forced_run_leaves_what_is_the_users(tmp_path, status, keep_new):
    run = RunFolder.create(tmp_path, IDENTITY)
    for name in (*THEIRS, *OURS):
        (run.path / name).parent.mkdir(parents=True, exist_ok=True)
        (run.path / name).write_text(name)
    run.set_status(status, "the first")
    again = RunFolder.create(tmp_path, IDENTITY, force=True)
    assert contents(again.path).keys() == {*THEIRS, "lock", "run.json"}
    (again.path / "scores.jsonl").write_text("new")
    with again.lock():
        again.settle(keep_new)
    there = contents(again.path)
    assert {name: there[name].decode() for name in THEIRS} == {name: name for name in THEIRS}
    old = status == "done" and not keep_new
    assert there.keys() == {*THEIRS, *(OURS if old else OURS[:1]), "lock", "run.json"}
    assert there["scores.jsonl"] == (b"scores.jsonl" if old else b"new")
    assert not list((tmp_path / "replaced").glob("*"))


@pytest.mark.parametrize("force", [True, False])
@pytest.mark.parametrize("status", ["done", "interrupted"])
def test_names_that_a_method_might_choose_are_its_own_only_where_the_run_says_so(tmp_path, force, status):
    run = RunFolder.create(tmp_path, IDENTITY)
    mine = ["avatar/mesh.npz", "checkpoints/mine.safetensors", "checkpoints/backup.safetensors"]
    for name in mine:
        (run.path / name).parent.mkdir(exist_ok=True)
        (run.path / name).write_text("mine")
    with run.saving_avatar():
        (run.path / "avatar" / "avatar.npz").write_text("ours")
    Ledger(run.path).save_state("stage1", {"x": np.zeros(3)}, {})
    shutil.copy(run.path / "checkpoints" / "stage1.safetensors", run.path / mine[2])
    run.set_status(status)
    if force:
        RunFolder.create(tmp_path, IDENTITY, force=True)
        assert contents(run.path).keys() == {*mine, "run.json", "lock"}
    else:
        (run.path / "run.json.damaged").touch()
        (run.path / "run.json.damaged-notes").write_text("mine")
        store.remove_run(run.path)
        assert contents(run.path).keys() == {*mine, "run.json.damaged-notes"}


def test_a_forced_run_that_is_killed_while_it_makes_room_loses_nothing(tmp_path, monkeypatch):
    run = RunFolder.create(tmp_path, IDENTITY)
    for name in OURS:
        (run.path / name).parent.mkdir(parents=True, exist_ok=True)
        (run.path / name).write_text(name)
    run.set_status("done", "the first")
    replace, left = os.replace, [1, 1]
    monkeypatch.setattr(os, "replace", lambda *a: replace(*a) if left and left.pop() else 1 / 0)
    with pytest.raises(ZeroDivisionError):
        RunFolder.create(tmp_path, IDENTITY, force=True)
    monkeypatch.undo()
    again = RunFolder.create(tmp_path, IDENTITY, force=True)
    with again.lock():
        again.settle(keep_new=False)
    assert RunFolder.open(run.path).reason == "the first"
    assert contents(run.path).keys() == {*OURS, "lock", "run.json"}


def test_every_damaged_record_is_kept(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    for text in ("{", "[", "{}"):
        (run.path / "run.json").write_text(text)
        RunFolder.create(tmp_path, IDENTITY)
    kept = [path.read_text() for path in sorted(run.path.glob("run.json.damaged*"))]
    assert kept == ["{", "[", "{}"]


def test_the_rest_of_the_folder_of_runs_is_not_touched(bench_with_run):
    (bench_with_run.runs / "replaced" / "mine").mkdir(parents=True)
    (bench_with_run.runs / "replaced" / "mine" / "file").write_text("x")
    assert store._aside(bench_with_run.folders()[0]).parent == bench_with_run.runs / "replaced"
    before = contents(bench_with_run.runs / "replaced")
    assert bench_with_run.run("--force", method="inpainthuman").status == 0
    assert contents(bench_with_run.runs / "replaced") == before


def test_holds_sees_through_links_dots_and_what_is_not_there_yet(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    assert removal.holds(tmp_path / "a", tmp_path / "link" / "b" / "new" / "er")
    assert removal.holds(tmp_path / "link", tmp_path / "a")
    assert not removal.holds(tmp_path / "a" / "b", tmp_path / "a")
    assert not removal.holds(tmp_path / "a" / "b", tmp_path / "a" / "b" / ".." / "c")
    assert not removal.holds(tmp_path / "none", tmp_path / "none")


def test_prepare_is_refused_from_the_command_line_with_status_2(tmp_path, capsys):
    assert main(["prepare", "--protocol", "zju_occ", "--data", str(tmp_path), "--out", str(tmp_path), "--force"]) == 2
    assert capsys.readouterr().err.startswith("ihbench: ")
