"""ZJU-MoCap's other layouts: the refine repack and HumanNeRF's; what is written is read, and none is mistaken."""

import dataclasses
import pickle

import numpy as np
import pytest

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.datasets.layouts import ZJU_MOCAP
from ihbench.datasets.zju_mocap import humannerf
from ihbench.datasets.zju_mocap import original as zju_mocap
from ihbench.datasets.zju_mocap import refine as zju_refine
from ihbench.datasets.zju_mocap.humannerf import HumanNerfFormat, betas_of_joints
from ihbench.datasets.zju_mocap.refine import ZjuRefine
from ihbench.errors import BadInput

WIDTH, HEIGHT, N_FRAMES = 64, 48, 3
PATHS = [[f"images/{camera:02d}/{frame:06d}.jpg" for camera in range(2)] for frame in range(N_FRAMES)]


@pytest.fixture(scope="module")
def smpl():
    return dataclasses.replace(load_body(), name="smpl")


@pytest.fixture(scope="module")
def scene(smpl):
    """Two cameras, three poses, an image and a mask of each view that fit the body."""
    rng = np.random.default_rng(0)
    cameras, poses = [], []
    for k in range(2):
        R, t = look_at(np.array([2.6 - 5 * k, 0.1, 2.0]), np.array([0.0, -0.1, 0.0]))
        lens = np.array([-0.1, 0.03, 1e-3, -5e-4, 0.002])
        cameras.append(Camera(np.array([[70, 0, 31.0], [0, 71, 25.0], [0, 0, 1]]), R, t, WIDTH, HEIGHT, lens))
    betas = rng.normal(size=10)
    for _ in range(N_FRAMES):
        pose = 0.2 * rng.normal(size=(24, 3))
        poses.append(BodyPose(pose, betas, 0.1 * rng.normal(size=3)))
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    views = {}
    for c, camera in enumerate(cameras):
        for f, pose in enumerate(poses):
            points = camera.project(smpl.pose(pose))[:, :2].astype(int)
            mask = np.zeros((HEIGHT, WIDTH), bool)
            inside = ((points >= 0) & (points < (WIDTH, HEIGHT))).all(1)
            mask[points[inside, 1], points[inside, 0]] = True
            views[c, f] = np.stack([3 * x, 5 * y, 0 * x + 40 * c + f], -1).astype(np.uint8), mask
    return cameras, poses, views


@pytest.fixture
def refine(scene, smpl, tmp_path):
    cameras, poses, views = scene
    folder = tmp_path / "zju" / "my_377"
    zju_mocap.write_annots(folder, cameras, PATHS)
    for f, pose in enumerate(poses):
        zju_mocap.write_params(folder, f, pose, smpl, "smpl_params")
        zju_mocap.write_vertices(folder, f, smpl.pose(pose), "smpl_params")
        for c in range(2):
            zju_refine.write_frame(folder, PATHS[f][c], *views[c, f])
    return folder


@pytest.fixture
def nerf(scene, smpl, tmp_path):
    return write_nerf(tmp_path / "nerf" / "377", scene, smpl)


def write_nerf(folder, scene, smpl, with_betas=True, monocular=False):
    cameras, poses, views = scene
    listed = {}
    for c in range(1 if monocular else 2):
        for f, pose in enumerate(poses):
            name = f"frame_{f:06d}" if monocular else f"camera_{c + 1:02d}_frame_{f:06d}"
            listed[name] = cameras[c], pose
            humannerf.write_view(folder, name, *views[c, f])
    humannerf.write_pickles(folder, listed, smpl)
    if not with_betas:
        infos = pickle.loads((folder / "mesh_infos.pkl").read_bytes())
        for info in infos.values():
            del info["betas"]
        (folder / "mesh_infos.pkl").write_bytes(pickle.dumps(infos))
        (folder / "canonical_joints.pkl").unlink()
    return folder


def check_same(capture, scene, smpl, lossless):
    cameras, poses, views = scene
    for c in range(len(capture.camera_ids)):
        read = capture.camera(c)
        for name in ("K", "R", "t", "distortion"):
            np.testing.assert_allclose(getattr(read, name), getattr(cameras[c], name), atol=1e-9)
        for f in range(N_FRAMES):
            image, mask = views[c, f]
            np.testing.assert_allclose(capture.image(c, f).astype(int), image, atol=0 if lossless else 6)
            np.testing.assert_array_equal(capture.silhouette(c, f), mask)
    for f, pose in enumerate(poses):
        np.testing.assert_allclose(smpl.pose(capture.body_pose(f)), smpl.pose(pose), atol=1e-9)
        np.testing.assert_allclose(capture.body_pose(f).betas, pose.betas, atol=1e-9)


