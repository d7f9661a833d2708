"""The OcMotion readers and writers: the `_w2a` sequences and the original release, on tiny captures."""

from __future__ import annotations

import dataclasses
import json
import pickle
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.datasets.ocmotion import original as ocmotion
from ihbench.datasets.ocmotion import wild2avatar as ocmotion_w2a
from ihbench.datasets.ocmotion.original import OcMotionOriginal, mask_file
from ihbench.datasets.ocmotion.wild2avatar import OcMotionW2a
from ihbench.datasets.reading.stored_numbers import stored_camera
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.pictures import write_picture
from ihbench.render.zbuffer import rasterize

WIDTH, HEIGHT = 128, 96
NAME = "0011_02_1_w2a"
NAMES = ["00320", "00321", "00322", "00323"]
N_FRAMES = len(NAMES)
OWN = 2  # of the six cameras


@pytest.fixture(scope="module")
def smpl():
    """A body that counts as the user's SMPL file."""
    return dataclasses.replace(load_body(), name="smpl")


def make_cameras() -> list[Camera]:
    """Six cameras around the person, who stands to the right of the middle of the third."""
    cameras = []
    for k in range(6):
        angle = np.pi / 2 + (k - OWN) * np.pi / 3
        eye = np.array([4 * np.cos(angle), 0.3, 4 * np.sin(angle)])
        R, t = look_at(eye, [-0.9 if k == OWN else 0.0, 0.1, 0], up=(0, 1, 0))
        K = np.array([[100 + k, 0, 63.2], [0, 101 + k, 47.7], [0, 0, 1]])
        cameras.append(Camera(K, R, t, WIDTH, HEIGHT))
    return cameras


def make_poses() -> list[BodyPose]:
    rng = np.random.default_rng(0)
    poses = []
    for k in range(N_FRAMES):
        pose = rng.normal(size=(24, 3)) * 0.15
        pose[0] = [0.1, 0.4 * k, -0.05]
        poses.append(BodyPose(pose, rng.normal(size=10) * 0.3, [0.05 * k, 0.1, 0.02 * k]))
    return poses


def visible_masks(camera: Camera, poses: list[BodyPose], body) -> list[np.ndarray]:
    """The drawn bodies, their lower parts hidden by furniture."""
    masks = []
    for pose in poses:
        mask = rasterize(camera.project(body.pose(pose)), body.faces, HEIGHT, WIDTH).mask.copy()
        mask[60:] = False
        masks.append(mask)
    return masks


def make_images() -> list[np.ndarray]:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return [np.stack([2 * x - k, 2 * y, 50 * k + 0 * x], -1).clip(0, 255).astype(np.uint8) for k in range(N_FRAMES)]


@dataclasses.dataclass
class Written:
    root: Path
    cameras: list[Camera]
    poses: list[BodyPose]
    images: list[np.ndarray]
    masks: list[np.ndarray]


def write_w2a(root: Path, body, name: str = NAME) -> Written:
    cameras, poses, images = make_cameras(), make_poses(), make_images()
    masks = visible_masks(cameras[OWN], poses, body)
    folder = root / name
    ocmotion_w2a.write_sequence_metadata(folder, NAMES, cameras[OWN], poses)
    ocmotion_w2a.write_mesh_infos(folder, NAMES, poses, body)
    ocmotion_w2a.write_all_cameras(folder, NAMES, cameras)
    for frame, image, mask in zip(NAMES, images, masks, strict=True):
        ocmotion_w2a.write_frame(folder, frame, image, mask)
    return Written(root, cameras, poses, images, masks)


def path_of(camera: int, frame: int) -> str:
    return f"images/0011/{camera:02d}/{frame + 1:05d}.jpg"


def annot_frame(path: str, camera: Camera, people: dict[str, BodyPose]) -> dict:
    K, E = stored_camera(camera, "OcMotion")
    frame: dict = {"img_path": path, "h_w": (camera.height, camera.width)}
    for key, pose in people.items():
        parameters = {"pose": pose.pose.reshape(72), "betas": pose.betas, "trans": pose.transl}
        frame[key] = {
            "bbox": np.zeros((2, 2)),
            "lsp_joints_2d": np.zeros((14, 3)),
            "intri": K,
            "extri": E,
            **parameters,
        }
    return frame


