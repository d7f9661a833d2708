"""The three layouts of PeopleSnapshot on a tiny subject that turns and walks sideways for eight frames."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
import struct
import threading

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import binary_closing

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.people_snapshot import gaussianavatar, instantavatar
from ihbench.datasets.people_snapshot import original as people_snapshot
from ihbench.datasets.people_snapshot.gaussianavatar import GaussianAvatarFolder
from ihbench.datasets.people_snapshot.instantavatar import InstantAvatarFolder
from ihbench.datasets.people_snapshot.original import PeopleSnapshotRaw
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.npz import write_npz

WIDTH, HEIGHT, N = 48, 64, 8
SUBJECT = "male-3-casual"
SPLIT = {"train": [0, 2, 4], "test": [5, 7]}  # GaussianAvatar's
BETAS = np.linspace(-0.5, 0.5, 10)


def make_camera(distortion: bool) -> Camera:
    K = np.array([[61.0, 0, 24.3], [0, 60.5, 32.8], [0, 0, 1]])
    k = np.array([-0.02, 0.01, 1e-3, -5e-4, 2e-3]) if distortion else None
    return Camera(K, np.eye(3), np.zeros(3), WIDTH, HEIGHT, k)


def make_poses(n: int = N) -> list[BodyPose]:
    poses = []
    for i in range(n):
        pose = np.zeros((24, 3))
        pose[0] = [np.pi - 0.02 * i, 0, 0.03 * i]
        pose[16, 2], pose[17, 2] = -0.9, 0.9
        pose[18, 1] = 0.1 * i
        poses.append(BodyPose(pose, BETAS, [0.05 + 0.04 * i, 0.1, 3.0]))
    return poses


def make_mask(camera: Camera, pose: BodyPose) -> np.ndarray:
    x, y, _ = np.floor(camera.project(load_body().pose(pose))).astype(int).T
    mask = np.zeros((HEIGHT, WIDTH), bool)
    seen = (x >= 0) & (x < WIDTH) & (y >= 0) & (y < HEIGHT)
    mask[y[seen], x[seen]] = True
    return binary_closing(np.pad(mask, 2))[2:-2, 2:-2] | mask


def make_image(i: int) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    smooth = [128 + 90 * np.sin((x + 5 * i) / 17), 128 + 90 * np.cos((y + 4 * i) / 13), 60 + x + 10 * i]
    return np.stack(smooth, -1).clip(0, 255).astype(np.uint8)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


@dataclasses.dataclass(frozen=True)
class Scene:
    camera: Camera
    plain: Camera  # without distortion
    poses: list[BodyPose]
    images: list[np.ndarray]
    masks: list[np.ndarray]  # seen by `camera`
    plain_masks: list[np.ndarray]


@pytest.fixture(scope="module")
def scene() -> Scene:
    camera, plain, poses = make_camera(True), make_camera(False), make_poses()
    masks, plain_masks = ([make_mask(c, pose) for pose in poses] for c in (camera, plain))
    return Scene(camera, plain, poses, [make_image(i) for i in range(N)], masks, plain_masks)


@pytest.fixture(scope="module")
def smpl():
    """A body that counts as the user's SMPL file."""
    return dataclasses.replace(load_body(), name="smpl")


def write_raw(folder, scene, poses=None, n_video=N):
    people_snapshot.write_camera(folder, scene.camera)
    people_snapshot.write_masks(folder, iter(scene.masks), (N, HEIGHT, WIDTH))
    people_snapshot.write_poses(folder, poses or scene.poses)
    people_snapshot.write_video(folder / f"{folder.name}.mp4", iter(scene.images[:n_video]), 30)


def write_instantavatar(folder, scene):
    instantavatar.write_camera(folder, scene.plain)
    instantavatar.write_poses(folder, scene.poses)
    for frame in range(N):
        instantavatar.write_frame(folder, frame, scene.images[frame], scene.plain_masks[frame])


def write_refined(folder, split, frames, poses):
    pose, trans, betas = people_snapshot.stacked(poses)
    path = folder / f"poses/anim_nerf_{split}.npz"
    write_npz(path, {"betas": betas, "thetas": pose, "transl": trans, "frames": np.array(frames)})


def write_gaussianavatar(folder, scene):
    for split, frames in SPLIT.items():
        gaussianavatar.write_camera(folder, split, scene.plain)
        gaussianavatar.write_poses(folder, split, [scene.poses[frame] for frame in frames])
        for frame in frames:
            gaussianavatar.write_frame(folder, split, frame, scene.images[frame], scene.plain_masks[frame])


WRITERS = {"raw": write_raw, "instantavatar": write_instantavatar, "gaussianavatar": write_gaussianavatar}
READERS = {"raw": PeopleSnapshotRaw, "instantavatar": InstantAvatarFolder, "gaussianavatar": GaussianAvatarFolder}


@pytest.fixture(scope="module")
def written(tmp_path_factory, scene):
    """Layout -> root."""
    roots = {}
    for layout, write in WRITERS.items():
        roots[layout] = tmp_path_factory.mktemp(layout)
        write(roots[layout] / SUBJECT, scene)
    return roots


@pytest.fixture
def copy_of(written, tmp_path):
    """Layout -> a subject's folder to damage."""

    def copy(layout):
        shutil.copytree(written[layout], tmp_path / layout)
        return tmp_path / layout / SUBJECT

    return copy


@pytest.fixture
def raw(copy_of):
    return copy_of("raw")


@pytest.fixture
def instant(copy_of):
    return copy_of("instantavatar")


@pytest.fixture
def gaussian(copy_of):
    return copy_of("gaussianavatar")


def mark_standin(root):
    body = load_body()
    mark = {"generator": "ihbench", "version": 1, "seed": 0, "body": body.name, "body_sha": body.content_sha()}
    atomic.write_json(root / "STANDIN.json", mark)


