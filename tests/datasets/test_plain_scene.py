"""The plain scene folder: written, read back, damaged, and checked."""

import dataclasses
import json
import shutil
import zipfile
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from ihbench.body import load_body, write_body
from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, look_at
from ihbench.commands import data
from ihbench.datasets.plain import plain_scene
from ihbench.datasets.plain.plain_scene import PlainScene, read_cameras, read_poses
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.render.zbuffer import rasterize
from ihbench.scene.data_source import open_dataset

WIDTH, HEIGHT = 64, 48
FRAMES = [3, 4, 10]
NAMES = ("left", "right")


def make_cameras():
    cameras = {}
    for k, name in enumerate(NAMES):
        R, t = look_at([2.2 * np.sin(k), 0.1, 2.2 * np.cos(k)], [0.25, -0.1, 0.1])
        K = np.array([[45 + k, 0, 31.3], [0, 46 + k, 23.7], [0, 0, 1]])
        cameras[name] = Camera(K, R, t, WIDTH, HEIGHT, np.array([-0.1, 0.03, 1e-3, -2e-3, 0.01]) if k else None)
    return cameras


def make_poses(body):
    rng = np.random.default_rng(0)
    poses = []
    for _ in FRAMES:
        pose = rng.normal(0, 0.1, (24, 3))
        pose[16, 2] = -1.1  # one arm down: not its own mirror image
        poses.append(BodyPose(pose, rng.normal(size=10), rng.normal(0, 0.05, 3)))
    return poses


def silhouette(body, pose, camera):
    return rasterize(camera.project(body.pose(pose)), body.faces, camera.height, camera.width).mask


def write_scene(folder, body, cameras=None, poses=None, numbers=FRAMES, own=True, root="smpl"):
    """A whole scene; (images, masks) by (camera, number)."""
    cameras, poses = cameras or make_cameras(), poses or make_poses(body)
    plain_scene.write_cameras(folder, cameras)
    plain_scene.write_poses(folder, poses, numbers, root, body)
    if own:
        write_body(folder / "body.npz", body)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    images, masks = {}, {}
    for k, (name, camera) in enumerate(cameras.items()):
        for number, pose in zip(numbers, poses, strict=True):
            smooth = np.stack([4 * x, 5 * y, 60 * (k + 1) + 0 * x + number], -1)
            images[name, number] = np.clip(smooth, 0, 255).astype(np.uint8)
            masks[name, number] = silhouette(body, pose, camera)
            plain_scene.write_frame(
                folder, number, images[name, number], masks[name, number], name if len(cameras) > 1 else None
            )
    return images, masks


@pytest.fixture(scope="module")
def own_body():
    """Somebody else's SMPL-shaped body, taller than the bench's."""
    body = load_body()
    return dataclasses.replace(body, v_template=1.1 * body.v_template, shapedirs=1.1 * body.shapedirs, name="tall")


@pytest.fixture(scope="module")
def written(tmp_path_factory, own_body):
    folder = tmp_path_factory.mktemp("plain") / "dance"
    return folder, *write_scene(folder, own_body)


@pytest.fixture
def copy(written, tmp_path):
    """A copy to damage."""
    shutil.copytree(written[0], tmp_path / "dance")
    return tmp_path / "dance"


def message(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    assert len(text) < 600
    return text


def problems_of(folder) -> list[str]:
    (subject,) = PlainScene.check(folder).subjects
    assert all("\n" not in problem for problem in subject.problems)
    return subject.problems


def change_json(path, change):
    content = json.loads(path.read_text())
    change(content["cameras"]["left"], content)
    path.write_text(json.dumps(content))


def change_npz(path, **arrays):
    old = dict(np.load(path)) | arrays
    np.savez(path, **{key: value for key, value in old.items() if value is not None})


# ----------------------------------------------------------------------------------- what is read back


def test_reading_gives_back_what_was_written(written, own_body):
    folder, images, masks = written
    capture = PlainScene(folder).open("dance")
    assert (capture.name, capture.dataset, capture.variant) == ("dance", "custom", "plain")
    assert (capture.standin, capture.body, capture.n_frames, capture.camera_ids) == ("", "own", 3, NAMES)
    for k, camera in enumerate(make_cameras().values()):
        read = capture.camera(k)
        for name in ("K", "R", "t"):
            np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=1e-12)
        assert (read.distortion is None) == (camera.distortion is None)
        if camera.distortion is not None:
            np.testing.assert_array_equal(read.distortion, camera.distortion)
        assert (read.width, read.height) == (WIDTH, HEIGHT)
    for frame, pose in enumerate(make_poses(own_body)):
        read = capture.body_pose(frame)
        for name in ("pose", "betas", "transl"):
            np.testing.assert_array_equal(getattr(read, name), getattr(pose, name))
        assert capture.number(frame) == FRAMES[frame]
    for (name, number), image in images.items():
        camera, frame = NAMES.index(name), FRAMES.index(number)
        np.testing.assert_array_equal(capture.image(camera, frame), image)
        np.testing.assert_array_equal(capture.silhouette(camera, frame), masks[name, number])
    assert capture.model.content_sha() == own_body.content_sha()
    assert capture.model.name == capture.body