def annot_frames(camera: int, cameras, poses, people=("0",)) -> list[dict]:
    frames = []
    for frame, pose in enumerate(poses):
        beside = {key: dataclasses.replace(pose, transl=pose.transl + np.array([int(key), 0, 0])) for key in people}
        frames.append(annot_frame(path_of(camera, frame), cameras[camera], beside))
    return frames


def write_original(root: Path, body) -> Written:
    cameras, poses, images = make_cameras(), make_poses(), make_images()
    masks = visible_masks(cameras[OWN], poses, body)
    sequence = [annot_frames(1, cameras, poses, ("0", "1")), annot_frames(OWN, cameras, poses)]
    write_annots(root, [sequence])
    for frame, (image, mask) in enumerate(zip(images, masks, strict=True)):
        write_picture(root / path_of(OWN, frame), image)
        write_picture(root / mask_file(path_of(OWN, frame)), ocmotion.three_channels(mask))
    return Written(root, cameras, poses, images, masks)


@pytest.fixture(scope="module")
def w2a(tmp_path_factory, smpl) -> Written:
    return write_w2a(tmp_path_factory.mktemp("w2a"), smpl)


@pytest.fixture(scope="module")
def original(tmp_path_factory, smpl) -> Written:
    return write_original(tmp_path_factory.mktemp("original"), smpl)


@pytest.fixture
def sequence(w2a, tmp_path) -> Path:
    """A copy to damage: the sequence's folder."""
    shutil.copytree(w2a.root, tmp_path / "w2a")
    return tmp_path / "w2a" / NAME


@pytest.fixture
def release(original, tmp_path) -> Path:
    """A copy to damage: the folder that holds annot/."""
    shutil.copytree(original.root, tmp_path / "original")
    return tmp_path / "original"


def opened(sequence: Path, body=None):
    return OcMotionW2a(sequence.parent).open(sequence.name, body)


def metadata(sequence: Path) -> dict:
    return json.loads((sequence / "metadata.json").read_text())


def write_metadata(sequence: Path, content) -> None:
    (sequence / "metadata.json").write_text(json.dumps(content))


def annots(release: Path):
    return pickle.loads((release / "annot" / "train.pkl").read_bytes())


def write_annots(release: Path, content, split: str = "train") -> None:
    (release / "annot").mkdir(parents=True, exist_ok=True)
    (release / "annot" / f"{split}.pkl").write_bytes(pickle.dumps(content))


def message(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def assert_same_camera(read: Camera, written: Camera, tolerance: float = 1e-12) -> None:
    for name in ("K", "R", "t"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), atol=tolerance)
    assert (read.width, read.height, read.distortion) == (written.width, written.height, None)