def message(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


def problems(report) -> str:
    (subject,) = report.subjects
    assert report.ok == (not subject.problems)
    assert all("\n" not in problem for problem in subject.problems)
    return " | ".join(subject.problems)


def assert_same_camera(read: Camera, camera: Camera, atol: float):
    for name in ("K", "R", "t"):
        np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=atol)
    if camera.distortion is None:
        assert read.distortion is None
    else:
        np.testing.assert_array_equal(read.distortion, camera.distortion)
    assert (read.width, read.height) == (camera.width, camera.height)


def assert_same_pose(read: BodyPose, pose: BodyPose):
    for name in ("pose", "betas", "transl"):
        np.testing.assert_allclose(getattr(read, name), getattr(pose, name), rtol=1e-6, atol=1e-6)


def rewrite_hdf5(path, **changes):
    """Replace data sets, or remove those given as None."""
    with h5py.File(path, "r+") as file:
        for name, value in changes.items():
            del file[name]
            if value is not None:
                file[name] = value


def rewrite_npz(path, **changes):
    with np.load(path) as file:
        content = dict(file) | changes
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


# ------------------------------------------------------------------------------------------ all layouts


@pytest.mark.parametrize("layout", READERS)
def test_reading_gives_back_what_was_written(written, scene, layout):
    """Cameras to 1e-12, poses to 1e-6 (float32), masks exactly, images exactly but for the video's 32 dB."""
    dataset = READERS[layout](written[layout])
    assert dataset.subjects() == [SUBJECT]
    capture = dataset.open(SUBJECT)
    assert (capture.name, capture.dataset, capture.standin, capture.body) == (SUBJECT, "people_snapshot", "", "smpl")
    assert capture.variant == ("raw/equal" if layout == "raw" else layout)
    assert (capture.camera_ids, capture.n_frames, capture.gender) == (("camera",), N, "male")
    assert_same_camera(capture.camera(0), scene.camera if layout == "raw" else scene.plain, 1e-12)
    masks = scene.masks if layout == "raw" else scene.plain_masks
    for frame in [*SPLIT["train"], *SPLIT["test"]] if layout == "gaussianavatar" else range(N):
        assert_same_pose(capture.body_pose(frame), scene.poses[frame])
        image, mask = capture.image(0, frame), capture.silhouette(0, frame)
        assert (image.dtype, mask.dtype) == (np.uint8, bool)
        np.testing.assert_array_equal(mask, masks[frame])
        if layout == "raw":
            assert psnr(image, scene.images[frame]) > 32
            # another frame is much further off, so that the frame's number is tested as well
            assert psnr(image, scene.images[frame - 1]) < 28
        else:
            np.testing.assert_array_equal(image, scene.images[frame])


@pytest.mark.parametrize("layout", READERS)
def test_no_layout_accepts_another(written, layout, tmp_path):
    for other, reader in READERS.items():
        for root in (written[layout], written[layout] / SUBJECT):
            if other == layout:
                assert reader(root).subjects() == [SUBJECT]
            else:
                with pytest.raises(BadInput, match="no subject of this layout") as error:
                    reader(root)
                message(error)
    with pytest.raises(BadInput, match="no subject of this layout in it; expected"):
        READERS[layout](tmp_path)


@pytest.mark.parametrize("layout", READERS)
def test_writing_where_nothing_can_be_written(scene, layout, tmp_path):
    (tmp_path / SUBJECT).touch()  # holds for root, too, unlike permissions
    with pytest.raises(BadInput, match="a file stands where a folder should be") as error:
        WRITERS[layout](tmp_path / SUBJECT, scene)
    message(error)
    with pytest.raises(BadInput, match="a file stands where a folder should be"):
        people_snapshot.write_masks(tmp_path / SUBJECT, scene.masks, (N, HEIGHT, WIDTH))
    with pytest.raises(BadInput, match="a file stands where a folder should be"):
        people_snapshot.write_video(tmp_path / SUBJECT / "a.mp4", scene.images)


def test_raw_digest_follows_the_masks(raw):
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    before = capture.content_digest(0, 1)
    rewrite_hdf5(raw / "masks.hdf5", masks=np.zeros((N, HEIGHT, WIDTH), np.int8))
    assert capture.content_digest(0, 1) != before


def test_captures_can_be_pickled(written, scene):
    for layout, reader in READERS.items():
        capture = reader(written[layout]).open(SUBJECT)
        capture.image(0, 2), capture.silhouette(0, 2)
        again = pickle.loads(pickle.dumps(capture))
        np.testing.assert_array_equal(again.image(0, 0), capture.image(0, 0))
        np.testing.assert_array_equal(again.silhouette(0, 0), capture.silhouette(0, 0))


@pytest.mark.parametrize(
    ("name", "gender"),
    [("female-3-casual", "female"), ("male-1-sport", "male"), ("Female_4", "female"), ("somali-1", "neutral")],
)
def test_gender_is_in_the_name(written, tmp_path, name, gender):
    shutil.copytree(written["instantavatar"] / SUBJECT, tmp_path / name)
    assert InstantAvatarFolder(tmp_path).open(name).gender == gender


def test_betas_must_be_the_same_in_all_frames(tmp_path, scene):
    other = dataclasses.replace(scene.poses[1], betas=BETAS + 0.1)
    for write in (
        people_snapshot.write_poses,
        instantavatar.write_poses,
        lambda folder, poses: gaussianavatar.write_poses(folder, "train", poses),
    ):
        with pytest.raises(ValueError, match="same betas"):
            write(tmp_path, [scene.poses[0], other])


# ---------------------------------------------------------------------------------------------- raw: video


def test_frames_in_any_order_are_exact(written):
    video = people_snapshot.Video(written["raw"] / SUBJECT / f"{SUBJECT}.mp4")
    assert (video.n_frames, video.size) == (N, (HEIGHT, WIDTH))
    forward = [video.frame(i) for i in range(N)]
    for i in (7, 3, 3, 5, 0, 6, 1, 7, 2):
        np.testing.assert_array_equal(video.frame(i), forward[i])
    assert video._decoded.cache_info().currsize <= people_snapshot.KEPT_PICTURES
    video.frame(4)[:] = 0  # what is handed out may be painted on
    np.testing.assert_array_equal(video.frame(4), forward[4])


