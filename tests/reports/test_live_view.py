"""Looking at a fit while it goes on: what a run gives when it is asked, which run is followed, what is drawn."""

import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from ihbench.clock.ledger import Ledger
from ihbench.files import locks
from ihbench.record.finished_run import FinishedRun
from ihbench.record.store import LOCK, RunFolder
from ihbench.reports.site import live_view
from ihbench.runner import snapshots
from ihbench.runner.snapshots import EVERY, Snapshots, ask, read_snapshot
from ihbench.show.following import Following
from ihbench.show.subject import Subject
from tests.export.glb_reader import GlbFile
from tests.show.test_render_command import gallery, mannequin_run

__all__ = ["gallery", "mannequin_run"]


class Saved:
    """An avatar that is what was said last."""

    def __init__(self, words="first"):
        self.words = words

    def render(self): ...

    def save(self, folder):
        if self.words == "broken":
            raise RuntimeError("cannot be saved now")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "avatar.json").write_text(json.dumps(self.words))


def test_a_fit_is_saved_while_somebody_asks(tmp_path):
    now = SimpleNamespace(at=100.0)
    watcher = Snapshots(tmp_path, clock=lambda: now.at)
    ledger = Ledger(clock=lambda: now.at, watcher=watcher)

    def offered(step, avatar):
        now.at += EVERY + 1
        with ledger.stage("fit"):
            ledger.offer(step, avatar)
        found = read_snapshot(tmp_path)
        return None if found is None else (found.step, json.loads((found.folder / "avatar.json").read_text()))

    assert offered(1, Saved()) is None
    assert not (tmp_path / "live").exists()  # nobody looks: nothing is written
    ask(tmp_path)
    assert offered(2, Saved("second")) == (2, "second")
    first = read_snapshot(tmp_path)
    assert offered(3, Saved("third")) == (2, "second")  # nobody has asked again
    ask(tmp_path)
    assert offered(4, lambda: Saved("fourth")) == (4, "fourth")
    assert json.loads((first.folder / "avatar.json").read_text()) == "second"  # whoever reads it may go on
    ask(tmp_path)
    assert offered(5, Saved("broken")) == (4, "fourth")  # the watcher's loss alone
    assert "evaluate" in {row["stage"] for row in ledger.table()}
    ask(tmp_path)
    ledger.offer(6, Saved("too early"))
    assert read_snapshot(tmp_path).step == 4
    (tmp_path / "live" / "a" / "mine.txt").write_text("a user's")
    watcher.end()
    left = sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file())
    assert left == ["live/a/mine.txt"]
    assert read_snapshot(tmp_path) is None


def test_a_watched_run_ends_with_the_same_numbers(bench, finished, monkeypatch):
    """Snapshots of a real fit can be read and drawn; its scores are those of the run that nobody watched."""
    asked = iter(range(10**6))
    monkeypatch.setattr(snapshots, "EVERY", 0.0)
    monkeypatch.setattr(snapshots, "SHARE", 1e9)
    monkeypatch.setattr(Snapshots, "_renewed", lambda _: next(asked))
    monkeypatch.setattr(Snapshots, "end", lambda _: None)
    assert bench.run().status == 0
    (folder,) = bench.folders()
    assert (folder / "scores.jsonl").read_bytes() == (finished.folder / "scores.jsonl").read_bytes()
    with bench.in_its_world():
        found, run = read_snapshot(folder), FinishedRun(folder)
        assert found.step == found.number > 4
        subjects = [Subject(run, snapshot=folder / "live" / place) for place in "ab"]
        view = run.scene.test[0]
        drawn = [subject.avatar.render(view.camera, view.body_pose)[0] for subject in subjects]
    assert np.isfinite(drawn).all()
    assert np.abs(drawn[0] - drawn[1]).max() > 0  # a step later


def _copied(folder, name, status, tmp_path):
    other = tmp_path / name
    shutil.copytree(folder, other)
    run = RunFolder.open(other)
    run.set_status(status)
    return other


