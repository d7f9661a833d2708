"""The stand-in capture: determinism, what is written, and that it has the traps of the real data."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from ihbench.body import JOINT_INDEX, load_body
from ihbench.camera import Camera
from ihbench.datasets.standin import motion, outfit
from ihbench.datasets.standin.lighting import studio_lighting
from ihbench.datasets.standin.noise import fractal_noise, value_noise
from ihbench.datasets.standin.photograph import photograph
from ihbench.datasets.standin.rig import camera_ring
from ihbench.datasets.standin.studio import empty_studio
from ihbench.datasets.standin.subject import Subject
from ihbench.datasets.standin.zju_capture import ZjuStandIn
from ihbench.datasets.zju_mocap.original import ZjuMocap
from ihbench.errors import BadInput
from ihbench.render.zbuffer import rasterize, vertex_normals

SUBJECT = "standin-1"
WANTED = {0: [0, 200, 395], 7: [0, 480], 15: [200]}
PAIRS = [(camera, frame) for camera, frames in WANTED.items() for frame in frames]
CAST = range(1, 7)


@pytest.fixture(scope="module", autouse=True)
def no_waiting_for_the_disk():
    """Thousands of small files: what reaches the disk at a power cut is not under test here."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return ZjuStandIn.ensure(tmp_path_factory.mktemp("standin") / "data", 0, [SUBJECT], WANTED)


@pytest.fixture(scope="module")
def capture(root):
    return ZjuMocap(root).open(SUBJECT)


@pytest.fixture(scope="module")
def cast(body):
    return [Subject(0, number, body) for number in CAST]


def files_below(root):
    files = (path for path in root.rglob("*") if path.is_file() and not path.name.endswith(".lock"))
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in files}


# ------------------------------------------------------------------------------------------- the files


def test_in_steps_or_at_once_gives_the_same_bytes(root, tmp_path):
    """Twice from scratch, one of them in two steps of other orders: every file equal byte for byte."""
    steps = tmp_path / "steps"
    ZjuStandIn.ensure(steps, 0, [SUBJECT], {15: [200], 0: [395]})
    ZjuStandIn.ensure(steps, 0, [SUBJECT], {0: iter([200, 0]), 7: [480, 0]})
    assert files_below(steps) == files_below(root)


def test_nothing_is_written_twice(root):
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    ZjuStandIn.ensure(root, 0, [SUBJECT], WANTED)
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


def test_interrupted_and_lost_files_are_made_again(root, monkeypatch):
    before = files_below(root)
    lost = [f"CoreView_{SUBJECT}/{name}" for name in ("mask/Camera_B8/000480.png", "Camera_B1/000200.jpg")]
    for name in lost:
        (root / name).unlink()

    def killed(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Subject, "photograph", killed)
        with pytest.raises(KeyboardInterrupt):
            ZjuStandIn.ensure(root, 0, [SUBJECT], WANTED)
    assert set(files_below(root)) == set(before) - set(lost)
    ZjuStandIn.ensure(root, 0, [SUBJECT], WANTED)
    assert files_below(root) == before


def test_another_seed_is_another_person(root, body):
    mine, other = Subject(0, 1, body), Subject(1, 1, body)
    assert not np.allclose(mine.betas, other.betas)
    assert mine.style != other.style
    assert not np.allclose(mine.body_poses[100].pose, other.body_poses[100].pose, atol=0.1)
    assert not np.allclose(mine.cameras[0].K, other.cameras[0].K)


def test_only_the_real_layout_and_the_mark_are_there(root, body):
    folder = f"CoreView_{SUBJECT}"
    expected = {"STANDIN.json", f"{folder}/annots.npy"}
    expected |= {f"{folder}/new_params/{frame}.npy" for frame in range(ZjuStandIn.n_frames)}
    expected |= {f"{folder}/new_vertices/{frame}.npy" for _, frame in PAIRS}
    for camera, frame in PAIRS:
        picture = f"Camera_B{camera + 1}/{frame:06d}"
        expected |= {f"{folder}/{picture}.jpg", f"{folder}/mask/{picture}.png", f"{folder}/mask_cihp/{picture}.png"}
    assert set(files_below(root)) == expected
    assert json.loads((root / "STANDIN.json").read_text()) == {
        "generator": "ihbench",
        "version": 2,
        "seed": 0,
        "body": "procedural",
        "body_sha": body.content_sha(),
    }


def test_negative_seed(tmp_path):
    with pytest.raises(BadInput, match="seed -1: expected 0 or more"):
        ZjuStandIn.ensure(tmp_path, -1, [SUBJECT], {})