def test_a_video_that_is_shown_turned_is_refused(raw):
    """Players and OpenCV turn the frames, camera.pkl and the masks do not say whether they are turned."""
    path = raw / f"{SUBJECT}.mp4"
    data = bytearray(path.read_bytes())
    upright = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)
    at = data.index(upright, data.index(b"tkhd"))
    data[at : at + 36] = struct.pack(">9i", 0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    with pytest.raises(BadInput, match=r"shown turned by (90|270)°") as error:
        PeopleSnapshotRaw(raw.parent).open(SUBJECT)
    message(error)


@pytest.mark.parametrize("scale", [1, 255, np.nan])
def test_soft_masks_of_floating_point_numbers(raw, scene, scale):
    rewrite_hdf5(raw / "masks.hdf5", masks=(0.2 + 0.6 * np.stack(scene.masks).astype(np.float32)) * scale)
    capture = PeopleSnapshotRaw(raw.parent).open(SUBJECT)
    if np.isfinite(scale):
        np.testing.assert_array_equal(capture.silhouette(0, 3), scene.masks[3])
    else:
        with pytest.raises(BadInput, match="mask 3: expected 0 to 1"):
            capture.silhouette(0, 3)


def test_threads_share_a_capture(written, scene):
    capture = PeopleSnapshotRaw(written["raw"]).open(SUBJECT)
    bad = []

    def read(seed):
        for frame in np.random.default_rng(seed).permutation(N).tolist():
            same = np.array_equal(capture.silhouette(0, frame), scene.masks[frame])
            if psnr(capture.image(0, frame), scene.images[frame]) < 32 or not same:
                bad.append(frame)

    threads = [threading.Thread(target=read, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not bad


def test_opening_decodes_nothing(raw, monkeypatch):
    def refuse(*_):
        raise AssertionError("decoded a picture while opening")

    monkeypatch.setattr(people_snapshot.Video, "frame", refuse)
    monkeypatch.setattr(people_snapshot.MaskFile, "frame", refuse)
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert (capture.n_frames, capture.variant, capture.camera(0).width) == (N, "raw/equal", WIDTH)


def index_first(data: bytes) -> bytes:
    """An mp4 with its index (moov) moved before the pictures (mdat), as for streaming."""
    boxes, at = [], 0
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        boxes.append((data[at + 4 : at + 8], data[at : at + size]))
        at += size
    moov = next(box for kind, box in boxes if kind == b"moov")
    at = moov.index(b"stco")
    count = int.from_bytes(moov[at + 8 : at + 12], "big")
    for k in range(count):
        here = at + 12 + 4 * k
        moved = int.from_bytes(moov[here : here + 4], "big") + len(moov)
        moov = moov[:here] + moved.to_bytes(4, "big") + moov[here + 4 :]
    rest = [box for kind, box in boxes if kind not in (b"moov", b"ftyp")]
    return next(box for kind, box in boxes if kind == b"ftyp") + moov + b"".join(rest)


def test_video_that_ends_before_its_header_says(raw):
    path = raw / f"{SUBJECT}.mp4"
    data = index_first(path.read_bytes())
    path.write_bytes(data)
    whole = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert whole.image(0, N - 1).any()
    start = data.index(b"mdat")
    path.write_bytes(data[: start + (len(data) - start) * 6 // 10])
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert capture.n_frames == N
    assert capture.image(0, 0).any()
    for _ in range(2):
        with pytest.raises(BadInput, match=rf"ends after \d frames, but frame 7 .* promises {N}; copy") as error:
            capture.image(0, N - 1)
        message(error)
    np.testing.assert_array_equal(capture.image(0, 0), whole.image(0, 0))  # what is there is still read
    assert "ends after" in problems(PeopleSnapshotRaw.check(raw))


def test_video_shorter_than_the_masks(tmp_path, scene):
    write_raw(tmp_path / SUBJECT, scene, n_video=5)
    assert PeopleSnapshotRaw(tmp_path).open(SUBJECT).n_frames == 5
    report = PeopleSnapshotRaw.check(tmp_path)
    assert "5 frames of video, 8 masks" in report.subjects[0].warnings[0]
    assert report.subjects[0].missing == {"video": 3, "poses": 0}


def test_fewer_poses_than_masks(raw, scene):
    people_snapshot.write_poses(raw, scene.poses[:6])
    assert PeopleSnapshotRaw(raw).open(SUBJECT).n_frames == 6
    assert "8 masks, 6 poses" in PeopleSnapshotRaw.check(raw).subjects[0].warnings[0]


def test_video_of_another_size(raw, scene):
    people_snapshot.write_video(raw / f"{SUBJECT}.mp4", [image[:32] for image in scene.images])
    with pytest.raises(BadInput, match=r"mp4: 48×32 px, but camera.pkl says 48×64 px"):
        PeopleSnapshotRaw(raw).open(SUBJECT)


def test_video_writer_refuses_what_the_codec_cannot_hold(tmp_path, scene):
    for frames in ([], [scene.images[0][:33]], [scene.images[0], scene.images[1][:32]], [scene.images[0][..., 0]]):
        with pytest.raises(ValueError, match="video: expected"):
            people_snapshot.write_video(tmp_path / "a.mp4", frames)
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------- raw: HDF5 and camera.pkl


def test_files_are_those_of_the_release(written):
    folder = written["raw"] / SUBJECT
    with h5py.File(folder / "masks.hdf5") as masks, h5py.File(folder / "reconstructed_poses.hdf5") as poses:
        assert (masks["masks"].shape, masks["masks"].dtype) == ((N, HEIGHT, WIDTH), np.int8)
        assert set(np.unique(masks["masks"][()])) == {0, 1}
        shapes = {name: (data.shape, data.dtype) for name, data in poses.items()}
    assert shapes == {"pose": ((N, 72), np.float32), "trans": ((N, 3), np.float32), "betas": ((10,), np.float32)}
    with open(folder / "camera.pkl", "rb") as file:
        camera = pickle.load(file, encoding="latin1")
    assert camera.keys() == people_snapshot.CAMERA_SIZES.keys()
    np.testing.assert_allclose(camera["camera_c"], make_camera(True).K[:2, 2] - 0.5)
    assert not camera["camera_t"].any()
    assert not camera["camera_rt"].any()


def test_writing_twice_gives_the_same_bytes(tmp_path, scene):
    for name in ("a", "b"):
        people_snapshot.write_masks(tmp_path / name, scene.masks, (N, HEIGHT, WIDTH))
        people_snapshot.write_poses(tmp_path / name, scene.poses)
    for name in ("masks.hdf5", "reconstructed_poses.hdf5"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_failed_writer_leaves_the_old_file(raw, scene):
    before = (raw / "masks.hdf5").read_bytes()
    for masks in (scene.masks[:-1], [*scene.masks, scene.masks[0]], [scene.masks[0][1:]]):
        with pytest.raises(ValueError, match="masks: expected 8"):
            people_snapshot.write_masks(raw, masks, (N, HEIGHT, WIDTH))
    assert (raw / "masks.hdf5").read_bytes() == before
    assert not [path for path in raw.iterdir() if path.name.endswith(".tmp")]


def test_consensus_and_keypoints_come_back(raw, scene):
    rng = np.random.default_rng(0)
    offsets, keypoints = rng.normal(size=(6890, 3)), rng.uniform(0, 60, (N, 18, 3)).astype(np.float32)
    people_snapshot.write_consensus(raw, BETAS + 0.25, offsets)
    with h5py.File(raw / "keypoints.hdf5", "w") as file:
        file["keypoints"] = keypoints.reshape(N, 54)
    betas, v_personal = people_snapshot.read_consensus(raw / "consensus.pkl")
    np.testing.assert_array_equal(betas, BETAS + 0.25)
    np.testing.assert_array_equal(v_personal, offsets)
    np.testing.assert_array_equal(people_snapshot.read_keypoints(raw / "keypoints.hdf5"), keypoints)
    report = PeopleSnapshotRaw.check(raw)
    assert problems(report) == ""
    assert report.subjects[0].consensus_betas == 0.25
    assert report.subjects[0].files["keypoints"] == N
    (raw / "consensus.pkl").write_bytes(b"nothing")
    rewrite_hdf5(raw / "keypoints.hdf5", keypoints=np.zeros((N, 51)))
    found = problems(PeopleSnapshotRaw.check(raw))
    assert "consensus.pkl: cannot be read" in found
    assert "'keypoints' to be numbers of shape [n, 54], found [8, 51]" in found


def test_hdf5_with_damaged_masks(raw):
    path = raw / "masks.hdf5"
    with h5py.File(path) as file:
        chunk = file["masks"].id.get_chunk_info(3)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset : chunk.byte_offset + chunk.size] = b"\xff" * chunk.size
    path.write_bytes(data)
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert capture.silhouette(0, 2).any()
    with pytest.raises(BadInput, match=r"masks.hdf5: mask 3 is damaged") as error:
        capture.silhouette(0, 3)
    message(error)


@pytest.mark.parametrize("kind", ["soft link", "external link", "virtual"])
def test_hdf5_that_points_elsewhere(raw, kind):
    path, other = raw / "masks.hdf5", raw / "other.hdf5"
    path.rename(other)
    with h5py.File(path, "w") as file:
        if kind == "virtual":
            layout = h5py.VirtualLayout((N, HEIGHT, WIDTH), np.uint8)
            layout[:] = h5py.VirtualSource(other, "masks", (N, HEIGHT, WIDTH))
            file.create_virtual_dataset("masks", layout)
        else:
            file["masks"] = h5py.ExternalLink(other, "masks") if kind == "external link" else h5py.SoftLink("/masks2")
    with pytest.raises(BadInput, match=r"masks.hdf5: expected a data set 'masks' in it") as error:
        PeopleSnapshotRaw(raw).open(SUBJECT)
    message(error)


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("masks.hdf5", {"masks": None}, "expected a data set 'masks' in it, found nothing"),
        ("reconstructed_poses.hdf5", {"trans": None}, "expected a data set 'trans' in it, found betas, pose"),
        (
            "masks.hdf5",
            {"masks": np.zeros((N, HEIGHT))},
            r"shape \[N, H, W\], found float64 \[8, 64\]",
        ),
        ("masks.hdf5", {"masks": np.zeros((0, HEIGHT, WIDTH))}, "shape .N, H, W."),
        ("masks.hdf5", {"masks": b"text"}, "to be numbers"),
        ("masks.hdf5", {"masks": np.zeros((N, HEIGHT, 40), np.int8)}, r"40×64 px, but camera.pkl says 48×64 px"),
        (
            "reconstructed_poses.hdf5",
            {"pose": np.zeros((N, 69))},
            r"'pose' .* shape \[n, 72\], found \[8, 69\]",
        ),
        (
            "reconstructed_poses.hdf5",
            {"trans": np.zeros((N, 4))},
            r"'trans' .* shape \[n, 3\], found \[8, 4\]",
        ),
        (
            "reconstructed_poses.hdf5",
            {"trans": np.zeros((N - 1, 3))},
            "'trans' for each 'pose', found 7 and 8",
        ),
        ("reconstructed_poses.hdf5", {"betas": np.zeros(9)}, r"'betas' to be numbers of shape \[10\], found \[9\]"),
        ("reconstructed_poses.hdf5", {"betas": np.full(10, np.nan)}, "NaN or infinity in 'betas'"),
    ],
)
def test_hdf5_of_another_shape(raw, name, changes, expected):
    rewrite_hdf5(raw / name, **changes)
    with pytest.raises(BadInput, match=expected) as error:
        PeopleSnapshotRaw(raw).open(SUBJECT)
    assert name in message(error)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["pose", "trans"])
def test_nan_in_one_pose(raw, scene, name, bad):
    with h5py.File(raw / "reconstructed_poses.hdf5", "r+") as file:
        file[name][3, 1] = bad
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert_same_pose(capture.body_pose(2), scene.poses[2])
    with pytest.raises(BadInput, match=f"NaN or infinity in the {name} of row 3; leave this frame out") as error:
        capture.body_pose(3)
    message(error)
    assert "NaN or infinity in 1 row (3)" in problems(PeopleSnapshotRaw.check(raw))


def change_camera(folder, **changes):
    with open(folder / "camera.pkl", "rb") as file:
        content = pickle.load(file) | changes
    content = {key: value for key, value in content.items() if value is not None}
    (folder / "camera.pkl").write_bytes(pickle.dumps(content, protocol=2))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_k": None}, "'camera_k' to be numbers of shape .*, found no such key"),
        ({"width": None}, "'width' to be numbers of shape .*, found no such key"),
        ({"camera_f": np.ones(3)}, "'camera_f' to be numbers of shape .*, found .3"),
        ({"camera_f": np.array([100, -1])}, "positive focal lengths"),
        ({"camera_c": "middle"}, "'camera_c' to be .*, found a str"),
        ({"camera_c": [np.nan, 1]}, "NaN or infinity in 'camera_c'"),
        ({"height": 64.5}, "whole pixels"),
        ({"height": 0}, "whole pixels"),
    ],
)
def test_camera_file_of_another_shape(raw, changes, expected):
    change_camera(raw, **changes)
    with pytest.raises(BadInput, match=expected) as error:
        PeopleSnapshotRaw(raw).open(SUBJECT)
    assert "camera.pkl" in message(error)