@pytest.mark.parametrize("center", [0.0, 0.5])
def test_pixel_centres_are_as_the_file_says(center, tmp_path):
    camera = make_cameras()["left"]
    plain_scene.write_cameras(tmp_path, {"a": camera}, pixel_center=center)
    stored = json.loads((tmp_path / "cameras.json").read_text())["cameras"]["a"]
    np.testing.assert_allclose(stored["K"][0][2], 31.3 - 0.5 + center)
    np.testing.assert_allclose(read_cameras(tmp_path / "cameras.json")["a"].K, camera.K, atol=1e-12)
    del stored["pixel_center"]  # 0 unless said otherwise
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": {"a": stored}}))
    K = read_cameras(tmp_path / "cameras.json")["a"].K
    np.testing.assert_allclose(K[:2, 2], camera.K[:2, 2] + center, atol=1e-12)


def test_a_single_camera_needs_no_folder_and_jpeg_is_read(tmp_path, own_body):
    cameras = {"main": make_cameras()["left"]}
    images, masks = write_scene(tmp_path / "one", own_body, cameras)
    assert (tmp_path / "one/images/000003.png").is_file()
    (tmp_path / "one/images/000003.png").unlink()
    plain_scene.write_frame(tmp_path / "one", 3, images["main", 3], ending="jpg")
    capture = PlainScene(tmp_path / "one").open("one")
    assert np.abs(capture.image(0, 0).astype(int) - images["main", 3]).mean() < 2
    np.testing.assert_array_equal(capture.silhouette(0, 0), masks["main", 3])
    assert problems_of(tmp_path / "one") == []
    for kind in ("images", "masks"):  # in a folder of its name it is found as well
        (tmp_path / "one" / kind).rename(tmp_path / "moved")
        (tmp_path / "one" / kind).mkdir()
        (tmp_path / "moved").rename(tmp_path / "one" / kind / "main")
    capture = PlainScene(tmp_path / "one").open("one")
    np.testing.assert_array_equal(capture.silhouette(0, 0), masks["main", 3])


def test_masks_of_any_kind(copy, written):
    person = written[2]["left", 3]
    path = copy / "masks/left/000003.png"
    opaque = np.full_like(person, 255, np.uint8)
    for picture in (
        Image.fromarray(person.astype(np.uint8)),  # 0 and 1
        Image.fromarray(person),  # one bit
        Image.fromarray(np.dstack([person * np.uint8(7)] * 3 + [opaque])),  # colour, alpha ignored
        Image.fromarray(np.dstack([person * np.uint8(7), opaque]), "LA"),
        Image.fromarray(person.astype(np.uint16) * 256),
    ):
        picture.save(path)
        np.testing.assert_array_equal(PlainScene(copy).open("dance").silhouette(0, 0), person)


def test_sixteen_bits_are_scaled(copy, written):
    image = written[1]["left", 3]
    assert cv2.imwrite(str(copy / "images/left/000003.png"), image[..., 1].astype(np.uint16) * 257)
    capture = PlainScene(copy).open("dance")
    np.testing.assert_array_equal(capture.image(0, 0), np.repeat(image[..., 1:2], 3, 2))
    Image.fromarray(image[..., 1].astype(np.float32)).save(copy / "images/left/000003.png", "TIFF")
    assert any("floating-point" in problem for problem in problems_of(copy))


