"""The ZJU-MoCap loader and writer on a tiny capture of two cameras and three frames."""

import dataclasses
import json
import os
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.datasets.zju_mocap import original as zju_mocap
from ihbench.datasets.zju_mocap.original import ZjuMocap
from ihbench.errors import BadInput

WIDTH, HEIGHT = 64, 48
N_CAMERAS, N_FRAMES = 2, 3


def rotations(rng, n, largest=np.pi):
    axes = rng.normal(size=(n, 3))
    return axes / np.linalg.norm(axes, axis=1, keepdims=True) * rng.uniform(0, largest, (n, 1))


def make_cameras():
    cameras = []
    for k in range(N_CAMERAS):
        R, t = look_at([3 * np.cos(k), 3 * np.sin(k), 1.2], [0, 0, 1], up=(0, 0, 1))
        K = np.array([[50 + k, 0, 31.5], [0, 51 + k, 24.7], [0, 0, 1]])
        cameras.append(Camera(K, R, t, WIDTH, HEIGHT, np.array([-0.1, 0.03, 1e-3, -2e-3, 0.01 * k])))
    return cameras


def make_pose(rng):
    return BodyPose(rotations(rng, 24, 0.8), rng.normal(size=10), rng.normal(size=3))


@pytest.fixture(scope="module")
def smpl():
    """A body that counts as the user's SMPL file."""
    return dataclasses.replace(load_body(), name="smpl")


@pytest.fixture(scope="module")
def written(tmp_path_factory, smpl):
    """What was written and where: (root, cameras, poses, images, masks, cihp)."""
    root = tmp_path_factory.mktemp("zju")
    folder = root / "CoreView_377"
    rng = np.random.default_rng(0)
    cameras, paths = make_cameras(), zju_mocap.standard_image_paths(N_CAMERAS, N_FRAMES)
    poses = [make_pose(rng) for _ in range(N_FRAMES)]
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    zju_mocap.write_annots(folder, cameras, paths)
    images, masks, cihp = {}, {}, {}
    for frame in range(N_FRAMES):
        zju_mocap.write_params(folder, frame, poses[frame], smpl)
        zju_mocap.write_vertices(folder, frame, smpl.pose(poses[frame]))
        for camera in range(N_CAMERAS):
            smooth = np.stack([4 * x, 5 * y, 60 * (camera + 1) + 0 * x + frame], -1)
            key = camera, frame
            images[key] = np.clip(smooth, 0, 255).astype(np.uint8)
            masks[key] = (x - 20 - frame) ** 2 + (y - 20) ** 2 < 200
            cihp[key] = np.where((x - 24) ** 2 + (y - 20) ** 2 < 200, 13, 0).astype(np.uint8)
            zju_mocap.write_frame(folder, paths[frame][camera], images[key], masks[key], cihp[key])
    return root, cameras, poses, images, masks, cihp


@pytest.fixture
def copy(written, tmp_path):
    """A copy to damage: the subject's folder."""
    shutil.copytree(written[0], tmp_path / "zju")
    return tmp_path / "zju" / "CoreView_377"


def write_annots_dict(folder, content):
    np.save(folder / "annots.npy", np.array(content, dtype=object), allow_pickle=True)


def annots_dict(folder):
    return np.load(folder / "annots.npy", allow_pickle=True).item()


def message(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# ----------------------------------------------------------------------------------- what is read back


def test_reading_gives_back_what_was_written(written, smpl):
    root, cameras, poses, images, masks, cihp = written
    capture = ZjuMocap(root).open("377", body=smpl)
    assert (capture.name, capture.dataset, capture.variant) == ("377", "zju_mocap", "original/new_params")
    assert (capture.standin, capture.body, capture.n_frames) == ("", "smpl", N_FRAMES)
    assert capture.camera_ids == ("Camera_B1", "Camera_B2")
    for k, camera in enumerate(cameras):
        read = capture.camera(k)
        for name in ("K", "R", "t", "distortion"):
            np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=1e-6)
        assert (read.width, read.height) == (WIDTH, HEIGHT)
    for frame, pose in enumerate(poses):
        read = capture.body_pose(frame)
        np.testing.assert_allclose(read.pose, pose.pose, atol=1e-6)
        np.testing.assert_allclose(read.betas, pose.betas, atol=1e-6)
        np.testing.assert_allclose(read.transl, pose.transl, atol=1e-6)
        np.testing.assert_allclose(capture.vertices(frame), smpl.pose(pose), atol=1e-5)
    for key in images:
        assert np.abs(capture.image(*key).astype(int) - images[key]).mean() < 2
        np.testing.assert_array_equal(capture.silhouette(*key), masks[key])
        np.testing.assert_array_equal(capture.silhouette(*key, "mask_cihp"), cihp[key] > 0)
        np.testing.assert_array_equal(capture.silhouette(*key, "union"), masks[key] | (cihp[key] > 0))