def test_camera_file_of_something_else(raw):
    for data in (pickle.dumps([1, 2]), b"", (raw / "camera.pkl").read_bytes()[:-30]):
        (raw / "camera.pkl").write_bytes(data)
        with pytest.raises(BadInput, match=r"camera.pkl: ") as error:
            PeopleSnapshotRaw(raw).open(SUBJECT)
        message(error)


def test_camera_away_from_the_origin_and_missing_extrinsics(raw, tmp_path):
    R = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    camera = dataclasses.replace(make_camera(True), R=R, t=np.array([1.0, -2, 3]))
    people_snapshot.write_camera(tmp_path, camera)
    assert_same_camera(people_snapshot.read_camera(tmp_path / "camera.pkl"), camera, 1e-12)
    change_camera(raw, camera_t=None, camera_rt=None)
    assert_same_camera(PeopleSnapshotRaw(raw).open(SUBJECT).camera(0), make_camera(True), 1e-12)
    with pytest.raises(ValueError, match="skew"):
        people_snapshot.write_camera(tmp_path, dataclasses.replace(camera, K=camera.K + np.eye(3, k=1)))


def test_camera_file_of_python_2(raw):
    """Written by python 2 and old numpy: text as bytes, protocol 2, numpy.core."""
    change_camera(raw)
    assert b"numpy._core" in (raw / "camera.pkl").read_bytes() or b"numpy.core" in (raw / "camera.pkl").read_bytes()
    assert_same_camera(PeopleSnapshotRaw(raw).open(SUBJECT).camera(0), make_camera(True), 1e-12)