def test_folder_of_something_else_is_left_alone(root, tmp_path):
    with pytest.raises(BadInput, match=r"another stand-in .*seed 0, asked for 5"):
        ZjuStandIn.ensure(root, 5, [SUBJECT], {})
    (tmp_path / "CoreView_377").mkdir()
    with pytest.raises(BadInput, match="not an empty folder and not a stand-in"):
        ZjuStandIn.ensure(tmp_path, 0, [SUBJECT], {})
    assert [path.name for path in tmp_path.iterdir()] == ["CoreView_377"]


@pytest.mark.parametrize(
    ("subject", "wanted", "expected"),
    [
        ("377", {}, "expected standin-1"),
        ("standin-0", {}, "expected standin-1"),
        ("standin-1/..", {}, "expected standin-1"),
        (SUBJECT, {23: [0]}, "camera 23: expected 0 to 22"),
        (SUBJECT, {0: [810]}, "frame 810: expected 0 to 809"),
    ],
)
def test_impossible_wishes(tmp_path, subject, wanted, expected):
    with pytest.raises(BadInput, match=expected):
        ZjuStandIn.ensure(tmp_path / "new", 0, [subject], wanted)
    assert not (tmp_path / "new").exists()


# ----------------------------------------------------------------------------- through the real loader


def test_loader_says_it_is_a_stand_in(capture):
    assert (capture.standin, capture.body, capture.name) == ("stand-in v2 seed 0", "procedural", SUBJECT)
    assert (capture.n_frames, len(capture.camera_ids)) == (810, 23)
    assert capture.camera_ids == ZjuStandIn.camera_ids(SUBJECT)


def test_image_that_nobody_asked_for_says_so(capture):
    with pytest.raises(BadInput, match="a stand-in holds only the images it was asked for"):
        capture.image(0, 5)
    with pytest.raises(BadInput, match="a stand-in holds only the images it was asked for"):
        capture.camera(3)


@pytest.mark.parametrize("frame", [0, 200, 395, 480])
def test_parameters_give_the_stored_vertices(capture, body, frame):
    np.testing.assert_allclose(body.pose(capture.body_pose(frame)), capture.vertices(frame), atol=1e-5)


def test_every_frame_has_parameters(capture, body):
    subject = Subject(0, 1, body)
    for frame in (1, 333, 569):
        read = capture.body_pose(frame)
        np.testing.assert_allclose(read.pose, subject.body_poses[frame].pose, atol=1e-9)
        np.testing.assert_allclose(read.transl, subject.body_poses[frame].transl, atol=1e-9)


@pytest.mark.parametrize(("camera", "frame"), PAIRS)
def test_body_projects_into_the_mask(capture, camera, frame):
    mask = binary_dilation(capture.silhouette(camera, frame), iterations=2)
    points = capture.camera(camera).project(capture.vertices(frame))
    column, row = np.floor(points[:, :2]).astype(int).T
    assert mask[row, column].mean() >= 0.99


def test_distortion_pixel_centres_and_units_matter(capture):
    camera = capture.camera(0)
    assert 2.8 < np.linalg.norm(camera.center) < 3.6
    points = capture.vertices(200)
    shift = np.linalg.norm(camera.project(points)[:, :2] - camera.undistorted().project(points)[:, :2], axis=1)
    assert shift.max() > 5
    assert camera.K[0, 0] != camera.K[1, 1]
    assert np.abs(camera.K[:2, 2] - 512).max() > 2


@pytest.mark.parametrize(("camera", "frame"), PAIRS)
def test_truth_is_not_the_body_mesh(capture, body, camera, frame):
    mask = capture.silhouette(camera, frame)
    view = capture.camera(camera)
    mesh = rasterize(view.project(capture.vertices(frame)), body.faces, view.height, view.width).mask
    iou = (mask & mesh).sum() / (mask | mesh).sum()
    assert 0.8 < iou < 0.98


def test_mask_lines_up_with_the_truth_to_a_fraction_of_a_pixel(capture, body):
    """The clothed mesh drawn with the written camera: half a pixel of shift costs more than this leaves."""
    subject = Subject(0, 1, body)
    mask, view = capture.silhouette(0, 200), capture.camera(0)

    def iou(shift):
        points = view.project(subject.clothed_vertices(200)) + np.array([shift, 0, 0])
        truth = rasterize(points, body.faces, view.height, view.width).mask
        return (mask & truth).sum() / (mask | truth).sum()

    assert iou(0) > 0.985
    assert iou(0) > max(iou(0.5), iou(-0.5))


def test_the_person_is_in_the_picture_where_the_mask_says(capture, body):
    """Background pixels equal the empty studio up to JPEG, person pixels do not."""
    subject = Subject(0, 1, body)
    mask = capture.silhouette(7, 480)
    studio = empty_studio(subject.cameras[7], subject.studio_seed)
    difference = np.abs(capture.image(7, 480).astype(int) - studio).max(2)
    assert difference[~binary_dilation(mask, iterations=12)].max() < 40
    assert np.median(difference[mask]) > 25
    assert 0.02 < mask.mean() < 0.25