def test_poses_in_every_layout(copy, own_body):
    poses = make_poses(own_body)
    path = copy / "poses.npz"
    stacked = np.stack([pose.pose for pose in poses])
    change_npz(path, pose=stacked.reshape(3, 72).astype(np.float32), betas=np.float32([1, 2]), frames=None, root=None)
    read = read_poses(path)
    np.testing.assert_allclose(read.pose, stacked, atol=1e-7)
    np.testing.assert_array_equal(read.betas, np.tile([1, 2], (3, 1)))
    np.testing.assert_array_equal(read.frames, [0, 1, 2])
    change_npz(path, frames=np.array([7, 2, 5], np.uint16), betas=np.ones((1, 10)))
    read = read_poses(path)
    np.testing.assert_array_equal(read.frames, [2, 5, 7])
    np.testing.assert_allclose(read.pose, stacked[[1, 2, 0]], atol=1e-7)
    np.testing.assert_array_equal(read.transl[2], poses[0].transl)


def test_the_zju_root_is_understood(tmp_path, own_body):
    poses = make_poses(own_body)
    off_centre = dataclasses.replace(own_body, v_template=own_body.v_template + np.array([0.02, -0.25, 0.03]))
    plain_scene.write_cameras(tmp_path / "z", make_cameras())
    write_body(tmp_path / "z" / "body.npz", off_centre)
    plain_scene.write_poses(tmp_path / "z", poses, root="zju", body=off_centre)
    capture = PlainScene(tmp_path / "z").open("z")
    for frame, pose in enumerate(poses):
        np.testing.assert_allclose(capture.body_pose(frame).pose, pose.pose, atol=1e-14)
        np.testing.assert_allclose(capture.body_pose(frame).transl, pose.transl, atol=1e-14)
        stored = read_poses(tmp_path / "z/poses.npz")
        no_root = pose.pose.copy()
        no_root[0] = 0
        at_rest = off_centre.pose(BodyPose(no_root, pose.betas, np.zeros(3)))
        moved = at_rest @ Rotation.from_rotvec(stored.pose[frame, 0]).as_matrix().T + stored.transl[frame]
        np.testing.assert_allclose(moved, off_centre.pose(pose), atol=1e-12)


def test_a_body_without_texture_coordinates_gets_an_atlas(copy, own_body):
    arrays = dict(np.load(copy / "body.npz"))
    np.savez(copy / "body.npz", **{key: value for key, value in arrays.items() if key not in ("vt", "ft")})
    model = PlainScene(copy).open("dance").model
    assert model.uv_faces.shape == model.faces.shape
    assert 0 <= model.uv.min() < model.uv.max() <= 1
    np.testing.assert_array_equal(model.v_template, own_body.v_template)


# ---------------------------------------------------------------------------------------------- bodies


def test_which_body_a_scene_needs(written, copy, own_body):
    smpl = dataclasses.replace(load_body(), name="smpl")
    with pytest.raises(BadInput, match=r"body\.npz.*its own body") as error:
        PlainScene(copy).open("dance", body=smpl)
    message(error)
    capture = PlainScene(copy).open("dance")
    assert PlainScene(copy).open("dance", body=capture.model).body == "own"
    (copy / "body.npz").unlink()
    capture = PlainScene(copy).open("dance")
    assert capture.body == "smpl"
    capture.body_pose(0)
    with pytest.raises(BadInput, match="SMPL"):
        _ = capture.model
    with pytest.raises(BadInput, match="procedural body was given"):
        PlainScene(copy).open("dance", body=load_body())
    assert PlainScene(copy).open("dance", body=smpl).model is smpl


@pytest.mark.parametrize("where", [".", ".."])
def test_a_marked_folder_is_a_stand_in(where, copy):
    (copy / "body.npz").unlink()
    body = load_body()
    mark = {"generator": "ihbench", "version": 1, "seed": 0, "body": body.name, "body_sha": body.content_sha()}
    atomic.write_json(copy / where / "STANDIN.json", mark)
    capture = PlainScene(copy).open("dance")
    assert (capture.standin, capture.body) == ("stand-in v1 seed 0", "procedural")
    assert capture.model is body