# --------------------------------------------------------------- raw: which poses belong to which masks


@pytest.mark.parametrize("true", ["first", "last"])
def test_silhouettes_decide_which_poses_are_theirs(raw, scene, smpl, true):
    extra = [dataclasses.replace(scene.poses[0], transl=[-0.4 + 0.1 * i, 0.1, 3.0]) for i in range(4)]
    people_snapshot.write_poses(raw, [*extra, *scene.poses] if true == "last" else [*scene.poses, *extra])
    capture = PeopleSnapshotRaw(raw).open(SUBJECT, smpl)
    assert (capture.alignment, capture.variant, capture.n_frames) == (true, f"raw/{true}", N)
    for frame in range(N):
        assert_same_pose(capture.body_pose(frame), scene.poses[frame])
    report = PeopleSnapshotRaw.check(raw, smpl)
    assert problems(report) == ""
    found = report.subjects[0].alignment
    assert found["chosen"] == true
    assert found[true] > 0.95 > 0.9 > found["first" if true == "last" else "last"]


def test_without_a_body_the_first_poses_are_taken(raw, scene):
    people_snapshot.write_poses(raw, [*scene.poses, *scene.poses[:2]])
    capture = PeopleSnapshotRaw(raw).open(SUBJECT)
    assert (capture.alignment, capture.variant) == ("first", "raw/first")
    assert_same_pose(capture.body_pose(3), scene.poses[3])
    found = PeopleSnapshotRaw.check(raw).subjects[0]
    assert found.alignment == {"chosen": "first", "first": None, "last": None}


def test_surplus_poses_that_are_nan(raw, scene, smpl):
    people_snapshot.write_poses(raw, [*scene.poses, scene.poses[0], scene.poses[0]])
    with h5py.File(raw / "reconstructed_poses.hdf5", "r+") as file:
        file["pose"][:] = np.nan
    assert PeopleSnapshotRaw(raw).open(SUBJECT, smpl).alignment == "first"


# ---------------------------------------------------------------------------------------- instantavatar


@pytest.mark.parametrize("kind", ["float", "bytes", "soft", "bool", "channel"])
def test_masks_of_several_kinds(instant, scene, kind):
    mask = scene.plain_masks[1]
    stored = {
        "float": mask.astype(np.float32),
        "bytes": np.where(mask, 200, 100).astype(np.uint8),
        "soft": np.where(mask, 0.51, 0.49),
        "bool": mask,
        "channel": mask[..., None].astype(np.uint8),
    }[kind]
    np.save(instant / "masks/mask_0001.npy", stored)
    np.testing.assert_array_equal(InstantAvatarFolder(instant).open(SUBJECT).silhouette(0, 1), mask)


