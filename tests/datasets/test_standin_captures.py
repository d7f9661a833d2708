"""The stand-ins of PeopleSnapshot and OcMotion: read by the real loaders, true to their truth, and damage named."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from PIL import Image

from ihbench.cli import main
from ihbench.datasets.layouts import OCMOTION, PEOPLE_SNAPSHOT
from ihbench.datasets.people_snapshot import original as people_snapshot
from ihbench.datasets.reading.pickles import write_pickle
from ihbench.datasets.standin import ocmotion_capture, outfit, people_snapshot_capture
from ihbench.datasets.standin.ocmotion_capture import OcMotionStandIn
from ihbench.datasets.standin.people_snapshot_capture import PeopleSnapshotStandIn
from ihbench.errors import BadInput
from ihbench.metrics import psnr

FRAMES = 6
TEXTURE = 128  # px


@pytest.fixture(autouse=True, scope="module")
def small_texture():
    """A texture of the outfit takes two seconds at its own size, and nothing here looks at it closely."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outfit, "TEXTURE_SIZE", TEXTURE)
        yield


@pytest.fixture(scope="module")
def snapshot(small_texture, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(people_snapshot_capture, "N_FRAMES", FRAMES)
        patch.setattr(people_snapshot_capture, "SIZE", 180)
        return PeopleSnapshotStandIn.ensure(tmp_path_factory.mktemp("ps") / "root", 0, ["standin-1"], {})


@pytest.fixture(scope="module")
def ocmotion(small_texture, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ocmotion_capture, "N_FRAMES", FRAMES)
        patch.setattr(ocmotion_capture, "WIDTH", 240)
        patch.setattr(ocmotion_capture, "HEIGHT", 180)
        return OcMotionStandIn.ensure(tmp_path_factory.mktemp("oc") / "root", 0, ["standin-2"], {})


def test_cameras_have_the_names_that_a_stand_in_says_before_it_is_made(snapshot, ocmotion):
    for dataset, root, standin in (
        (PEOPLE_SNAPSHOT, snapshot, PeopleSnapshotStandIn),
        (OCMOTION, ocmotion, OcMotionStandIn),
    ):
        for subject in dataset(root).subjects():
            assert dataset(root).open(subject).camera_ids == standin.camera_ids(subject)
            assert len(standin.camera_ids(subject)) == standin.n_cameras


def test_the_snapshot_person_turns_once_and_a_half_before_the_camera(snapshot):
    capture = PEOPLE_SNAPSHOT(snapshot).open("standin-1")
    assert (capture.standin, capture.body, capture.n_frames) == ("stand-in v1 seed 0", "procedural", FRAMES)
    camera = capture.camera(0)
    np.testing.assert_allclose(camera.R, np.eye(3), atol=1e-12)
    assert not camera.t.any()
    assert camera.distortion is not None
    for frame in range(FRAMES):
        pose = capture.body_pose(frame)
        mask = capture.silhouette(0, frame)
        points = camera.project(capture.model.pose(pose))
        column, row = points[:, 0].astype(int), points[:, 1].astype(int)
        grown = mask | np.roll(mask, 1, 0) | np.roll(mask, -1, 0) | np.roll(mask, 1, 1) | np.roll(mask, -1, 1)
        assert grown[row, column].mean() > 0.97  # the same body in the camera's world
        head, neck = (capture.model.posed_joints(pose)[k] for k in (15, 12))
        assert head[1] < neck[1]  # OpenCV axes: up is negative
    front = [_heading(capture, frame) for frame in range(FRAMES)]
    turned = np.unwrap(front)
    assert abs(turned[-1] - turned[0]) == pytest.approx(3 * np.pi, abs=0.3)
    assert abs(front[0]) < 0.2  # faces the camera first


def _heading(capture, frame):
    """rad; 0 when the body's front looks at the camera."""
    joints = capture.model.posed_joints(capture.body_pose(frame))
    across = joints[1] - joints[2]  # left hip from right hip
    return np.arctan2(across[2], across[0])


def test_ocmotion_masks_are_what_furniture_leaves_of_the_truth(ocmotion):
    capture = OCMOTION(ocmotion).open("standin-2")
    folder = ocmotion / "standin-2"
    assert (capture.standin, capture.body, capture.n_frames) == ("stand-in v1 seed 0", "procedural", FRAMES)
    shares = []
    for frame in range(FRAMES):
        visible = capture.silhouette(0, frame, "visible")
        whole = np.asarray(Image.open(folder / "truth" / "masks" / f"{frame:05d}.png")) > 0
        assert not (visible & ~whole).any()
        shares.append(visible.sum() / whole.sum())
        image = capture.image(0, frame).astype(int)
        clear = np.asarray(Image.open(folder / "truth" / "images" / f"{frame:05d}.jpg")).astype(int)
        assert abs(image - clear)[visible].mean() < 12  # the truth is JPEG
        hidden = whole & ~visible
        assert hidden.sum() < 20 or abs(image - clear)[hidden].mean() > 15
    assert min(shares) < 0.75  # furniture really hides people
    assert max(shares) > 0.3
    assert len(capture.novel_cameras(0)) == 6


def test_the_room_is_the_same_whoever_asks_again(ocmotion, tmp_path, monkeypatch):
    monkeypatch.setattr(ocmotion_capture, "N_FRAMES", FRAMES)
    monkeypatch.setattr(ocmotion_capture, "WIDTH", 240)
    monkeypatch.setattr(ocmotion_capture, "HEIGHT", 180)
    again = OcMotionStandIn.ensure(tmp_path / "again", 0, ["standin-2"], {})
    for path in sorted((ocmotion / "standin-2").rglob("*.*")):
        assert path.read_bytes() == (again / path.relative_to(ocmotion)).read_bytes(), path.name
    missing = again / "standin-2" / "truth" / "masks" / "00003.png"
    before = (again / "standin-2" / "images" / "00003.png").read_bytes()
    missing.unlink()
    (again / "standin-2" / "images" / "00003.png").unlink()
    OcMotionStandIn.ensure(again, 0, ["standin-2"], {})  # goes on where it was interrupted
    assert (again / "standin-2" / "images" / "00003.png").read_bytes() == before
    with pytest.raises(BadInput, match="another stand-in"):
        OcMotionStandIn.ensure(again, 1, ["standin-2"], {})


def invert(folder):
    with h5py.File(folder / "masks.hdf5", "r+") as file:
        file["masks"][...] = 1 - file["masks"][...]


def mirror(folder):
    with h5py.File(folder / "masks.hdf5", "r+") as file:
        # the person stands in the middle: shifted to one side first, or their mirror image would fit too
        file["masks"][...] = np.roll(file["masks"][...], 60, axis=2)[..., ::-1]


def cut(path, share=0.5):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def edit_poses(folder, key, change):
    with h5py.File(folder / "reconstructed_poses.hdf5", "r+") as file:
        file[key][...] = change(file[key][...])


def camera_without_focal(folder):
    from ihbench.files.safe_pickle import load_pickle

    camera = load_pickle(folder / "camera.pkl")
    del camera["camera_f"]
    write_pickle(folder / "camera.pkl", camera)


class Boom:
    def __reduce__(self):
        return print, ("hostile",)


def hostile(folder):
    import pickle

    (folder / "camera.pkl").write_bytes(pickle.dumps(Boom()))


SNAPSHOT_DAMAGES = {
    "inverted": (invert, "inverted"),
    "elsewhere": (mirror, "project into the silhouettes"),
    "hdf5 cut short": (lambda f: cut(f / "masks.hdf5"), "masks.hdf5"),
    "video cut short": (lambda f: cut(f / "standin-1.mp4", 0.3), "standin-1.mp4"),
    "no video": (lambda f: (f / "standin-1.mp4").unlink(), "standin-1.mp4"),
    "NaN": (lambda f: edit_poses(f, "pose", lambda p: np.where(np.arange(72) == 5, np.nan, p)), "NaN"),
    "millimetres": (lambda f: edit_poses(f, "trans", lambda t: 1000 * t), "millimetres"),
    "no focal length": (camera_without_focal, "camera_f"),
    "degrees": (lambda f: edit_poses(f, "pose", np.degrees), "and so on: 6 such of 6 looked at"),
    "frozen": (
        lambda f: edit_poses(f, "pose", lambda p: np.repeat(p[:1], len(p), 0)),
        "poses looked at are the same",
    ),
    "betas": (lambda f: edit_poses(f, "betas", lambda b: b + 20), "its betas make a body of"),
    "hostile": (hostile, "camera.pkl"),
}


@pytest.mark.parametrize("name", SNAPSHOT_DAMAGES)
def test_data_check_names_the_damage_of_a_snapshot(snapshot, tmp_path, capsys, name):
    damage, words = SNAPSHOT_DAMAGES[name]
    shutil.copytree(snapshot, tmp_path / "copy")
    assert _check(tmp_path, capsys)[0] == 0
    damage(tmp_path / "copy" / "standin-1")
    status, found = _check(tmp_path, capsys)
    assert status == 1
    assert words in " ".join(found["subjects"][0]["problems"]), found


def rewrite(folder, change):
    path = folder / "metadata.json"
    words = json.loads(path.read_text())
    change(words)
    path.write_text(json.dumps(words))


def edit_masks(folder, change):
    for path in (folder / "masks").iterdir():
        Image.fromarray(change(np.asarray(Image.open(path)))).save(path)


OCMOTION_DAMAGES = {
    "inverted": (lambda f: edit_masks(f, lambda m: 255 - m), "inverted"),
    "mirrored": (lambda f: edit_masks(f, lambda m: np.ascontiguousarray(m[:, ::-1])), "mirrored"),
    "millimetres": (
        lambda f: rewrite(f, lambda w: [e.update(trans=[1000 * x for x in e["trans"]]) for e in w.values()]),
        "divide 'trans' by 1000",
    ),
    "no entry": (lambda f: rewrite(f, lambda w: w.pop("00003")), "00003"),
    "somebody else": (lambda f: edit_masks(f, lambda m: np.maximum(m, np.roll(m, 80, 1))), "other people, things"),
    "focal length": (
        lambda f: rewrite(
            f, lambda w: [e.update(cam_intrinsics=[[9, 0, 120], [0, 9, 90], [0, 0, 1]]) for e in w.values()]
        ),
        "focal length 9 px for 240×180 px",
    ),
    "twice": (lambda f: shutil.copy(f / "images" / "00001.png", f / "images" / "00001.jpg"), "00001"),
    "not JSON": (lambda f: cut(f / "metadata.json"), "metadata.json"),
    "infinite": (lambda f: rewrite(f, lambda w: w["00001"].update(trans=[0, 0, float("inf")])), "trans"),
}


@pytest.mark.parametrize("name", OCMOTION_DAMAGES)
def test_data_check_names_the_damage_of_a_sequence(ocmotion, tmp_path, capsys, name):
    damage, words = OCMOTION_DAMAGES[name]
    shutil.copytree(ocmotion, tmp_path / "copy")
    assert _check(tmp_path, capsys)[0] == 0
    damage(tmp_path / "copy" / "standin-2")
    status, found = _check(tmp_path, capsys)
    assert status == 1
    assert words in " ".join(found["subjects"][0]["problems"]), found


def test_data_check_writes_a_picture_and_leaves_the_data_alone(ocmotion, tmp_path, capsys):
    before = {p: p.read_bytes() for p in ocmotion.rglob("*") if p.is_file()}
    status = main(["data", "check", str(ocmotion), "--overlays", str(tmp_path / "seen"), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert status == 0
    assert found["subjects"][0]["protocols"]["ocmotion_visible@2"].startswith("has 6 frames")
    picture = np.asarray(Image.open(tmp_path / "seen" / "standin-2.png"))
    assert picture.shape == (180, 3 * 240, 3)
    assert (picture == (0, 220, 255)).all(-1).any()  # the body's outline
    assert before == {p: p.read_bytes() for p in ocmotion.rglob("*") if p.is_file()}
    assert main(["data", "check", str(ocmotion), "--overlays", str(ocmotion / "x")]) == 2
    assert "never written to" in capsys.readouterr().err


def _check(tmp_path, capsys):
    capsys.readouterr()
    status = main(["data", "check", str(tmp_path / "copy"), "--overlays", str(tmp_path / "seen"), "--json"])
    out = capsys.readouterr().out
    return status, json.loads(out) if out else {}


def test_the_video_is_close_to_what_was_filmed(tmp_path, monkeypatch):
    """The codec loses something, as in the real data; the colours and the order of the frames it keeps."""
    filmed = []

    def recording(path, frames):
        filmed.extend(frames)
        real(path, filmed)

    real = people_snapshot.write_video
    monkeypatch.setattr(people_snapshot_capture, "N_FRAMES", 3)
    monkeypatch.setattr(people_snapshot_capture, "SIZE", 180)
    monkeypatch.setattr(people_snapshot, "write_video", recording)
    root = PeopleSnapshotStandIn.ensure(tmp_path / "root", 0, ["standin-1"], {})
    capture = people_snapshot.PeopleSnapshotRaw(root).open("standin-1")
    for k in (2, 0, 1):
        quality = [psnr(capture.image(0, k), picture) for picture in filmed]
        assert quality[k] > 25
        assert quality[k] == max(quality)
        assert psnr(capture.image(0, k)[..., ::-1], filmed[k]) < quality[k] - 5  # RGB, not BGR


MAKERS = {
    "zju_mocap": ("zju_capture.ZjuStandIn.ensure(root, seed, ['standin-1'], {0: [0], 7: [0]})", "zju_capture"),
    "ocmotion": (
        "ocmotion_capture.N_FRAMES, ocmotion_capture.WIDTH, ocmotion_capture.HEIGHT = 4, 240, 180\n"
        "ocmotion_capture.OcMotionStandIn.ensure(root, seed, ['standin-1'], {})",
        "ocmotion_capture",
    ),
    "people_snapshot": (
        "people_snapshot_capture.N_FRAMES, people_snapshot_capture.SIZE = 4, 180\n"
        "people_snapshot_capture.PeopleSnapshotStandIn.ensure(root, seed, ['standin-1'], {})",
        "people_snapshot_capture",
    ),
}
PRELUDE = """
import sys, time
from pathlib import Path
from ihbench.datasets.standin import {module}, outfit
from ihbench.errors import BadInput
from ihbench.clock.progress import Progress
outfit.TEXTURE_SIZE = {texture}
root, seed, gate = Path(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
(gate / str(time.monotonic_ns())).touch()
while len(list(gate.iterdir())) < int(sys.argv[4]):
    time.sleep(0.001)
try:
    {call}
except BadInput as error:
    print(error)
    sys.exit(2)
"""


def _start(call, module, root, gate, seeds, together):
    code = PRELUDE.format(texture=TEXTURE, module=module, call=call.replace("\n", "\n    "))
    return [
        subprocess.Popen(
            [sys.executable, "-c", code, str(root), str(seed), str(gate), str(together)],
            stdout=subprocess.PIPE,
            text=True,
        )
        for seed in seeds
    ]


def _made(root):
    files = [path for path in root.rglob("*") if path.is_file() and not path.name.startswith(".")]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


@pytest.mark.parametrize("name", MAKERS)
def test_two_processes_make_one_stand_in(name, tmp_path):
    """In an empty folder, at one moment: one makes it, the other waits; what a dead one left is completed."""
    (tmp_path / "gate").mkdir()
    together = _start(*MAKERS[name], tmp_path / "shared", tmp_path / "gate", [0, 0], 2)
    assert [(process.communicate()[0], process.returncode) for process in together] == [("", 0)] * 2
    (tmp_path / "own").mkdir()
    killed = _start(*MAKERS[name], tmp_path / "alone", tmp_path / "own", [0], 1)[0]
    while not any((tmp_path / "alone").glob("*standin-1/*")) and killed.poll() is None:
        time.sleep(0.005)
    killed.kill()
    killed.wait()
    (again,) = _start(*MAKERS[name], tmp_path / "alone", tmp_path / "own", [0], 1)
    assert (again.communicate()[0], again.returncode) == ("", 0)
    skipped = {"standin-1/standin-1.mp4"}  # a video's bytes hold the time
    shared, alone = ({k: v for k, v in _made(tmp_path / f).items() if k not in skipped} for f in ("shared", "alone"))
    assert shared.keys() == alone.keys()
    assert [key for key in shared if shared[key] != alone[key]] == []


def test_two_casts_in_one_folder(tmp_path):
    """The quicker has it; the other is told, and has written nothing."""
    (tmp_path / "gate").mkdir()
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / ".DS_Store").touch()  # file browsers leave it in an empty folder
    call, module = MAKERS["zju_mocap"]
    ends = [
        (p.communicate()[0], p.returncode)
        for p in _start(call, module, tmp_path / "root", tmp_path / "gate", [0, 1], 2)
    ]
    assert sorted(status for _, status in ends) == [0, 2]
    (words,) = [said for said, status in ends if status == 2]
    assert "holds another stand-in (seed" in words


@pytest.mark.parametrize("name", MAKERS)
def test_a_full_disk_leaves_what_can_be_completed(name, tmp_path):
    call, module = MAKERS[name]
    limit = (
        "import resource, signal\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))\n"
    )
    # once without a limit, which compiles kernels: of one picture, or of two frames
    first = call.replace("root", "gate").replace(", 7: [0]", "").replace("= 4, ", "= 2, ")
    assert first.replace("gate", "root") != call
    calls = f"{first}\n{limit}{call}"
    (tmp_path / "gate").mkdir()
    code = PRELUDE.replace("(gate /", "(gate.parent /").format(
        texture=TEXTURE, module=module, call=calls.replace("\n", "\n    ")
    )
    words = [str(tmp_path / "root"), "0", str(tmp_path / "gate"), "0"]
    full = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert full.returncode == 2, full.stderr
    assert len(full.stdout.splitlines()) == 1
    (tmp_path / "room").mkdir()
    (room,) = _start(call, module, tmp_path / "root", tmp_path / "room", [0], 1)
    assert (room.communicate()[0], room.returncode) == ("", 0)
