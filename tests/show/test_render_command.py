"""`ihbench render`: what it draws is what was scored, the truth stands beside it, and every method will do."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from ihbench.files.images import read_image
from ihbench.metrics import psnr
from ihbench.metrics.eight_bit import displayed
from ihbench.record.finished_run import FinishedRun
from ihbench.show.framing import Framing
from ihbench.show.motion import stand_of, up_axis
from ihbench.show.panels import GAP
from ihbench.show.subject import Subject


@pytest.fixture(scope="module")
def gallery(studio, tmp_path_factory):
    return replace(studio, runs=tmp_path_factory.mktemp("gallery"))


@pytest.fixture
def mannequin_run(gallery, mannequin):
    """A finished run of a method without Gaussians, made once."""
    if not gallery.folders():
        assert gallery.run(method=mannequin).status == 0
    return gallery.folders()[-1]


def frames_of(folder):
    return [np.asarray(Image.open(path)) for path in sorted(folder.glob("*.png"))]


def test_frame_n_of_an_orbit_is_frame_0(bench, mannequin_run, finished):
    """To one grey level, with Gaussians and without."""
    for folder in (mannequin_run, finished.folder):
        with bench.in_its_world():
            subject = Subject(FinishedRun(folder))
            pose = subject.pose("a_pose", centred=True)
            stand = stand_of(subject.body, pose, up_axis([pose]))
            framing = Framing.of([subject.body.pose(pose)], [0], subject.body.posed_joints(pose)[:1], stand)
            drawn = [
                displayed(subject.avatar.render(framing.camera(0, degrees, 64, 64), pose)[0]).astype(int)
                for degrees in (0, 360, 30)
            ]
        assert np.abs(drawn[1] - drawn[0]).max() <= 1
        assert np.abs(drawn[2] - drawn[0]).max() > 20  # and it does turn in between


def test_any_methods_avatar_goes_around(bench, mannequin_run, tmp_path):
    out = bench("render", mannequin_run, "--orbit", "6", "--size", "48", "64", "--out", tmp_path / "seen")
    assert out.status == 0, out.err
    assert f"6 frames at 25 a second written to {tmp_path / 'seen'}" in out.out
    frames = frames_of(tmp_path / "seen")
    assert [frame.shape for frame in frames] == [(64, 48, 3)] * 6
    assert all(40 < (frame != frame[0, 0]).any(-1).sum() < 2500 for frame in frames)
    longer = bench("render", mannequin_run, "--orbit", "3", "--size", "48", "64", "--out", tmp_path / "seen")
    assert (longer.status, longer.err.count("\n")) == (2, 1)
    assert "000003.png of a longer film" in longer.err


def test_a_test_camera_shows_what_was_scored_and_the_truth(bench_with_run):
    (folder,) = bench_with_run.folders()
    (camera, *_) = sorted(path.name for path in (folder / "renders").iterdir())
    out = folder.parent / "seen"
    done = bench_with_run("render", folder, "--camera", camera, "--side-by-side", "--no-captions", "--out", out)
    assert done.status == 0, done.err
    frames = frames_of(out)
    with bench_with_run.in_its_world():
        scene = FinishedRun(folder).scene
        truths = [scene.test[k].image for k, key in enumerate(scene.test_keys) if key.camera_id == camera]
    stored = sorted((folder / "renders" / camera).iterdir())
    assert len(frames) == len(stored) == len(truths) > 1
    for frame, truth, file in zip(frames, truths, stored, strict=True):
        size = truth.shape[1]
        assert frame.shape == (size, 2 * size + GAP, 3)
        assert psnr(frame[:, :size], displayed(truth)) == np.inf
        assert np.array_equal(frame[:, size + GAP :], displayed(read_image(file, (1.0, 1.0, 1.0))))


def test_runs_beside_each_other_in_another_motion(bench, mannequin_run, finished, tmp_path):
    poses = np.zeros((9, 72))
    poses[:, 50] = np.linspace(0, -1, 9)  # the left arm comes down
    np.savez(tmp_path / "m.npz", poses=poses, trans=np.zeros((9, 3)), mocap_framerate=10.0)
    words = ("render", finished.folder, mannequin_run, "--side-by-side", "--size", "40", "--fps", "5")
    done = bench(*words, "--motion", tmp_path / "m.npz", "--out", tmp_path / "film.webp")
    assert done.status == 0, done.err
    film = Image.open(tmp_path / "film.webp")
    assert film.n_frames == 5
    assert film.size[0] == 2 * 40 + GAP
    assert film.size[1] > 40  # names above
    for words, word in (
        (("render", finished.folder, mannequin_run, "--out", tmp_path / "x.webp"), "--side-by-side"),
        (("render", mannequin_run, "--motion", "marsh"), "march"),
        (("render", mannequin_run, "--camera", "Camera_B99"), "Camera_B"),
        (("render", mannequin_run, "--orbit", "4", "--camera", "front"), "one of them"),
        (("render", mannequin_run, "--pose", "4000"), "frames 0 to"),
        (("render", mannequin_run, "--out", tmp_path / "x.avi"), ".webp"),
        (("render", mannequin_run, "--background", "1", "0"), "three numbers"),
        (("render",), "a run folder"),
    ):
        refused = bench(*words)
        assert (refused.status, refused.err.count("\n"), word in refused.err) == (2, 1, True), refused.err


def test_a_path_that_was_saved_is_gone_again(bench, mannequin_run, tmp_path):
    words = ("render", mannequin_run, "--size", "40", "--background", "0", "0.5", "1")
    path = tmp_path / "path.json"
    first = bench(*words, "--orbit", "3", "--save-path", path, "--out", tmp_path / "a")
    assert first.status == 0, first.err
    assert json.loads(path.read_text())["image_size"] == [40, 40]
    again = bench(*words, "--camera", path, "--out", tmp_path / "b")
    assert again.status == 0, again.err
    for a, b in zip(frames_of(tmp_path / "a"), frames_of(tmp_path / "b"), strict=True):
        assert np.array_equal(a, b)
        assert a[0, 0].tolist() == [0, 128, 255]


def test_a_motion_before_a_camera_of_the_data_set(bench, mannequin_run, tmp_path):
    done = bench(
        "render", mannequin_run, "--camera", "Camera_B1", "--motion", "bow", "--fps", "2", "--out", tmp_path / "a"
    )
    assert done.status == 0, done.err
    frames = frames_of(tmp_path / "a")
    assert len(frames) == 4
    shown = [(frame != frame[0, 0]).any(-1) for frame in frames]
    assert all(seen.sum() > 50 for seen in shown)
    top = [np.flatnonzero(seen.any(1))[0] for seen in shown]
    assert max(top) > min(top)  # the head comes down