@pytest.mark.parametrize("damage", ["truncated", "flipped", "text", "empty"])
def test_damaged_body_files_are_bad_input(damage, copy):
    path = copy / "body.npz"
    data = bytearray(path.read_bytes())
    if damage == "flipped":
        data[len(data) // 2] ^= 0xFF
    path.write_bytes({"truncated": data[: len(data) // 2], "flipped": data, "text": b"body", "empty": b""}[damage])
    with pytest.raises(BadInput, match=r"body\.npz") as error:
        _ = PlainScene(copy).open("dance").model
    message(error)


# --------------------------------------------------------------------------------------------- folders


def test_several_scenes_are_named_by_folder_or_file(tmp_path, own_body):
    for name in ("a", "b"):
        plain_scene.write_cameras(tmp_path / name, make_cameras())
        plain_scene.write_poses(tmp_path / name, make_poses(own_body))
    atomic.write_json(tmp_path / "b" / "scene.json", {"name": "zoe walks", "about": "filmed in the yard"})
    (tmp_path / "notes").mkdir()
    dataset = PlainScene(tmp_path)
    assert dataset.subjects() == ["a", "zoe walks"]
    assert dataset.open("zoe walks").about == "filmed in the yard"
    with pytest.raises(BadInput, match="did you mean 'zoe walks'"):
        dataset.open("zoe walk")
    atomic.write_json(tmp_path / "b" / "scene.json", {"name": "a", "about": ""})
    with pytest.raises(BadInput, match="named 'a'"):
        PlainScene(tmp_path)
    for name in ("", "x/y", "..", "a\nb"):
        atomic.write_json(tmp_path / "b" / "scene.json", {"name": name, "about": ""})
        with pytest.raises(BadInput, match=r"scene\.json"):
            PlainScene(tmp_path)
        for look in (partial(open_dataset, "custom"), lambda folder: data.main(["check", str(folder)])):
            with pytest.raises(BadInput, match=r"scene\.json: name .*; rename it$"):  # and not "did you mean" a/
                look(tmp_path)
    (tmp_path / "b/scene.json").write_text('["name"]')
    with pytest.raises(BadInput, match=r"scene\.json"):
        PlainScene(tmp_path)


# ------------------------------------------------------------------------------------------- bad files


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("K", [[1, 0], [0, 1]], r"'K' to be numbers of shape \[3, 3\]"),
        ("K", [[-50, 0, 30], [0, 50, 20], [0, 0, 1]], "fx, fy > 0"),
        ("K", [[50, 0, 30], [0, 50, 20], [0, 0, 2]], "fx, fy > 0"),
        ("K", "wide", "expected 'K' to be numbers"),
        ("K", [[50, 0, "nan"], [0, 50, 20], [0, 0, 1]], "NaN"),
        ("R", [[2, 0, 0], [0, 2, 0], [0, 0, 2]], "expected rotations"),
        ("R", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "left-handed"),
        ("R", None, "expected 'R' to be numbers"),
        ("t", [[0], [1]], r"'t' to be numbers of shape \[3\], found \[2, 1\]"),
        ("t", [0, 0, "inf"], "infinity"),
        ("t", [0, 0, 10**400], "expected 't' to be numbers"),
        ("width", 64.5, "width"),
        ("width", True, "width"),
        ("height", 0, "height"),
        ("height", None, "height"),
        ("distortion", [0.1], "distortion"),
        ("pixel_center", 1, "pixel_center"),
        ("pixel_center", [0.5], "pixel_center"),
        ("pixel_centre", 0.5, "did you mean 'pixel_center'"),
    ],
)
def test_wrong_cameras_are_bad_input(key, value, text, copy):
    change_json(copy / "cameras.json", lambda camera, _: camera.update({key: value}))
    with pytest.raises(BadInput, match=rf"cameras\.json: camera 'left': .*{text}") as error:
        PlainScene(copy).open("dance")
    message(error)
    assert len(problems_of(copy)) == 1


@pytest.mark.parametrize("key", ["K", "R", "t", "width", "height"])
def test_missing_camera_keys_are_bad_input(key, copy):
    change_json(copy / "cameras.json", lambda camera, _: camera.pop(key))
    with pytest.raises(BadInput, match=f"{key}.*expected|expected '{key}'"):
        PlainScene(copy).open("dance")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("{", "not valid JSON"),
        ("[]", "found no camera"),
        ('{"cameras": {}}', "found no camera"),
        ('{"cameras": {"a": 3}}', "expected a dictionary"),
        ('{"cameras": {"../a": {}}}', "camera id"),
        ('{"cameras": {"a": {}}, "pixel_center": 0.5}', "unknown key 'pixel_center'"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_wrong_camera_files_are_bad_input(content, text, copy):
    (copy / "cameras.json").write_text(content)
    with pytest.raises(BadInput, match=rf"cameras\.json.*{text}") as error:
        PlainScene(copy).open("dance")
    message(error)


NAN_POSE = np.zeros((3, 72))
NAN_POSE[1, 5] = np.nan


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ({"pose": None}, "no array 'pose'"),
        ({"transl": None}, "no array 'transl'"),
        ({"pose": np.zeros((3, 69))}, r"\[N, 72\].*without the root"),
        ({"pose": np.zeros((3, 165))}, r"\[N, 72\].*165 are SMPL-X"),
        ({"pose": np.zeros((3, 22, 3))}, r"\[N, 72\].*66 are SMPL-X"),
        ({"pose": np.zeros(72)}, r"\[N, 72\]"),
        ({"pose": np.zeros((0, 72))}, r"\[N, 72\]"),
        ({"pose": NAN_POSE}, "NaN or infinity in row 1"),
        ({"pose": np.full((3, 72), 90.0)}, "degrees"),
        ({"pose": np.full((3, 72), "a")}, "expected numbers"),
        ({"transl": np.zeros((2, 3))}, "transl"),
        ({"transl": np.full((3, 3), np.inf)}, "transl"),
        ({"betas": np.zeros((2, 10))}, "betas"),
        ({"betas": np.zeros((3, 0))}, "betas"),
        ({"frames": np.arange(4)}, "3 whole numbers"),
        ({"frames": np.array([1.0, 2, 3])}, "whole numbers"),
        ({"frames": np.array([1, 2, 1])}, "number 1 appears twice"),
        ({"frames": np.array([-1, 2, 1])}, "-1 to 2"),
        ({"root": np.array("pelvis")}, "smpl or zju"),
        ({"root": np.array(["smpl"])}, "smpl or zju"),
        ({"poses": np.zeros((3, 72))}, "did you mean 'pose'"),
    ],
)
def test_wrong_poses_are_bad_input(arrays, text, copy):
    change_npz(copy / "poses.npz", **arrays)
    with pytest.raises(BadInput, match=rf"poses\.npz: .*{text}") as error:
        PlainScene(copy).open("dance")
    message(error)
    assert len(problems_of(copy)) == 1


def test_damaged_pose_files_are_bad_input(copy, tmp_path):
    path = copy / "poses.npz"
    data = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = same = 0
    for _ in range(150):
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 4):
            changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        try:
            read_poses(path)
        except BadInput as error:
            refused += "\n" not in str(error)
        else:
            same += 1
    assert refused + same == 150
    assert refused > 100
    for content in (b"", b"PK\x03\x04", data[:1000], data[-1000:], b"\x80\x04N."):
        path.write_bytes(content)
        with pytest.raises(BadInput, match=r"poses\.npz"):
            read_poses(path)
    path.unlink()
    np.save(tmp_path / "array.npy", np.zeros(3))
    (tmp_path / "array.npy").rename(path)
    with pytest.raises(BadInput, match=r"poses\.npz"):
        read_poses(path)
    path.unlink()
    with pytest.raises(BadInput, match="no such file"):
        PlainScene(copy).open("dance")