def test_refine_round_trip(refine, scene, smpl):
    capture = ZjuRefine(refine.parent).open("377", smpl)
    assert (capture.variant, capture.dataset) == ("refine/smpl_params", "zju_mocap")
    assert capture.camera_ids == ("images/00", "images/01")
    check_same(capture, scene, smpl, lossless=False)
    np.testing.assert_allclose(capture.vertices(1), smpl.pose(scene[1][1]), atol=1e-6)


def test_refine_has_no_cihp_masks(refine, smpl):
    with pytest.raises(BadInput, match="no mask_cihp masks"):
        ZjuRefine(refine).open("377", smpl).silhouette(0, 0, "union")


def test_refine_paths_may_lack_the_folder_images(refine, scene, smpl):
    zju_mocap.write_annots(refine, scene[0], [[p.removeprefix("images/") for p in f] for f in PATHS])
    check_same(ZjuRefine(refine).open("377", smpl), scene, smpl, lossless=False)


@pytest.mark.parametrize("monocular", [True, False])
@pytest.mark.parametrize("with_betas", [True, False])
def test_humannerf_round_trip(tmp_path, scene, smpl, with_betas, monocular):
    write_nerf(tmp_path / "377", scene, smpl, with_betas, monocular)
    capture = HumanNerfFormat(tmp_path).open("377", smpl)
    assert capture.camera_ids == (("camera",) if monocular else ("01", "02"))
    assert capture.n_frames == N_FRAMES
    check_same(capture, scene, smpl, lossless=True)


def test_betas_follow_from_joints(smpl):
    betas = np.random.default_rng(1).normal(size=10)
    np.testing.assert_allclose(betas_of_joints(smpl.shaped(betas)[1], smpl), betas, atol=1e-9)


def test_the_dispatcher_finds_each_layout_and_refuses_others(refine, nerf, tmp_path, smpl):
    assert ZJU_MOCAP(refine.parent).open("377", smpl).variant == "refine/smpl_params"
    assert ZJU_MOCAP(nerf.parent).open("377", smpl).variant == "humannerf"
    assert ZJU_MOCAP(nerf).subjects() == ["377"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match="no layout of zju_mocap"):
        ZJU_MOCAP(tmp_path / "empty")
    with pytest.raises(BadInput, match="no such folder"):
        ZJU_MOCAP(tmp_path / "nowhere")
    assert ZJU_MOCAP.check(refine.parent).layout == "refine"
    assert ZJU_MOCAP.check(nerf.parent).layout == "humannerf"


def test_checks_are_clean_and_name_damage(refine, nerf):
    good = ZJU_MOCAP.check(refine.parent)
    assert good.ok, good
    assert good.subjects[0].vertices_in_mask > 0.95
    assert ZJU_MOCAP.check(nerf.parent).ok
    (nerf / "masks" / "camera_02_frame_000001.png").unlink()
    (refine / "smpl_params" / "1.npy").unlink()
    assert "1 of masks missing" in ZJU_MOCAP.check(nerf.parent).subjects[0].problems
    assert "1 of smpl_params missing" in ZJU_MOCAP.check(refine.parent).subjects[0].problems


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda c, m: c.update(spam=c["camera_01_frame_000000"]), "expected frame_000000"),
        (lambda c, m: c["camera_01_frame_000000"].pop("intrinsics"), "'intrinsics'"),
        (lambda c, m: c["camera_01_frame_000000"].update(extrinsics=np.eye(3)), r"\[4, 4\]"),
        (lambda c, m: m["camera_01_frame_000001"].update(Th=np.full(3, np.nan)), "NaN"),
        (lambda c, m: m["camera_01_frame_000001"].update(poses=np.ones(72)), "expected zeros"),
        (lambda c, m: [m.pop(k) for k in list(m) if k.endswith("1")], "no pose of frame 1"),
        (lambda c, m: c.clear(), "expected a dictionary with entries"),
    ],
)
def test_damaged_pickles_are_named(nerf, smpl, damage, words):
    cameras, infos = (pickle.loads((nerf / name).read_bytes()) for name in humannerf.FILES)
    damage(cameras, infos)
    for name, value in zip(humannerf.FILES, (cameras, infos), strict=True):
        humannerf.write_pickle(nerf / name, value)
    with pytest.raises(BadInput, match=words):  # noqa: PT012
        capture = HumanNerfFormat(nerf).open("377", smpl)
        capture.camera(0)
        capture.body_pose(1)