def assert_same_pose(read: BodyPose, written: BodyPose, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(read.pose, written.pose, atol=tolerance)
    np.testing.assert_allclose(read.betas, written.betas, atol=tolerance)
    np.testing.assert_allclose(read.transl, written.transl, atol=tolerance)


# ------------------------------------------------------------------------------------ w2a: what is read


def test_w2a_poses_are_exact_without_mesh_infos(sequence, w2a):
    (sequence / "mesh_infos.pkl").unlink()
    for frame, pose in enumerate(w2a.poses):
        assert_same_pose(opened(sequence).body_pose(frame), pose, 0)


def test_root_of_mesh_infos_replaces_that_of_the_poses(sequence, w2a):
    content = metadata(sequence)
    for entry in content.values():
        entry["poses"][:3] = [9.0, 0, 0]
    write_metadata(sequence, content)
    assert_same_pose(opened(sequence).body_pose(1), w2a.poses[1], 1e-7)


def test_metadata_is_as_occfusion_reads_it(w2a):
    content = metadata(w2a.root / NAME)
    assert list(content) == NAMES
    entry, camera = content["00321"], w2a.cameras[OWN]
    assert {key: np.shape(value) for key, value in entry.items()} == {
        "cam_intrinsics": (3, 3),
        "cam_extrinsics": (4, 4),
        "poses": (72,),
        "betas": (10,),
        "trans": (3,),
    }
    np.testing.assert_allclose(np.array(entry["cam_intrinsics"])[:2, 2], camera.K[:2, 2] - 0.5)
    point = np.array([0.2, 0.4, -0.3, 1])
    np.testing.assert_allclose((np.array(entry["cam_extrinsics"]) @ point)[:3], camera.to_camera(point[:3]))


def test_masks_have_three_channels(w2a):
    """OccFusion reads mask[:, :, 0]."""
    with Image.open(w2a.root / NAME / "masks" / "00320.png") as picture:
        mask = np.array(picture)
    assert mask.shape == (HEIGHT, WIDTH, 3)
    assert set(np.unique(mask)) == {0, 255}


def test_mesh_infos_give_the_body_before_its_translation(w2a, smpl):
    """R(Rh) (joints) + Th, moved by the translation, is what the true camera sees of the posed joints."""
    infos = pickle.loads((w2a.root / NAME / "mesh_infos.pkl").read_bytes())
    assert list(infos) == NAMES
    for frame, name in enumerate(NAMES):
        info, pose = infos[name], w2a.poses[frame]
        assert not info["poses"][:3].any()
        assert info["poses"].shape == (72,)
        np.testing.assert_allclose(info["tpose_joints"], smpl.shaped(pose.betas)[1] - info["Th"], atol=1e-6)
        world = Rotation.from_rotvec(info["Rh"]).apply(info["joints"]) + info["Th"]
        seen = w2a.cameras[OWN].to_camera(world + pose.transl)
        np.testing.assert_allclose(seen, w2a.cameras[OWN].to_camera(smpl.posed_joints(pose)), atol=1e-5)


def test_novel_cameras(w2a):
    capture = OcMotionW2a(w2a.root).open(NAME)
    for read, written in zip(capture.novel_cameras(1), w2a.cameras, strict=True):
        assert_same_camera(read, written)


def test_novel_cameras_with_the_translation_folded_in(sequence, w2a):
    """As OccNeRF's preparation would write them, in float32."""
    frames = {}
    for frame, name in enumerate(NAMES):
        moved = np.eye(4)
        moved[:3, 3] = w2a.poses[frame].transl
        stored = [stored_camera(camera, "OcMotion") for camera in w2a.cameras]
        frames[name] = {
            "intrinsics": np.stack([K for K, _ in stored]).astype(np.float32),
            "extrinsics": np.stack([E @ moved for _, E in stored]).astype(np.float32),
        }
    (sequence / "all_cameras.pkl").write_bytes(pickle.dumps(frames))
    for read, written in zip(opened(sequence).novel_cameras(3), w2a.cameras, strict=True):
        assert_same_camera(read, written, 1e-5)


def test_novel_cameras_of_another_world(sequence, w2a):
    ocmotion_w2a.write_all_cameras(sequence, NAMES, w2a.cameras[3:])
    with pytest.raises(BadInput, match=r"all_cameras.pkl: frame 00320: none of its cameras is that of") as error:
        opened(sequence).novel_cameras(0)
    message(error)
    (sequence / "all_cameras.pkl").unlink()
    with pytest.raises(BadInput, match=r"all_cameras.pkl: no such file"):
        opened(sequence).novel_cameras(0)


def test_frames_are_the_sorted_images(sequence):
    """Positions count over images/, as OccFusion does it, whatever the order of metadata.json."""
    write_metadata(sequence, dict(reversed(metadata(sequence).items())))
    capture = opened(sequence)
    assert capture.frame_names == tuple(NAMES)
    assert [capture.image_path(0, k).name for k in range(N_FRAMES)] == [f"{name}.png" for name in NAMES]


def test_jpeg_images_and_other_files(sequence, w2a):
    for name in NAMES:
        Image.open(sequence / "images" / f"{name}.png").save(sequence / "images" / f"{name}.jpg", quality=95)
        (sequence / "images" / f"{name}.png").unlink()
    for stray in (".DS_Store", "._00320.jpg", "Thumbs.db"):
        (sequence / "images" / stray).write_bytes(b"x")
    capture = opened(sequence)
    assert capture.frame_names == tuple(NAMES)
    assert np.abs(capture.image(0, 2).astype(int) - w2a.images[2]).mean() < 2


def test_channel_0_decides(sequence):
    mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask[10:20, :, 0] = 1
    mask[30:40, :, 1] = 255
    Image.fromarray(mask).save(sequence / "masks" / "00320.png")
    np.testing.assert_array_equal(opened(sequence).silhouette(0, 0), mask[..., 0] > 0)


@pytest.mark.parametrize("mode", ["L", "RGBA", "LA", "1", "P"])
def test_masks_of_other_picture_modes(sequence, w2a, mode):
    grey = Image.fromarray(np.where(w2a.masks[0], 255, 0).astype(np.uint8))
    grey.convert(mode).save(sequence / "masks" / "00320.png")
    np.testing.assert_array_equal(opened(sequence).silhouette(0, 0), w2a.masks[0])


@pytest.mark.parametrize(
    ("name", "camera_id"),
    [("0011_02_1_w2a", "02"), ("0041_00_w2a", "00"), ("standin-1", "camera"), ("mine_w2a", "camera")],
)
def test_camera_id_is_the_second_part_of_the_name(sequence, name, camera_id):
    sequence.rename(sequence.parent / name)
    assert OcMotionW2a(sequence.parent).open(name).camera_ids == (camera_id,)


def test_truth_is_ignored(sequence):
    before = OcMotionW2a(sequence.parent).check(sequence.parent)
    for truth in (sequence / "truth", sequence.parent / "truth"):
        (truth / "masks").mkdir(parents=True)
        (truth / "images").mkdir()
        (truth / "masks" / "00320.png").write_bytes(b"damaged")
        (truth / "metadata.json").write_text("{")
    assert OcMotionW2a(sequence.parent).subjects() == [NAME]
    assert OcMotionW2a(sequence.parent).check(sequence.parent) == before


def test_cameras_with_distortion_cannot_be_written(tmp_path, w2a):
    camera = dataclasses.replace(w2a.cameras[0], distortion=np.array([0.1, 0, 0, 0, 0]))
    with pytest.raises(ValueError, match="without distortion"):
        ocmotion_w2a.write_sequence_metadata(tmp_path, NAMES, camera, w2a.poses)


# ---------------------------------------------------------------------------------------- w2a: stand-in


def mark_standin(root: Path) -> None:
    body = load_body()
    mark = {"generator": "ihbench", "version": 1, "seed": 0, "body": body.name, "body_sha": body.content_sha()}
    atomic.write_json(root / "STANDIN.json", mark)


def test_standin_takes_its_own_body_and_may_lack_images(sequence):
    mark_standin(sequence.parent)
    (sequence / "images" / "00321.png").unlink()
    capture = opened(sequence)
    assert (capture.standin, capture.body, capture.n_frames) == ("stand-in v1 seed 0", "procedural", N_FRAMES)
    assert capture.model.pose(capture.body_pose(1)).shape == load_body().v_template.shape
    capture.image(0, 2)
    with pytest.raises(BadInput, match=r"images/00321.png: no such file.*a stand-in holds only"):
        capture.image(0, 1)
    found = OcMotionW2a.check(sequence.parent)
    assert found.ok
    (subject,) = found.subjects
    assert subject.missing == {"image": 1, "mask": 0}
    assert subject.mask_on_body > 0.95


# --------------------------------------------------------------------------------------- w2a: bad input


def test_the_layouts_do_not_take_each_others_folders(w2a, original, tmp_path):
    with pytest.raises(BadInput, match="no subject of this layout"):
        OcMotionW2a(original.root)
    for root in (w2a.root, w2a.root / NAME):
        with pytest.raises(BadInput, match="expected the original release"):
            OcMotionOriginal(root)
    for layout in (OcMotionW2a, OcMotionOriginal):
        with pytest.raises(BadInput, match="expected"):
            layout(tmp_path)
        with pytest.raises(BadInput):
            layout.check(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", '{"00320": 5}', "[" * 100_000, "\x00"])
def test_metadata_that_is_not_json_of_frames(sequence, text):
    (sequence / "metadata.json").write_text(text)
    with pytest.raises(BadInput, match=r"metadata.json: (not valid JSON|expected one dictionary)") as error:
        opened(sequence)
    message(error)
    (subject,) = OcMotionW2a.check(sequence.parent).subjects
    assert "metadata.json" in subject.problems[0]


def test_metadata_missing_or_not_utf8(sequence):
    (sequence / "metadata.json").write_bytes(b'{"\xff": 1}')
    with pytest.raises(BadInput, match=r"metadata.json: not UTF-8 text"):
        opened(sequence)
    (sequence / "metadata.json").unlink()
    with pytest.raises(BadInput, match=r"metadata.json: cannot be opened \(No such file"):
        opened(sequence)


def test_frame_named_twice_in_metadata(sequence):
    text = (sequence / "metadata.json").read_text()
    (sequence / "metadata.json").write_text(text.replace('"00321"', '"00320"'))
    with pytest.raises(BadInput, match="'00320' is there twice"):
        opened(sequence)


def test_frame_there_as_two_images(sequence):
    shutil.copy(sequence / "images" / "00321.png", sequence / "images" / "00321.jpg")
    with pytest.raises(BadInput, match=r"frame 00321 is there twice, 00321.jpg too; keep one"):
        opened(sequence)


def test_image_without_metadata(sequence):
    content = metadata(sequence)
    del content["00321"]
    write_metadata(sequence, content)
    with pytest.raises(BadInput, match=r"00321.png: no entry '00321' in metadata.json") as error:
        opened(sequence)
    message(error)


def test_metadata_without_image(sequence):
    """A lost image would shift every later position, one at the end shortens the sequence."""
    (sequence / "images" / "00323.png").unlink()
    assert opened(sequence).n_frames == N_FRAMES - 1
    (subject,) = OcMotionW2a.check(sequence.parent).subjects
    assert subject.missing["image"] == 1
    assert any("metadata.json has 1 frames before or after the images" in line for line in subject.warnings)
    (sequence / "images" / "00321.png").unlink()
    with pytest.raises(BadInput, match=r"images/00321.png: no such file, one of 1 that metadata.json has within"):
        opened(sequence)


def test_image_name_without_number(sequence):
    (sequence / "images" / "00320.png").rename(sequence / "images" / "first.png")
    with pytest.raises(BadInput, match=r"first.png: expected the frame's number"):
        opened(sequence)


def test_no_images(sequence):
    for path in (sequence / "images").iterdir():
        path.unlink()
    with pytest.raises(BadInput, match="no image in it"):
        opened(sequence)
    (sequence / "images").rmdir()
    with pytest.raises(BadInput, match="images: no such folder"):
        opened(sequence)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("cam_intrinsics", None, r"'cam_intrinsics' to be numbers of shape \[3, 3\], found no such key"),
        ("cam_extrinsics", np.eye(3).tolist(), r"'cam_extrinsics'.*shape \[4, 4\], found \[3, 3\]"),
        ("cam_extrinsics", np.full((4, 4), np.nan).tolist(), "NaN or infinity in 'cam_extrinsics'"),
        ("cam_extrinsics", np.diag([1.0, 1, -1, 1]).tolist(), "with a rotation R"),
        ("cam_extrinsics", (2 * np.eye(4)).tolist(), "with a rotation R"),
        ("cam_intrinsics", np.eye(4).tolist(), r"'cam_intrinsics'.*found \[4, 4\]"),
        ("cam_intrinsics", np.zeros((3, 3)).tolist(), r"expected intrinsics \[\[fx, 0, cx\]"),
        ("cam_intrinsics", "here", "found a str of other contents"),
        ("cam_intrinsics", [[1, 2], [3]], "found a list of other contents"),
        ("cam_intrinsics", [[10**400] * 3] * 3, "found a list of other contents"),
    ],
)
def test_bad_cameras(sequence, key, value, expected):
    content = metadata(sequence)
    if value is None:
        del content["00320"][key]
    else:
        content["00320"][key] = value
    write_metadata(sequence, content)
    with pytest.raises(BadInput, match=expected) as error:
        opened(sequence)
    assert "metadata.json: frame 00320" in message(error)


def test_camera_in_millimetres(sequence):
    content = metadata(sequence)
    for entry in content.values():
        for row in entry["cam_extrinsics"][:3]:
            row[3] *= 1000
    write_metadata(sequence, content)
    with pytest.raises(BadInput, match="expected metres, divide the extrinsics' t by 1000"):
        opened(sequence)


@pytest.mark.parametrize("scale", [1 + 3e-5, 1 + 3e-4])
@pytest.mark.parametrize("key", ["cam_intrinsics", "cam_extrinsics"])
def test_camera_that_moves(sequence, key, scale):
    content = metadata(sequence)
    content["00322"][key][0][0 if key == "cam_intrinsics" else 3] *= scale
    if key == "cam_extrinsics":  # move along the axis on which t is largest
        content["00322"][key] = metadata(sequence)["00322"][key]
        content["00322"][key][2][3] *= scale
    write_metadata(sequence, content)
    if scale < 1 + 1e-4:
        opened(sequence)
        return
    with pytest.raises(BadInput, match=r"frame 00322: its camera differs from the first frame's by 0.0003"):
        opened(sequence)
    (subject,) = OcMotionW2a.check(sequence.parent).subjects
    assert "one fixed camera" in subject.problems[0]


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("poses", None, "'poses' to be numbers of shape .*found no such key"),
        ("trans", None, "'trans' to be numbers of shape .*found no such key"),
        ("poses", [0.0] * 71, r"'poses'.*found \[71\]"),
        ("betas", [0.0] * 11, r"'betas'.*found \[11\]"),
        ("trans", [0.0, np.nan, 0.0], "NaN or infinity in 'trans'"),
        ("poses", [0.0] * 71 + [np.inf], "NaN or infinity in 'poses'"),
        ("trans", [100.0, 900.0, -40.0], "divide 'trans' by 1000"),
        ("poses", [0.0] * 60 + [25.0] * 12, r"turned by 43.3 rad; expected axis-angle rotations in radians"),
    ],
)
def test_bad_body_parameters(sequence, key, value, expected):
    content = metadata(sequence)
    if value is None:
        del content["00322"][key]
    else:
        content["00322"][key] = value
    write_metadata(sequence, content)
    capture = opened(sequence)
    capture.body_pose(1)
    with pytest.raises(BadInput, match=expected) as error:
        capture.body_pose(2)
    assert "metadata.json: frame 00322" in message(error)
    (subject,) = OcMotionW2a.check(sequence.parent).subjects
    assert len([problem for problem in subject.problems if "frame 00322" in problem]) == 1


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ([1, 2], "expected one dictionary for each frame name, found a list"),
        ({"00320": {"Rh": np.zeros(3)}}, "expected a dictionary for frame 00321, found a NoneType"),
        ({name: {"poses": np.zeros(72)} for name in NAMES}, r"frame 00320: expected 'Rh'.*no such key"),
        ({name: {"Rh": np.zeros((6, 3))} for name in NAMES}, r"'Rh' to be numbers of shape \[3\], found \[6, 3\]"),
        ({name: {"Rh": np.full(3, np.nan)} for name in NAMES}, "NaN or infinity in 'Rh'"),
    ],
)
def test_mesh_infos_of_other_contents(sequence, content, expected):
    (sequence / "mesh_infos.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(BadInput, match=expected) as error:
        opened(sequence).body_pose(0)
    assert "mesh_infos.pkl" in message(error)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"intrinsics": np.eye(3)}, r"'intrinsics' to be numbers of shape \[n, 3, 3\], found \[3, 3\]"),
        ({"extrinsics": np.stack([np.eye(4)] * 5)}, r"'extrinsics'.*\[6, 4, 4\], found \[5, 4, 4\]"),
        ({"intrinsics": [[1], [2, 3]]}, "'intrinsics'.*found a list of other contents"),
    ],
)
def test_all_cameras_of_other_contents(sequence, change, expected):
    content = pickle.loads((sequence / "all_cameras.pkl").read_bytes())
    content["00320"] |= change
    (sequence / "all_cameras.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(BadInput, match=expected) as error:
        opened(sequence).novel_cameras(0)
    message(error)


def test_symlink_loops_do_no_harm(sequence, release):
    for folder in (sequence.parent, sequence, release, release / "images"):
        (folder / "loop").symlink_to(folder, target_is_directory=True)
        (folder / "itself_w2a").symlink_to(folder / "itself_w2a")
    (sequence / "images" / "00321.png").unlink()
    (sequence / "images" / "00321.png").symlink_to("00321.png")
    start = time.perf_counter()
    assert NAME in OcMotionW2a(sequence.parent).subjects()
    capture = opened(sequence)
    capture.content_digest(0, 1)
    with pytest.raises(BadInput, match=r"00321.png: no such file"):
        capture.image(0, 1)
    assert not OcMotionW2a.check(sequence.parent).ok
    assert OcMotionOriginal(release).subjects() == ["0011_01", "0011_01_p1", "0011_02"]
    for root, layout in ((release, OcMotionW2a), (sequence.parent, OcMotionOriginal)):
        with pytest.raises(BadInput):
            layout(root)
    assert time.perf_counter() - start < 5


# --------------------------------------------------------------------------------- the original release


def test_people_of_one_camera_are_subjects(release, original):
    dataset = OcMotionOriginal(release)
    assert dataset.subjects() == ["0011_01", "0011_01_p1", "0011_02"]
    first, second = dataset.open("0011_01"), dataset.open("0011_01_p1")
    np.testing.assert_allclose(second.body_pose(0).transl - first.body_pose(0).transl, [1, 0, 0])
    assert first.mask_path(0, 0) == release / "masks/0011/01/00001.png"
    assert second.mask_path(0, 0) == release / "masks/0011/01/00001_p1.png"
    write_picture(release / mask_file(path_of(1, 0), "_p1"), ocmotion.three_channels(original.masks[0]))
    np.testing.assert_array_equal(second.silhouette(0, 0), original.masks[0])


def test_frames_are_those_with_the_person(release):
    content = annots(release)
    del content[0][0][1]["1"]
    write_annots(release, content)
    dataset = OcMotionOriginal(release)
    assert dataset.open("0011_01").n_frames == N_FRAMES
    assert dataset.open("0011_01_p1").frame_names == ("00001", "00003", "00004")


def test_train_and_test_are_one_data_set(release, original):
    content = annots(release)
    write_annots(release, [[content[0][1]]], "test")
    assert "0011_02_test" in OcMotionOriginal(release).subjects()
    for frame in content[0][1]:
        frame["img_path"] = frame["img_path"].replace("0011", "0099")
    write_annots(release, [[content[0][1]]], "test")
    assert OcMotionOriginal(release).subjects() == ["0011_01", "0011_01_p1", "0011_02", "0099_02"]
    (release / "annot" / "train.pkl").unlink()
    assert OcMotionOriginal(release).subjects() == ["0099_02"]


@pytest.mark.parametrize(
    ("path", "name", "mask"),
    [
        ("images/0011/Camera02/1.png", "0011_Camera02", "masks/0011/Camera02/1.png"),
        ("0013/Camera00/00007.jpg", "0013_Camera00", "masks/0013/Camera00/00007.png"),
        ("00001.jpg", "0000_00", "masks/00001.png"),
        ("images\\0011\\02\\00001.jpg", "0011_02", "masks/0011/02/00001.png"),
        ("images/数据/größe/00001.jpg", "数据_größe", "masks/数据/größe/00001.png"),
    ],
)
def test_image_paths_of_other_shapes(tmp_path, original, path, name, mask):
    write_annots(tmp_path, [[[annot_frame(path, original.cameras[OWN], {"0": original.poses[0]})]]], "test")
    for at, picture in ((path.replace("\\", "/"), original.images[0]), (mask, original.masks[0] * np.uint8(255))):
        write_picture(tmp_path / at, picture)
    dataset = OcMotionOriginal(tmp_path)
    assert dataset.subjects() == [name]
    capture = dataset.open(name)
    assert capture.mask_path(0, 0) == tmp_path / mask
    np.testing.assert_array_equal(capture.silhouette(0, 0), original.masks[0])
    assert capture.image(0, 0).shape == (HEIGHT, WIDTH, 3)


def test_constructor_does_not_read_the_annotations(release):
    (release / "annot" / "train.pkl").write_bytes(b"")
    OcMotionOriginal(release)


def test_annotations_are_read_once_and_again_when_they_change(release, monkeypatch):
    reads = []
    load = ocmotion.load_pickle
    monkeypatch.setattr(ocmotion, "load_pickle", lambda path: reads.append(path) or load(path))
    for _ in range(2):
        OcMotionOriginal(release).subjects()
    assert len(reads) == 1
    content = annots(release)
    write_annots(release, [[content[0][1]]])
    assert OcMotionOriginal(release).subjects() == ["0011_02"]
    assert len(reads) == 2


def test_masks_are_the_users_to_make(release):
    (release / "masks/0011/02/00002.png").unlink()
    with pytest.raises(
        BadInput, match=r"masks/0011/02/00002.png: no such file; the OcMotion release has no"
    ) as error:
        OcMotionOriginal(release).open("0011_02").silhouette(0, 1)
    message(error)


@pytest.mark.parametrize("path", ["../secret.jpg", "images/../../secret.jpg", "/etc/x.jpg", "C:\\x.jpg", "..\\x.jpg"])
def test_image_path_that_leaves_the_folder(release, path):
    content = annots(release)
    content[0][1][2]["img_path"] = path
    write_annots(release, content)
    with pytest.raises(BadInput, match=r"sequence 0, camera 1, frame 2: img_path .* leads out of the data") as error:
        OcMotionOriginal(release).open("0011_02")
    message(error)


def set_of(frame: int, **changes):
    def damage(content):
        content[0][1][frame]["0"].update(changes)

    return damage


def set_frame(frame: int, **changes):
    def damage(content):
        content[0][1][frame].update(changes)

    return damage


MOVED = np.eye(4)
MOVED[2, 3] = 4.5


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (set_of(1, intri=np.full((3, 3), np.nan)), "frame 1: NaN or infinity in 'intri'"),
        (set_of(1, extri=np.eye(3)), r"'extri' to be numbers of shape \[4, 4\], found \[3, 3\]"),
        (set_of(1, extri=MOVED), "frame 1: its camera differs from the first frame's"),
        (set_of(0, extri=1000 * MOVED), "with a rotation R"),
        (lambda content: content[0][1][1]["0"].pop("intri"), "frame 1: expected 'intri'.*no such key"),
        (set_frame(1, img_path=path_of(OWN, 0)), "images/0011/02/00001.jpg is listed 2 times"),
        (set_frame(1, img_path=5), "frame 1: expected the image's path in 'img_path', found a int"),
        (set_frame(1, h_w=(5, 5)), r"frame 1: h_w is \(5, 5\), \(96, 128\) at the first"),
        (set_frame(1, h_w="wide"), r"expected 'h_w' to be numbers"),
        (set_frame(1, h_w=(0, 5)), r"h_w is \(0, 5\)"),
        (lambda content: content[0][1][1].update({"0": 7}), "expected 'intri'.*no such key"),
    ],
)
def test_bad_annotations_of_one_subject(release, damage, expected):
    content = annots(release)
    damage(content)
    write_annots(release, content)
    dataset = OcMotionOriginal(release)
    dataset.open("0011_01")
    with pytest.raises(BadInput, match=expected) as error:
        dataset.open("0011_02")
    assert "train.pkl" in message(error)
    subject = next(s for s in OcMotionOriginal.check(release).subjects if s.subject == "0011_02")
    assert len(subject.problems) == 1


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ({"a": 1}, "expected a list of sequences, found a dictionary"),
        ([5], "sequence 0: expected a list of cameras, found a int"),
        ([[5]], "sequence 0, camera 0: expected a list of frames"),
        ([[[5]]], "frame 0: expected a dictionary with img_path, h_w and one entry a person, found a int"),
        ([[[{"img_path": "a/b.jpg"}]]], "frame 0: expected a dictionary with img_path, h_w"),
        ([[[{"img_path": "a/b.jpg", "h_w": (1, 1)}]]], "no person in any frame"),
        ([], "no person in any frame"),
    ],
)
def test_annotations_of_another_structure(release, content, expected):
    write_annots(release, content)
    with pytest.raises(BadInput, match=expected) as error:
        OcMotionOriginal(release).subjects()
    message(error)
    found = OcMotionOriginal.check(release)
    assert not found.ok
    assert "train.pkl" in found.subjects[0].problems[0]