def test_stored_calibration_is_opencv_in_millimetres(written):
    root, cameras, *_ = written
    cams = annots_dict(root / "CoreView_377")["cams"]
    for k, camera in enumerate(cameras):
        np.testing.assert_allclose(cams["K"][k][:2, 2], camera.K[:2, 2] - 0.5)
        np.testing.assert_allclose(cams["T"][k], 1000 * camera.t.reshape(3, 1))
        assert cams["D"][k].shape == (5, 1)
        assert 2500 < np.linalg.norm(cams["T"][k]) < 3500


def test_stored_root_is_about_the_model_origin(written, smpl):
    """v = R(Rh) v_zero_root + Th, as NeuralBody's body_model.py poses it."""
    root, _, poses, *_ = written
    for frame, pose in enumerate(poses):
        stored = np.load(root / f"CoreView_377/new_params/{frame}.npy", allow_pickle=True).item()
        assert {key: np.shape(value) for key, value in stored.items()} == {
            "poses": (1, 72),
            "shapes": (1, 10),
            "Rh": (1, 3),
            "Th": (1, 3),
        }
        zero_root = stored["poses"].reshape(24, 3)
        assert not zero_root[0].any()
        posed = smpl.pose(BodyPose(zero_root, stored["shapes"][0], np.zeros(3)))
        vertices = Rotation.from_rotvec(stored["Rh"][0]).apply(posed) + stored["Th"]
        np.testing.assert_allclose(vertices, smpl.pose(pose), atol=1e-9)


def test_annots_are_readable_by_numpy_1(written):
    assert b"numpy._core" not in (written[0] / "CoreView_377" / "annots.npy").read_bytes()


def test_pose_without_root_entries_is_accepted(copy, smpl):
    path = copy / "new_params" / "0.npy"
    stored = np.load(path, allow_pickle=True).item()
    expected = ZjuMocap(copy.parent).open("377", smpl).body_pose(0)
    stored["poses"] = stored["poses"][:, 3:]
    np.save(path, np.array(stored, dtype=object), allow_pickle=True)
    np.testing.assert_array_equal(ZjuMocap(copy.parent).open("377", smpl).body_pose(0).pose, expected.pose)


def test_older_fit_is_used_when_it_is_the_only_one(copy, smpl):
    (copy / "new_params").rename(copy / "params")
    (copy / "new_vertices").rename(copy / "vertices")
    capture = ZjuMocap(copy.parent).open("377", smpl)
    assert capture.variant == "original/params"
    np.testing.assert_allclose(smpl.pose(capture.body_pose(1)), capture.vertices(1), atol=1e-5)


def test_newer_fit_wins_over_the_older_one(copy):
    shutil.copytree(copy / "new_params", copy / "params")
    assert ZjuMocap(copy.parent).open("377").variant == "original/new_params"


def test_subjects_are_in_natural_order(written, tmp_path):
    for name in ("CoreView_10", "CoreView_9", "CoreView_313", "CoreView_a"):
        (tmp_path / name).mkdir()
    (tmp_path / "notes.txt").touch()
    assert ZjuMocap(tmp_path).subjects() == ["9", "10", "313", "a"]


def test_parameters_follow_the_number_in_the_image_name(copy, smpl):
    """313 and 315: 'Camera (1)/CoreView_313_Camera_(1)_0001_….jpg', parameters counted from 1."""
    content = annots_dict(copy)
    for frame, entry in enumerate(content["ims"]):
        entry["ims"] = [f"Camera ({c + 1})/CoreView_313_Camera_({c + 1})_{frame + 1:04d}_2019.jpg" for c in range(2)]
    write_annots_dict(copy, content)
    for frame in reversed(range(N_FRAMES)):
        (copy / f"new_params/{frame}.npy").rename(copy / f"new_params/{frame + 1}.npy")
        (copy / f"new_vertices/{frame}.npy").rename(copy / f"new_vertices/{frame + 1}.npy")
    capture = ZjuMocap(copy.parent).open("377", smpl)
    assert capture.camera_ids == ("Camera (1)", "Camera (2)")
    for frame in range(N_FRAMES):
        np.testing.assert_allclose(smpl.pose(capture.body_pose(frame)), capture.vertices(frame), atol=1e-5)
    assert capture.mask_path(1, 2).parent == copy / "mask" / "Camera (2)"