def test_part_labels(capture):
    labels = np.asarray(Image.open(capture.mask_path(7, 480, "mask_cihp")))
    np.testing.assert_array_equal(labels > 0, capture.silhouette(7, 480))
    assert set(np.unique(labels)) - {0} <= {int(part) for part in outfit.Part}
    assert {outfit.Part.HAIR, outfit.Part.UPPER_CLOTHES, outfit.Part.TROUSERS} <= set(np.unique(labels))
    rows = {part: np.flatnonzero((labels == part).any(1)).mean() for part in np.unique(labels)}
    assert rows[outfit.Part.HAIR] < rows[outfit.Part.UPPER_CLOTHES] < rows[outfit.Part.TROUSERS]


def test_data_check_finds_nothing_wrong(root):
    found = ZjuMocap.check(root)
    assert found.ok
    assert found.standin == "stand-in v2 seed 0"
    assert found.subjects[0].vertices_in_mask > 0.99
    assert found.subjects[0].files["image"] == len(PAIRS)


# -------------------------------------------------------------------------------------------- the cast


def test_the_six_differ_in_body_clothes_and_motion(cast, body):
    looks = [outfit.bake(body, subject.style, 64)[0] for subject in cast]
    heights = [np.ptp(subject.body.shaped(subject.betas)[0][:, 1]) for subject in cast]
    assert 1.45 < min(heights) < max(heights) < 2.05
    for i in range(6):
        for j in range(i):
            assert np.abs(cast[i].betas - cast[j].betas).max() > 0.5
            assert np.abs(looks[i] - looks[j]).mean() > 0.05
            assert cast[i].performance.exercises != cast[j].performance.exercises
            assert np.abs(cast[i].performance.pose - cast[j].performance.pose).max() > 0.5


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_half_turn_all_the_way_round_and_half_do_not(seed, body):
    turned = []
    for number in CAST:
        subject = Subject(seed, number, body)
        root = Rotation.from_rotvec([np.array(pose.pose[0]) for pose in subject.body_poses[: motion.N_FRAMES]])
        forward = root.apply([0, 0, 1])
        yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
        assert np.abs(np.diff(yaw)).max() < np.deg2rad(6)
        turned.append(np.rad2deg(np.ptp(yaw)))
    full = [turn >= 360 for turn in turned]
    assert sum(full) == 3
    assert all(turn < 740 if whole else 50 < turn < 230 for turn, whole in zip(turned, full, strict=True))


def test_up_is_z_and_the_feet_are_on_the_floor(cast):
    for subject in cast:
        for frame in (0, 150, 300, 569, 640, 809):
            vertices = subject.vertices(frame)
            assert abs(vertices[:, 2].min()) < 0.02
            assert subject.clothed_vertices(frame)[:, 2].min() > -0.03
            head = vertices[subject.body.weights[:, JOINT_INDEX["head"]] > 0.9]
            assert head[:, 2].min() > 0.6


def test_motion_is_smooth_and_nobody_leaves(cast):
    for subject in cast:
        transl = np.stack([pose.transl for pose in subject.body_poses])
        step = np.linalg.norm(np.diff(transl, axis=0), axis=1)
        step[motion.N_FRAMES - 1] = 0  # a cut: the novel movements are another take
        assert step.max() < 0.06  # m a frame
        assert np.linalg.norm(transl[:, :2], axis=1).max() < 0.5
        assert np.ptp(transl[:, 0]) > 0.05
        for show in (subject.performance, subject.novel_performance):
            turn = Rotation.from_rotvec(np.diff(show.pose, axis=0).reshape(-1, 3)).magnitude()
            assert turn.max() < np.deg2rad(15)
        assert not set(subject.novel_performance.exercises) & set(subject.performance.exercises)


def test_everybody_is_whole_in_every_camera(cast):
    for subject in cast:
        for frame in range(0, ZjuStandIn.n_frames, 95):
            vertices = subject.clothed_vertices(frame)
            for camera in subject.cameras:
                points = camera.project(vertices)
                assert points[:, :2].min() > 4
                assert points[:, :2].max() < camera.width - 4
                assert points[:, 2].min() > 1.5


def test_planted_foot_stays_put(body):
    """Standing and waving: the soles move less than the drift, and far less than a swinging hand."""
    rng = np.random.default_rng(0)
    performance = motion.perform(rng, ("squat",), full_turn=False)
    still = motion.Performance(performance.pose, 0 * performance.yaw, 0 * performance.place, performance.exercises)
    poses = motion.body_poses(still, np.zeros(10), body)
    sole = body.v_template[:, 1] < body.v_template[:, 1].min() + 0.01
    path = np.stack([body.pose(pose)[sole].mean(0) for pose in poses[200:260:2]])
    hips = np.stack([pose.transl for pose in poses[200:260:2]])
    assert np.ptp(path[:, :2], axis=0).max() < 0.05
    assert np.ptp(hips[:, 2]) > 0.2