@pytest.mark.parametrize(
    ("stored", "expected"),
    [
        (np.zeros((HEIGHT, WIDTH, 3)), r"shape \[H, W\], found a float64 array of shape \[64, 48, 3\]"),
        (np.zeros((HEIGHT, WIDTH - 1)), "47×64 px, but the camera's images are 48×64 px"),
        (np.full((HEIGHT, WIDTH), np.nan), "0 to 255, found nan"),
        (np.full((HEIGHT, WIDTH), 1000), "0 to 255, found 1000"),
        (np.zeros((HEIGHT, WIDTH), "U3"), r"expected numbers"),
    ],
)
def test_bad_mask_arrays(instant, stored, expected):
    np.save(instant / "masks/mask_0001.npy", stored)
    with pytest.raises(BadInput, match=expected) as error:
        InstantAvatarFolder(instant).open(SUBJECT).silhouette(0, 1)
    assert "mask_0001.npy" in message(error)


def test_refined_poses_replace_those_of_their_frames(instant, scene):
    refined = [dataclasses.replace(p, transl=p.transl + 0.5, betas=BETAS + 1) for p in scene.poses]
    write_refined(instant, "train", [1, 3], [refined[1], refined[3]])
    write_refined(instant, "test", [6], [refined[6]])
    capture = InstantAvatarFolder(instant).open(SUBJECT)
    assert capture.variant == "instantavatar/anim_nerf"
    for frame in range(N):
        assert_same_pose(capture.body_pose(frame), (refined if frame in (1, 3, 6) else scene.poses)[frame])
    files = InstantAvatarFolder.check(instant).subjects[0].files
    assert (files["anim_nerf_train"], files["anim_nerf_test"]) == (2, 1)
    write_refined(instant, "test", [3], [refined[3]])
    with pytest.raises(BadInput, match=r"frame 3 has refined poses in poses/anim_nerf_train.npz, too") as error:
        InstantAvatarFolder(instant).open(SUBJECT)
    message(error)


@pytest.mark.parametrize(
    ("subject", "split", "frames"),
    [
        ("female-3-casual", "train", range(0, 445, 4)),
        ("female-4-casual", "test", range(335, 524, 4)),
        ("male-3-casual", "train", range(0, 455, 4)),
        ("male-3-casual", "test", range(456, 676, 4)),
        ("male-4-casual", "test", range(660, 873, 6)),
    ],
)
def test_refined_poses_of_the_official_splits(tmp_path, scene, subject, split, frames):
    """Anim-NeRF's files name no frames; here the x of a pose is its frame's number."""
    folder = tmp_path / subject
    instantavatar.write_camera(folder, scene.plain)
    instantavatar.write_frame(folder, 872, scene.images[0], scene.masks[0])
    poses = [dataclasses.replace(scene.poses[0], transl=[-1, 0, 3])] * 873
    instantavatar.write_poses(folder, poses)
    refined = [dataclasses.replace(scene.poses[0], transl=[frame, 0, 3]) for frame in frames]
    write_refined(folder, split, list(frames), refined)
    path = folder / f"poses/anim_nerf_{split}.npz"
    rewrite_npz(path, frames=None)
    capture = InstantAvatarFolder(tmp_path).open(subject)
    assert capture.n_frames == 873
    for frame in range(873):
        assert capture.body_pose(frame).transl[0] == (frame if frame in frames else -1)
    with np.load(path) as file:
        thetas, transl = file["thetas"], file["transl"]
    # global_orient and body_pose in place of thetas, as InstantAvatar accepts
    rewrite_npz(path, thetas=None, global_orient=thetas[:, :3], body_pose=thetas[:, 3:])
    assert_same_pose(InstantAvatarFolder(tmp_path).open(subject).body_pose(frames[1]), refined[1])
    rewrite_npz(path, thetas=thetas[1:], transl=transl[1:])
    with pytest.raises(BadInput, match=rf"{len(frames) - 1} poses, but no 'frames' .* has {len(frames)}") as error:
        InstantAvatarFolder(tmp_path).open(subject)
    message(error)


@pytest.mark.parametrize(
    ("frames", "expected"),
    [
        ([1, 1], "2 different frame numbers"),
        ([1, 2, 3], "2 different frame numbers"),
        ([1.0, 2.0], "2 different frame numbers"),
        ([1, N], f"refines frames 1 to {N}, but poses.npz has {N} poses"),
        ([-1, 2], "refines frames -1 to 2"),
        (None, "add the frame numbers as 'frames'"),
    ],
)
def test_refined_poses_of_other_frames(instant, scene, frames, expected):
    write_refined(instant, "train", [0, 1], scene.poses[:2])
    rewrite_npz(instant / "poses/anim_nerf_train.npz", frames=None if frames is None else np.array(frames))
    with pytest.raises(BadInput, match=expected):
        InstantAvatarFolder(instant).open(SUBJECT)
    instant.rename(instant.with_name("someone"))
    with pytest.raises(BadInput, match=expected if frames else "no official split"):
        InstantAvatarFolder(instant.parent).open("someone")