def test_palette_masks_are_read_by_index(copy):
    """Part label PNGs often are palette images, where entry 3 may well be painted black."""
    path = copy / "mask_cihp/Camera_B1/000000.png"
    labels = np.zeros((HEIGHT, WIDTH), np.uint8)
    labels[10:20, 10:20] = 3
    picture = Image.fromarray(labels).convert("P")
    picture.putpalette([0] * 768)
    picture.save(path)
    np.testing.assert_array_equal(ZjuMocap(copy.parent).open("377").silhouette(0, 0, "mask_cihp"), labels > 0)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA"])
def test_masks_with_more_channels(copy, written, mode):
    """Grey as colour, or with an opaque alpha channel, is the same mask."""
    mask = written[4][0, 0]
    Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).convert(mode).save(copy / "mask/Camera_B1/000000.png")
    np.testing.assert_array_equal(ZjuMocap(copy.parent).open("377").silhouette(0, 0), mask)


# ------------------------------------------------------------------------------------------- bad input


def test_no_subject_folder_says_where_there_is_one(tmp_path):
    with pytest.raises(BadInput, match=r"no subject of this layout in it; expected CoreView_"):
        ZjuMocap(tmp_path)
    (tmp_path / "ZJU-MoCap" / "CoreView_377").mkdir(parents=True)
    with pytest.raises(BadInput, match=r"there is one in .*ZJU-MoCap, give that folder"):
        ZjuMocap(tmp_path)


def test_no_parameter_folder(copy):
    shutil.rmtree(copy / "new_params")
    with pytest.raises(BadInput, match="neither new_params nor params"):
        ZjuMocap(copy.parent).open("377")


def with_cams(**changes):
    def damage(content):
        content["cams"].update(changes)

    return damage


def without_key(content):
    del content["cams"]["D"]


def one_path_short(content):
    content["ims"][1]["ims"] = content["ims"][1]["ims"][:1]


def path_that_escapes(content):
    content["ims"][2]["ims"][0] = "../../secret.jpg"


def no_frames(content):
    content["ims"] = []


def paths_are_numbers(content):
    content["ims"] = [1, 2, 3]


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (with_cams(K=[np.eye(4)] * 2), r"cams\['K'\] to be one array of shape \[3, 3\].*found \[4, 4\]"),
        (with_cams(D=[np.zeros((4, 1))] * 2), r"cams\['D'\].*shape \[5\].*found \[4\]"),
        (with_cams(R=[np.zeros((3, 1))] * 2), r"cams\['R'\].*found \[3, 1\]"),
        (with_cams(T=[np.zeros((2, 1))] * 2), r"cams\['T'\].*found \[2\]"),
        (with_cams(T=[np.zeros((3, 1)), np.zeros((2, 1))]), r"cams\['T'\].*found a list of other contents"),
        (with_cams(K=[np.full((3, 3), np.nan)] * 2), r"cams\['K'\].*NaN"),
        (with_cams(K=[np.eye(3)]), "found 1 K, 2 D, 2 R, 2 T"),
        (with_cams(R=[np.diag([1.0, 1.0, -1.0])] * 2), "expected rotations"),
        (with_cams(R=[2 * np.eye(3)] * 2), "expected rotations"),
        (with_cams(T=[np.array([[0.1], [0.2], [3.0]])] * 2), r"millimetres.*multiply T by 1000"),
        (without_key, r"cams\['D'\].*found a NoneType"),
        (one_path_short, "expected 2 image paths a frame.*found 1 in frame 1"),
        (path_that_escapes, "'../../secret.jpg' of frame 2 leads out"),
        (no_frames, "found no frame"),
        (paths_are_numbers, "found a list of other contents"),
        (lambda content: content.pop("cams"), "expected a dictionary with 'cams' and 'ims', found a dictionary"),
    ],
)
def test_annots_of_another_shape(copy, damage, expected):
    content = annots_dict(copy)
    damage(content)
    write_annots_dict(copy, content)
    with pytest.raises(BadInput, match=expected) as error:
        ZjuMocap(copy.parent).open("377")
    assert "annots.npy" in message(error)