def test_pickles_and_giants_in_a_pose_file_are_bad_input(copy, monkeypatch):
    path = copy / "poses.npz"
    change_npz(path, pose=np.array([{}], object))
    with pytest.raises(BadInput, match="plain arrays"):
        read_poses(path)
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,)}"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pose.npy", b"\x93NUMPY\x01\x00\x50\x00" + header.ljust(79) + b"\n")
    with pytest.raises(BadInput, match=r"poses\.npz"):
        read_poses(path)
    monkeypatch.setattr(plain_scene, "LARGEST_POSES", 2**20)
    np.savez_compressed(path, pose=np.zeros((2000, 72)))
    with pytest.raises(BadInput, match=r"an array of 1152128 bytes"):
        read_poses(path)


# ----------------------------------------------------------------------------------------------- check


def test_check_of_a_good_scene(written):
    found = PlainScene.check(written[0])
    (subject,) = found.subjects
    assert found.ok, subject.problems
    assert (found.dataset, found.layout, found.standin) == ("custom", "plain", "")
    assert subject.vertices_in_mask > 0.98
    assert subject.mask_on_body > 0.98
    assert subject.body_used == "own"
    expected = {"subject": "dance", "variant": "plain", "body": "own", "cameras": 2, "frames": 3}
    expected |= {"files": {"image": 6, "mask": 6}, "missing": {"image": 0, "mask": 0, "pose": 0}}
    expected |= {"sampled_images": 6, "image_size": [[WIDTH, HEIGHT]]}
    assert {key: getattr(subject, key) for key in expected} == expected
    json.dumps(atomic.encode(found.as_json()))