# -------------------------------------------------------------------------------- light, lenses, noise


def test_lenses_are_strong_unequal_and_one_to_one():
    for seed in range(3):
        cameras = camera_ring(np.random.default_rng(seed))
        assert len(cameras) == 23
        for camera in cameras:
            assert camera.distortion is not None
            k1, k2, _, _, k3 = camera.distortion
            assert 0.05 <= abs(k1) <= 0.2
            r = np.linspace(0, 0.86, 200)  # past the image's corner
            assert (np.diff(r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)) > 0).all()


def test_photograph_shades_as_the_lighting_says(body):
    """A one-coloured body: every pixel well inside equals colour times `Lighting.shade` of its normal."""
    lighting = studio_lighting(np.random.default_rng(3))
    pose = motion.BodyPose(np.zeros((24, 3)), np.zeros(10), np.array([0, 0.3, 3.0]))
    upside = Camera(
        np.array([[300, 0, 128], [0, 300, 128], [0, 0, 1.0]]), np.diag([1.0, -1, -1]), np.array([0, 0, 6.0]), 256, 256
    )
    vertices = body.pose(pose)
    albedo = 0.5
    texture = np.full((64, 64, 3), albedo, np.float32)
    shot = photograph(
        vertices,
        body,
        texture,
        np.full((64, 64), 5, np.uint8),
        lighting,
        upside,
        np.full((256, 256, 3), 255, np.uint8),
    )
    big = upside.scaled(512, 512)
    raster = rasterize(big.project(vertices), body.faces, 512, 512)
    normals = raster.interpolate(vertex_normals(vertices, body.faces), body.faces).astype(np.float64)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True) + 1e-12
    colour = np.where(raster.mask[..., None], albedo * lighting.shade(normals), 1.0)
    expected = colour.reshape(256, 2, 256, 2, 3).mean((1, 3)) * 255
    assert np.abs(shot.image - expected).max() <= 1
    coverage = raster.mask.reshape(256, 2, 256, 2).mean((1, 3))
    np.testing.assert_array_equal(shot.mask, coverage >= 0.5)


def test_texture_lookup_is_upright(body):
    """A texture that paints v on the body shows v: row 0 is v = 1."""
    size = 256
    v = 1 - (np.arange(size) + 0.5) / size
    texture = np.repeat(np.repeat(v[:, None, None], size, 1), 3, 2).astype(np.float32)
    lighting = studio_lighting(np.random.default_rng(0))
    plain = type(lighting)(np.ones(3), lighting.towards, 0 * lighting.colours)
    view = Camera(
        np.array([[300, 0, 128], [0, 300, 128], [0, 0, 1.0]]), np.diag([1.0, -1, -1]), np.array([0, 0, 3.0]), 256, 256
    )
    vertices = body.v_template
    shot = photograph(
        vertices, body, texture, np.full((size, size), 5, np.uint8), plain, view, np.zeros((256, 256, 3), np.uint8)
    )
    raster = rasterize(view.project(vertices), body.faces, 256, 256)
    row, column = np.nonzero(raster.mask)
    uv = np.einsum("nk,nkc->nc", raster.bary[row, column], body.uv[body.uv_faces[raster.face[row, column]]])
    shown = shot.image[row, column, 0] / 255
    assert np.median(np.abs(shown - uv[:, 1])) < 0.01


def test_noise_is_smooth_bounded_and_seeded():
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (4000, 3))
    noise = value_noise(points, 7, 10.0)
    assert noise.min() >= 0
    assert noise.max() <= 1
    assert 0.45 < noise.mean() < 0.55
    assert noise.std() > 0.1
    nearby = value_noise(points + 1e-5, 7, 10.0)
    assert np.abs(noise - nearby).max() < 1e-3
    assert np.abs(noise - value_noise(points, 8, 10.0)).mean() > 0.1
    lattice = np.array([[0.1, -0.2, 0.3]])
    assert value_noise(lattice, 7, 10.0) == value_noise(lattice + 1e-12, 7, 10.0)
    fractal = fractal_noise(points, 7, 10.0)
    assert fractal.min() >= 0
    assert fractal.max() <= 1


def test_the_compiled_noise_is_found_again_by_the_next_process(tmp_path):
    code = (
        "import numpy as np; from ihbench.datasets.standin.noise import value_noise as v; v(np.zeros((1, 3)), 0, 1.0)"
    )
    for _ in range(2):
        subprocess.run([sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}, check=True)
    assert len(list(tmp_path.rglob("noise*.nbc"))) == 1