def test_two_cameras_in_one_folder(release):
    content = annots(release)
    write_annots(release, [[content[0][1], content[0][1]]])
    with pytest.raises(BadInput, match=r"sequence 0, camera 1: its images lie in images/0011/02, as do those of"):
        OcMotionOriginal(release).subjects()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"pose": np.zeros(71)}, r"frame 1: expected 'pose' .*found \[71\]"),
        ({"pose": np.full(72, np.nan)}, "frame 1: NaN or infinity in 'pose'"),
        ({"pose": np.full(72, 30.0)}, "in radians"),
        ({"trans": np.array([10.0, 1200, 3000])}, "divide 'trans' by 1000"),
        ({"betas": np.zeros(3)}, r"'betas'.*found \[3\]"),
    ],
)
def test_bad_parameters_of_one_frame(release, changes, expected):
    content = annots(release)
    set_of(1, **changes)(content)
    write_annots(release, content)
    capture = OcMotionOriginal(release).open("0011_02")
    capture.body_pose(0)
    with pytest.raises(BadInput, match=expected) as error:
        capture.body_pose(1)
    message(error)


def test_check_counts_what_the_original_lacks(release):
    (release / path_of(OWN, 3)).unlink()
    found = OcMotionOriginal.check(release)
    subjects = {subject.subject: subject for subject in found.subjects}
    assert subjects["0011_02"].missing == {"image": 1, "mask": 0}
    assert subjects["0011_01_p1"].missing == {"image": N_FRAMES, "mask": N_FRAMES}
    assert "no image with its mask and pose found" in subjects["0011_01_p1"].problems
    assert not found.ok