def smpl_like():
    """A body whose pelvis lies where SMPL has it."""
    body = load_body()
    return dataclasses.replace(body, v_template=body.v_template + np.array([0.0, -0.235, 0.03]), name="smpl")


@pytest.mark.parametrize("root", ["smpl", "zju"])
def test_check_without_the_smpl_model(root, tmp_path):
    body = smpl_like()
    poses = [
        BodyPose(pose.pose, 0.5 * pose.betas, pose.transl + np.array([0, 0.235, -0.03])) for pose in make_poses(body)
    ]
    write_scene(tmp_path / "s", body, poses=poses, own=False, root=root)
    (subject,) = PlainScene.check(tmp_path / "s").subjects
    assert subject.problems == []
    assert subject.body_used.startswith("procedural")
    assert subject.vertices_in_mask > 0.85
    (subject,) = PlainScene.check(tmp_path / "s", body=body).subjects
    assert subject.body_used == "smpl"
    assert subject.vertices_in_mask > 0.98


def test_check_names_missing_files(copy):
    (copy / "masks/left/000004.png").unlink()
    (copy / "images/right/000010.png").unlink()
    plain_scene.write_frame(copy, 77, np.zeros((HEIGHT, WIDTH, 3), np.uint8), camera_id="left")
    (subject,) = PlainScene.check(copy).subjects
    what_to_do = "copy the files, or leave these frames out of poses.npz"
    assert subject.problems == [
        f"1 images of camera 'left' have no mask; the first is frame 4: {what_to_do}",
        f"1 poses have no image of camera 'right'; the first is frame 10: {what_to_do}",
    ]
    pose_less = "1 images of camera 'left' have no pose in poses.npz and are not used; the first is frame 77"
    assert subject.warnings == [pose_less]
    assert subject.missing == {"image": 1, "mask": 1, "pose": 1}


def test_check_names_files_it_does_not_understand(copy):
    shutil.copy(copy / "images/left/000003.png", copy / "images/left/3.png")
    shutil.copy(copy / "images/left/000003.png", copy / "images/left/frame_000003.png")
    shutil.copytree(copy / "images/left", copy / "images/lift")
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(copy / "masks/left/000003.jpg")
    problems = problems_of(copy)
    assert any("000003.png and 3.png are both frame 3" in problem for problem in problems)
    assert any("frame_000003.png: 1 such names are ignored" in problem for problem in problems)
    assert any("000003.jpg: 1 such names are ignored; expected <frame number>.png" in p for p in problems)
    assert any("lift: cameras.json has no camera of this name" in problem for problem in problems)
    with pytest.raises(BadInput, match=r"000003\.png and 3\.png are both frame 3"):
        PlainScene(copy).open("dance").image(0, 0)


def renamed(pattern, name):
    def change(folder):
        for path in sorted(folder.rglob(pattern)):
            path.rename(path.with_name(name(path.name)))

    return change


def with_mark(folder):
    for path in (folder / "cameras.json", folder / "scene.json"):
        text = path.read_text() if path.is_file() else '{"about": "a\\u0301"}'
        path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())


def with_litter(folder):
    for place in (folder, folder / "images" / "left", folder / "masks" / "left", folder / "images"):
        for name in (".DS_Store", "Thumbs.db", "desktop.ini", "._000003.png", "._cameras.json", "000003.png~"):
            (place / name).write_bytes(b"\0\5\x16\7")
    (folder / "__MACOSX").mkdir()


def linked(folder):
    for path in sorted(folder.rglob("*.png")):
        path.rename(path.with_suffix(".real"))
        path.symlink_to(path.with_suffix(".real").name)


def accented(folder):
    """As macOS stores the names of what a JSON file writes in another form."""
    change_json(
        folder / "cameras.json", lambda _, all: all["cameras"].update({"l\u00e9ft": all["cameras"].pop("left")})
    )
    for kind in ("images", "masks"):
        (folder / kind / "left").rename(folder / kind / "le\u0301ft")


QUIRKS = {
    "upper-case endings": renamed("*.png", lambda name: name.replace(".png", ".PNG")),
    "mixed endings": renamed("*3.png", lambda name: name.replace(".png", ".Png")),
    "upper-case JSON": renamed("*.json", str.upper),
    "upper-case NPZ": renamed("*.npz", lambda name: name.replace(".npz", ".NPZ")),
    "capital folders": renamed("*s", str.capitalize),
    "other padding": renamed("*.png", lambda name: f"{int(name[:6])}.png"),
    "byte-order marks": with_mark,
    "litter": with_litter,
    "links": linked,
    "accents": accented,
}