def test_the_run_that_goes_on_is_followed(finished, tmp_path):
    done, going = (_copied(finished.folder, n, s, tmp_path) for n, s in (("one", "done"), ("two", "running")))
    shutil.rmtree(going / "avatar")
    following = Following([tmp_path])
    seen = following.look()
    assert (seen.run, seen.folder, seen.words) == (done, done / "avatar", "finished")
    assert following.look() is None  # "two" says that it is running, but nobody writes it
    with locks.locked(going / LOCK, ""):
        assert following.look() is None
        assert following.run == going
        assert (going / "live" / "watched.json").exists()  # it is asked
        numbers = []
        for number in (1, 2, 3):
            place = "ab"[number % 2]
            (going / "live" / place).mkdir(exist_ok=True)
            words = {"place": place, "number": number, "step": 10 * number, "seconds": 2.0}
            (going / "live" / "snapshot.json").write_text(json.dumps(words))
            if number < 3:
                seen = following.look()
                numbers.append((seen.step, seen.folder.name, seen.still_there))
                assert following.look() is None
        assert numbers == [(10, "b", True), (20, "a", True)]
        assert seen.still_there  # the third one went into the other place
        words = {"place": "a", "number": 4, "step": 40, "seconds": 3.0}
        (going / "live" / "snapshot.json").write_text(json.dumps(words))
        assert not seen.still_there
        assert following.look().words == "step 40, 3 s of fitting"
        shutil.copytree(done / "avatar", going / "avatar")
        RunFolder.open(going).set_status("done")
    seen = following.look()
    assert (seen.run, seen.number) == (going, None)
    assert following.look() is None
    assert Following([tmp_path / "nothing"]).look() is None


def test_without_viser_one_line_names_the_extra(bench, finished, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    outcome = bench("view", finished.folder, "--live")
    assert outcome.status == 2
    assert outcome.err.strip().splitlines()[-1].endswith("pip install 'ihbench[view]'")
    outcome = bench("view", finished.folder, "--", "--protocol", "zju_occ")
    assert outcome.status == 2
    assert "go with --live" in outcome.err


class Scene:
    """A server as viser's, that keeps what it was given."""

    def __init__(self):
        self.scene = self.gui = self.initial_camera = self
        self.files, self.position = [], None

    def set_up_direction(self, axis): ...

    def add_markdown(self, words):
        return SimpleNamespace(content=words)

    def add_dropdown(self, name, options, initial_value):
        return SimpleNamespace(value=initial_value, on_update=lambda _: None)

    def add_slider(self, name, initial_value, **bounds):
        return SimpleNamespace(value=initial_value, on_update=lambda _: None)

    def add_glb(self, name, data):
        self.files.append(GlbFile(data))


def test_a_mesh_moves_on_the_floor(bench, mannequin_run, monkeypatch):
    """Of a method without Gaussians: in the pose that is asked for, its texture made once."""
    from ihbench.export import texture

    baked, made = texture.baked, []
    monkeypatch.setattr(texture, "baked", lambda *words: made.append(1) or baked(*words))
    monkeypatch.setattr(live_view, "TEXTURE", 32)
    server = Scene()
    with bench.in_its_world():
        view = live_view.LiveView(server, Following([mannequin_run]))
        view.look()
        view._motion.value, view._time.value, view._changed = "bow", 0.5, True
        view.look()
        subject = view._exporter.subject
        (pose,) = view._pose(subject).body_poses(subject.betas)
        bent = subject.body.pose(pose, blend_shapes=False)
    stood, moved = (file.posed() for file in server.files)
    assert made == [1]
    for posed in (stood, moved):
        assert abs(posed[:, 1].min()) < 0.05
    assert np.ptp(moved[:, 1]) < np.ptp(stood[:, 1]) - 0.05
    assert abs(moved.max(0) - bent.max(0)).max() < 0.1  # but for the relief of its surface
    _, y, z = server.position
    assert z > 3  # m: from in front
    assert 0 < y < np.ptp(stood[:, 1])


def test_gaussians_reach_the_scene(bench, finished, tmp_path):
    viser = pytest.importorskip("viser", reason="viser (extra `view`) is not installed")
    from ihbench.reports.site.live_view import HOST, LiveView, _free_port

    server = viser.ViserServer(host=HOST, port=_free_port(), verbose=False)
    try:
        with bench.in_its_world():
            view = LiveView(server, Following([_copied(finished.folder, "one", "done", tmp_path)]))
            assert view.look().number is None
            subject = view._exporter.subject
            rest = view._handle.centers
            (pose,) = view._pose(subject).body_poses(subject.betas)
            assert len(rest) == len(subject.avatar.gaussians(pose)[0])
            assert 1.2 < np.ptp(rest[:, 1]) < 2.2  # m: it stands, y up
            assert abs(rest[:, 1].min()) < 0.05  # on the floor
            assert "finished" in view._words.content
            view._motion.value, view._time.value, view._changed = "bow", 0.5, True
            assert view.look() is None
            assert np.ptp(view._handle.centers[:, 1]) < np.ptp(rest[:, 1]) - 0.05  # bent forward
            assert abs(view._handle.centers[:, 1].min()) < 0.05  # where it stood
    finally:
        server.stop()