@pytest.mark.parametrize(
    ("name", "changes", "expected"),
    [
        ("cameras.npz", {"intrinsic": None}, "'intrinsic' to be numbers .*, found no such key"),
        ("cameras.npz", {"intrinsic": np.eye(4)}, r"shape \[3, 3\], found \[4, 4\]"),
        ("cameras.npz", {"intrinsic": np.full((3, 3), np.nan)}, "finite"),
        ("cameras.npz", {"extrinsic": np.eye(3)}, r"'extrinsic' to be numbers of shape \[4, 4\]"),
        ("cameras.npz", {"extrinsic": np.diag([-1.0, 1, 1, 1])}, "with a rotation R"),
        ("cameras.npz", {"extrinsic": np.full((4, 4), np.inf)}, "NaN or infinity in 'extrinsic'"),
        ("cameras.npz", {"height": np.array(63.5)}, "width and height in whole pixels"),
        ("cameras.npz", {"width": np.array([48, 64])}, r"'width' to be numbers of shape \[1\], found \[2\]"),
        ("poses.npz", {"thetas": None}, "'thetas' to be numbers .*, found no such key"),
        ("poses.npz", {"thetas": np.zeros((N, 69))}, r"'thetas' to be numbers of shape \[n, 72\], found \[8, 69\]"),
        ("poses.npz", {"transl": np.zeros((3, 3))}, "expected one 'transl' for each 'thetas', found 3 and 8"),
        ("poses.npz", {"betas": np.zeros(3)}, r"'betas' to be numbers of shape \[10\]"),
        ("poses.npz", {"betas": np.array(["a"] * 10)}, "'betas' to be numbers"),
    ],
)
def test_npz_of_another_shape(instant, name, changes, expected):
    rewrite_npz(instant / name, **changes)
    with pytest.raises(BadInput, match=expected) as error:
        InstantAvatarFolder(instant).open(SUBJECT)
    assert name in message(error)


def test_images_that_are_missing(instant, scene):
    (instant / "images/image_0003.png").unlink()
    (instant / "images/image_0007.png").unlink()
    (instant / "masks/mask_0002.npy").unlink()
    capture = InstantAvatarFolder(instant).open(SUBJECT)
    assert capture.n_frames == 7  # of the eight poses the last has no image
    with pytest.raises(BadInput, match=r"image_0003.png: no such file"):
        capture.image(0, 3)
    with pytest.raises(BadInput, match=r"mask_0002.npy: no such file"):
        capture.silhouette(0, 2)
    assert problems(InstantAvatarFolder.check(instant)) == "1 of image missing | 1 of mask missing"
    mark_standin(instant.parent)  # which is no problem of a stand-in, and does not shorten it
    assert InstantAvatarFolder(instant).open(SUBJECT).n_frames == N
    assert problems(InstantAvatarFolder.check(instant)) == ""
    instantavatar.write_frame(instant, 9, scene.images[0], scene.masks[0])
    assert "1 images have no pose" in InstantAvatarFolder.check(instant).subjects[0].warnings[0]
    shutil.rmtree(instant / "images")
    with pytest.raises(BadInput, match=r"no image_NNNN.png"):
        InstantAvatarFolder(instant).open(SUBJECT)


def test_nan_in_one_row(instant):
    with np.load(instant / "poses.npz") as file:
        thetas = file["thetas"]
    thetas[2, 5] = np.nan
    rewrite_npz(instant / "poses.npz", thetas=thetas)
    with pytest.raises(BadInput, match="NaN or infinity in the pose of row 2"):
        InstantAvatarFolder(instant).open(SUBJECT).body_pose(2)
    assert "NaN or infinity in 1 row (2)" in problems(InstantAvatarFolder.check(instant))


def test_undistorted_layouts_refuse_distortion(tmp_path, scene):
    with pytest.raises(ValueError, match="distortion"):
        instantavatar.write_camera(tmp_path, scene.camera)
    with pytest.raises(ValueError, match="distortion"):
        gaussianavatar.write_camera(tmp_path, "train", scene.camera)


# --------------------------------------------------------------------------------------- gaussianavatar


def test_frames_are_the_numbers_of_the_images(written):
    capture = GaussianAvatarFolder(written["gaussianavatar"]).open(SUBJECT)
    assert capture.frames == [0, 2, 4, 5, 7]
    assert [capture.split_of(frame) for frame in capture.frames] == ["train"] * 3 + ["test"] * 2
    for read in (lambda: capture.image(0, 3), lambda: capture.silhouette(0, 3), lambda: capture.body_pose(3)):
        with pytest.raises(BadInput, match="no image of frame 3") as error:
            read()
        message(error)
    assert len(capture.content_digest(0, 3)) == 32


@pytest.mark.parametrize("kind", ["words", "collision"])
def test_other_names_are_counted(gaussian, scene, kind):
    """Rows follow the sorted names, train before test."""
    renamed = {"words": ("000000", "a_000000"), "collision": ("000002", "000005")}[kind]
    for folder, end in (("images", "png"), ("masks", "png")):
        (gaussian / f"train/{folder}/{renamed[0]}.{end}").rename(gaussian / f"train/{folder}/{renamed[1]}.{end}")
    capture = GaussianAvatarFolder(gaussian).open(SUBJECT)
    assert (capture.n_frames, capture.frames, capture.numbered) == (5, [0, 1, 2, 3, 4], False)
    # the names in order are 000002, 000004, a_000000 or 000000, 000004, 000005
    shown = [2, 4, 0, 5, 7] if kind == "words" else [0, 4, 2, 5, 7]
    for frame, row in enumerate([0, 2, 4, 5, 7]):
        np.testing.assert_array_equal(capture.image(0, frame), scene.images[shown[frame]])
        np.testing.assert_array_equal(capture.silhouette(0, frame), scene.plain_masks[shown[frame]])
        assert_same_pose(capture.body_pose(frame), scene.poses[row])


def test_jpeg_images_and_grey_masks(gaussian, scene):
    path = gaussian / "train/images/000002.png"
    path.unlink()
    Image.fromarray(scene.images[2]).save(path.with_suffix(".jpg"), quality=95)
    mask = np.full((HEIGHT, WIDTH), 127, np.uint8)
    mask[10:20] = 128
    Image.fromarray(mask).save(gaussian / "train/masks/000002.png")
    capture = GaussianAvatarFolder(gaussian).open(SUBJECT)
    assert psnr(capture.image(0, 2), scene.images[2]) > 30
    np.testing.assert_array_equal(capture.silhouette(0, 2), mask == 128)
    Image.fromarray(mask == 128).save(gaussian / "train/masks/000002.png")  # one bit a pixel
    np.testing.assert_array_equal(capture.silhouette(0, 2), mask == 128)