@pytest.mark.parametrize("name", QUIRKS)
def test_what_other_systems_make_of_names_is_read(name, written, copy):
    QUIRKS[name](copy)
    found = PlainScene.check(f"{copy}/")
    (subject,) = found.subjects
    assert (subject.problems, subject.warnings) == ([], [])
    capture, before = PlainScene(copy).open("dance"), PlainScene(written[0]).open("dance")
    camera = 1 if name == "accents" else 0  # it now is the last one
    for frame in range(len(FRAMES)):
        np.testing.assert_array_equal(capture.image(camera, frame), before.image(0, frame))
        np.testing.assert_array_equal(capture.silhouette(camera, frame), before.silhouette(0, frame))


def test_frames_left_out_as_the_page_tells(written, copy):
    """By rows of poses.npz, by images, or both: what is left is a sound scene, frame for frame."""
    arrays = dict(np.load(copy / "poses.npz"))
    per_frame = ("frames", "pose", "betas", "transl")
    spoiled = arrays | {"pose": np.where(arrays["frames"][:, None, None] == 4, np.nan, arrays["pose"])}
    np.savez(copy / "poses.npz", **spoiled)
    (problem,) = problems_of(copy)
    assert "NaN or infinity in row 1" in problem
    assert "leave such rows out and write the frame numbers of the others as 'frames'" in problem
    np.savez(copy / "poses.npz", **{k: v[[0, 2]] if k in per_frame else v for k, v in spoiled.items()})
    found = PlainScene.check(copy)
    assert found.ok
    assert found.subjects[0].warnings == [
        f"1 images of camera {name!r} have no pose in poses.npz and are not used; the first is frame 4"
        for name in NAMES
    ]
    np.savez(copy / "poses.npz", **arrays)
    for path in copy.glob("images/*/000004.png"):
        path.unlink()
    found = PlainScene.check(copy)
    assert found.ok
    assert found.subjects[0].warnings == ["1 poses have no image and are not used; the first is frame 4"]
    capture, before = PlainScene(copy).open("dance"), PlainScene(written[0]).open("dance")
    assert [capture.number(frame) for frame in range(capture.n_frames)] == [3, 10]
    np.testing.assert_array_equal(capture.body_pose(1).pose, before.body_pose(2).pose)
    np.testing.assert_array_equal(capture.image(0, 1), before.image(0, 2))


@pytest.mark.parametrize("numbers", [range(1, 4), range(0, 6, 2), range(100, 103)])
def test_images_that_are_numbered_otherwise_than_poses(numbers, tmp_path, own_body):
    """Rows count from 0 where nothing says otherwise; with as many images of other numbers that is a mistake."""
    folder = tmp_path / "s"
    write_scene(folder, own_body, cameras={"left": make_cameras()["left"]}, numbers=list(numbers))
    arrays = dict(np.load(folder / "poses.npz"))
    frames = arrays.pop("frames")
    np.savez(folder / "poses.npz", **arrays)
    problem = problems_of(folder)[0]
    assert "its 3 rows are of frames 0 to 2, since it has no array 'frames', but the 3 images" in problem
    assert f"numbered {numbers[0]} to {numbers[-1]}; write the image's number of each row as 'frames'" in problem
    np.savez(folder / "poses.npz", frames=frames, **arrays)
    assert problems_of(folder) == []


def each_mask(folder, change):
    for path in (folder / "masks").rglob("*.png"):
        Image.fromarray(change(np.array(Image.open(path)))).save(path)