def test_annots_that_is_a_plain_array(copy):
    np.save(copy / "annots.npy", np.zeros(3))
    with pytest.raises(BadInput, match="expected a dictionary"):
        ZjuMocap(copy.parent).open("377")


def test_camera_folder_missing(copy):
    shutil.rmtree(copy / "Camera_B2")
    capture = ZjuMocap(copy.parent).open("377")
    with pytest.raises(BadInput, match=r"Camera_B2: no such folder"):
        capture.camera(1)
    with pytest.raises(BadInput, match=r"no such file, nor its folder Camera_B2"):
        capture.image(1, 0)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"Rh": np.array([[np.nan, 0, 0]])}, "NaN or infinity in 'Rh'"),
        ({"Th": np.array([[np.inf, 0, 0]])}, "NaN or infinity in 'Th'"),
        ({"poses": np.zeros((1, 71))}, "expected 72 or 69 numbers in 'poses', found 71"),
        ({"shapes": np.zeros((1, 3))}, "numbers in 'shapes', found 3"),
        ({"Th": "here"}, "expected 'Th' to be numbers"),
        ({"poses": np.ones((1, 72))}, "expected zeros in its first three"),
    ],
)
def test_bad_parameters(copy, smpl, change, expected):
    path = copy / "new_params/1.npy"
    stored = np.load(path, allow_pickle=True).item() | change
    np.save(path, np.array(stored, dtype=object), allow_pickle=True)
    with pytest.raises(BadInput, match=expected) as error:
        ZjuMocap(copy.parent).open("377", smpl).body_pose(1)
    assert "new_params/1.npy" in message(error)


def test_parameters_and_vertices_missing_for_a_frame(copy, smpl):
    (copy / "new_params/2.npy").unlink()
    (copy / "new_vertices/2.npy").unlink()
    capture = ZjuMocap(copy.parent).open("377", smpl)
    capture.body_pose(1)
    with pytest.raises(BadInput, match=r"new_params/2.npy: no such file"):
        capture.body_pose(2)
    with pytest.raises(BadInput, match=r"new_vertices/2.npy: no such file"):
        capture.vertices(2)


# ----------------------------------------------------------------------------------- check and writing


def test_check_counts_what_is_there_and_what_is_missing(copy):
    (copy / "Camera_B1/000001.jpg").unlink()
    (copy / "mask/Camera_B2/000000.png").unlink()
    shutil.rmtree(copy / "mask_cihp")
    (copy / "new_vertices/2.npy").unlink()
    found = ZjuMocap.check(copy.parent)
    (subject,) = found.subjects
    assert (found.dataset, found.layout, found.standin, found.ok) == ("zju_mocap", "original", "", False)
    assert (subject.subject, subject.variant) == ("377", "original/new_params")
    assert (subject.cameras, subject.frames) == (N_CAMERAS, N_FRAMES)
    assert subject.missing == {"image": 1, "mask": 1, "mask_cihp": 6, "new_params": 0, "new_vertices": 1}
    assert subject.image_size == [[WIDTH, HEIGHT]]
    assert "1 of image missing" in subject.problems
    json.dumps(found.as_json())


def test_check_notices_vertices_outside_the_silhouettes(written):
    """The tiny capture's bodies stand anywhere: nothing ties them to its masks."""
    (subject,) = ZjuMocap.check(written[0]).subjects
    assert subject.vertices_in_mask < 0.95
    assert any("project into the silhouettes" in problem for problem in subject.problems)


def test_interrupted_write_leaves_the_old_file(written, tmp_path, monkeypatch):
    cameras, paths = written[1], zju_mocap.standard_image_paths(N_CAMERAS, N_FRAMES)
    zju_mocap.write_annots(tmp_path, cameras, paths)
    before = (tmp_path / "annots.npy").read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        zju_mocap.write_annots(tmp_path, cameras, paths[:1])
    assert (tmp_path / "annots.npy").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["annots.npy"]


def test_writer_refuses_paths_that_do_not_match_the_cameras(written, tmp_path):
    with pytest.raises(ValueError, match="2 image paths a frame"):
        zju_mocap.write_annots(tmp_path, written[1], [["Camera_B1/000000.jpg"]])