def own_cameras(folder, split, frames, moved=0.0):
    with np.load(folder / split / "cam_parms.npz") as file:
        content = dict(file)
    (folder / split / "cam_parms.npz").unlink()
    (folder / split / "cam_parms").mkdir()
    for frame in frames:
        content["extrinsic"][0, 3] += moved
        np.savez(folder / split / "cam_parms" / f"{frame:06d}.npz", **content)


def test_a_camera_file_for_each_image(gaussian, scene):
    for split, frames in SPLIT.items():
        own_cameras(gaussian, split, frames)
    assert_same_camera(GaussianAvatarFolder(gaussian).open(SUBJECT).camera(0), scene.plain, 1e-12)
    (gaussian / "test/cam_parms/000007.npz").unlink()
    with pytest.raises(BadInput, match=r"cam_parms/000007.npz: no such file"):
        GaussianAvatarFolder(gaussian).open(SUBJECT).camera(0)


def test_a_moving_camera_is_refused(gaussian):
    own_cameras(gaussian, "test", SPLIT["test"], moved=0.01)
    with pytest.raises(BadInput, match=r"another camera than .*; expected one fixed camera") as error:
        GaussianAvatarFolder(gaussian).open(SUBJECT).camera(0)
    message(error)
    assert "one fixed camera" in problems(GaussianAvatarFolder.check(gaussian))


def test_opening_lists_names_only(gaussian):
    for path in gaussian.rglob("*.*"):
        if path.is_file():
            path.write_bytes(b"")
    assert GaussianAvatarFolder(gaussian).open(SUBJECT).n_frames == N
    assert "train/smpl_parms.pth" in problems(GaussianAvatarFolder.check(gaussian))


def change_parameters(folder, **changes):
    path = folder / "train/smpl_parms.pth"
    content = torch.load(path, weights_only=True) | changes
    torch.save({key: value for key, value in content.items() if value is not None}, path)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"trans": None}, "'trans' to be numbers .*, found no such key"),
        ({"body_pose": torch.zeros(3, 69)}, r"'body_pose' to be numbers of shape \[n, 72\], found \[3, 69\]"),
        ({"body_pose": torch.zeros(2, 72), "trans": torch.zeros(2, 3)}, "2 poses, but train/images holds 3 images"),
        ({"trans": torch.zeros(2, 3)}, "found 2 and 3"),
        ({"beta": torch.zeros(1, 9)}, r"'beta' to be numbers of shape \[10\], found"),
        ({"beta": [0.0] * 10}, "expected a tensor of numbers in 'beta', found a list"),
        ({"trans": torch.full((3, 3), torch.nan)}, "NaN or infinity in the trans of row 0"),
        ({"beta": torch.full((1, 10), torch.inf)}, "NaN or infinity in 'beta'"),
        ({"trans": np.zeros((3, 3))}, "not a file of plain tensors"),
    ],
)
def test_parameter_files_of_another_shape(gaussian, changes, expected):
    change_parameters(gaussian, **changes)
    capture = GaussianAvatarFolder(gaussian).open(SUBJECT)
    with pytest.raises(BadInput, match=expected) as error:
        capture.body_pose(0)
    assert "train/smpl_parms.pth" in message(error)
    assert capture.body_pose(5).transl.any()  # the other split is whole
    assert "smpl_parms.pth" in problems(GaussianAvatarFolder.check(gaussian))


def test_masks_or_a_split_missing(gaussian):
    (gaussian / "train/masks/000002.png").unlink()
    with pytest.raises(BadInput, match=r"masks/000002.png: no such file"):
        GaussianAvatarFolder(gaussian).open(SUBJECT).silhouette(0, 2)
    shutil.rmtree(gaussian / "test")
    assert problems(GaussianAvatarFolder.check(gaussian)) == "1 of mask missing | no image in test/images"
    for path in (gaussian / "train/images").iterdir():
        path.unlink()
    with pytest.raises(BadInput, match="no image in train/images or test/images"):
        GaussianAvatarFolder(gaussian).open(SUBJECT)


def test_copy_made_beside_its_source_is_gaussianavatars(gaussian, written):
    """GaussianAvatar's script leaves cameras.npz, images/ and masks/ where it makes train/ and test/."""
    shutil.copytree(written["instantavatar"] / SUBJECT, gaussian, dirs_exist_ok=True)
    assert GaussianAvatarFolder(gaussian).subjects() == [SUBJECT]
    with pytest.raises(BadInput, match="no subject of this layout"):
        InstantAvatarFolder(gaussian)


def test_folder_that_holds_several_layouts_is_the_released_one(raw, written):
    for layout in ("instantavatar", "gaussianavatar"):
        shutil.copytree(written[layout] / SUBJECT, raw, dirs_exist_ok=True)
        assert PeopleSnapshotRaw(raw).subjects() == [SUBJECT]
        for other in (InstantAvatarFolder, GaussianAvatarFolder):
            with pytest.raises(BadInput, match="no subject of this layout"):
                other(raw)


def test_an_upper_case_ending_of_the_video_is_read(raw):
    (raw / f"{SUBJECT}.mp4").rename(raw / f"{SUBJECT}.MP4")
    assert PeopleSnapshotRaw(raw).open(SUBJECT).n_frames == N


def test_a_file_of_another_spelling_is_named(instant, gaussian):
    (instant / "images/image_0001.png").rename(instant / "images/image_0001.PNG")
    capture = GaussianAvatarFolder(gaussian).open(SUBJECT)
    path = capture.mask_path(capture.frames[0])
    path.rename(path.with_suffix(".PNG"))
    with pytest.raises(BadInput, match=r"there is 'image_0001.PNG', rename it to 'image_0001.png'"):
        InstantAvatarFolder(instant).open(SUBJECT).image(0, 1)
    with pytest.raises(BadInput, match=rf"there is '{path.stem}.PNG', rename it to '{path.name}'"):
        capture.silhouette(0, capture.frames[0])