def test_check_accepts_an_occluded_person(copy):
    def cut(mask):
        mask[HEIGHT // 2 :] = 0
        return mask

    each_mask(copy, cut)
    assert problems_of(copy) == []


def test_check_of_a_scene_that_cannot_be_opened(copy):
    (copy / "poses.npz").unlink()
    found = PlainScene.check(copy)
    assert not found.ok
    assert "poses.npz: no such file" in found.subjects[0].problems[0]


def test_check_without_pictures(copy):
    shutil.rmtree(copy / "images")
    problems = problems_of(copy)
    assert any("images: no such folder" in problem for problem in problems)
    assert "no image with its mask and pose found" in problems


# ----------------------------------------------------------------------------- the page that documents it


def test_the_examples_of_the_page_run(tmp_path, own_body):
    page = Path(plain_scene.__file__).resolve().with_suffix(".md").read_text(encoding="utf-8")
    assert len(page.splitlines()) <= 130
    pictures, *examples = [block.split("```")[0] for block in page.split("```python\n")[1:]]
    assert len(examples) == 4
    body = dataclasses.replace(own_body, v_template=own_body.v_template + np.array([0.0, -0.25, 0.03]))
    pelvis = body.joints[0]
    upright = make_poses(body)[0].pose.copy()
    for kind, example in zip(("crop", "incam", "world", "easymocap"), examples, strict=True):
        pose = upright.copy()
        pose[0] = [0, 0, 0] if kind == "world" else [np.pi, 0, 0]
        row = {"pose": pose, "rotmat": axis_angle_to_matrix(pose), "betas": np.zeros(10), "shapes": np.zeros((1, 10))}
        row |= {"trans": -pelvis + [0, 0, 0 if kind == "world" else 3], "cam": (0.9, -pelvis[0], -pelvis[1])}
        row |= {"box": (32, 24, 40), "poses": pose.reshape(1, 72) * (np.arange(72) > 2), "Rh": pose[:1]}
        row |= {"Th": np.array([[0, 0, 3.0]]) - axis_angle_to_matrix(pose[0]) @ pelvis}
        R, t = look_at([0, 0, 3], [0, 0, 0])
        calibration = {
            "K": np.array([[45, 0, 31.5], [0, 45, 23.5], [0, 0, 1]]),
            "R": np.eye(3),
            "T": np.zeros((3, 1)),
        }
        known = {"folder": tmp_path / kind, "width": WIDTH, "height": HEIGHT, "focal": 45.0, "body": body}
        known |= {"hmr": [row], "incam": [row], "world": [row], "easymocap": [row], "R_w2c": R, "t_w2c": t}
        known |= {
            "K": calibration["K"],
            "calibration": {"main": calibration | {"dist": np.zeros((1, 5))}, "basenames": ["main"]},
        }
        known["images"] = [np.zeros((HEIGHT, WIDTH, 3), np.uint8)]
        exec("from ihbench.datasets.plain import plain_scene\n" + example, known)
        write_body(known["folder"] / "body.npz", body)
        capture = PlainScene(known["folder"]).open(kind)
        known["masks"] = [255 * silhouette(body, capture.body_pose(0), capture.camera(0)).astype(np.uint8)]
        middle = np.argwhere(known["masks"][0]).mean(0)
        np.testing.assert_allclose(middle, [HEIGHT / 2, WIDTH / 2], atol=8)
        exec(pictures, known)
        assert problems_of(known["folder"]) == []
        joints = capture.camera(0).project(capture.model.posed_joints(capture.body_pose(0)))
        assert joints[15, 1] < joints[0, 1] < joints[7, 1]  # head, pelvis, ankle: upright in the picture


SOFT = np.linspace(0, 1, 80).reshape(8, 10)
HARD = SOFT > 0.5


@pytest.mark.parametrize(
    "mask",
    [HARD, HARD.astype(np.uint8), 255 * HARD.astype(np.uint8), HARD.astype(float), HARD[..., None],
     torch.tensor(HARD), Image.fromarray(HARD), np.repeat(255 * HARD[..., None].astype(np.uint8), 3, 2),
     HARD.astype(int) * 7],
)  # fmt: skip
def test_a_mask_is_written_from_what_people_have(mask, tmp_path):
    plain_scene.write_frame(tmp_path, 1, torch.zeros(8, 10, 3, dtype=torch.uint8), mask)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "masks/000001.png")) == 255, HARD)


@pytest.mark.parametrize(
    ("mask", "word"),
    [(SOFT, "mask > 0.5"), ((255 * SOFT).astype(np.uint8), "mask > 127"), (HARD.T, "like the image"),
     (HARD[None, None], "H, W"), (SOFT * 0.5, "mask > 0.5")],
)  # fmt: skip
def test_a_mask_that_would_make_more_a_person_is_not_written(mask, word, tmp_path):
    with pytest.raises(ValueError, match=word):
        plain_scene.write_frame(tmp_path, 1, np.zeros((8, 10, 3), np.uint8), mask)
    assert not (tmp_path / "masks").exists()
    assert not (tmp_path / "images").exists()
