"""Outputs of pose estimators, projected both ways: by the estimator's own camera and by ours."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ihbench.body import load_body, zju_root
from ihbench.body.pose import BodyPose
from ihbench.body.pose_estimators import (
    from_camera_space,
    from_easymocap,
    from_smplx,
    from_weak_perspective,
    from_world,
    matrix_to_axis_angle,
    six_d_to_matrix,
)
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import look_at
from ihbench.errors import BadInput

WIDTH, HEIGHT = 1280, 720
K = np.array([[1000.0, 0, 640], [0, 1010, 360], [0, 0, 1]])
ZERO = np.zeros(3)


def off_centre_body():
    """A pelvis off the origin, as SMPL has it: else root conventions could not be told apart."""
    body = load_body()
    return replace(body, v_template=body.v_template + np.array([0.02, -0.25, 0.03]))


def camera_pose(seed=0):
    """An upright person in camera axes: y down, facing the camera."""
    pose = np.random.default_rng(seed).normal(0, 0.3, (24, 3))
    pose[0] = [np.pi - 0.1, 0.05, 0.08]
    return pose.reshape(72)


def message(error) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# ------------------------------------------------------------------------------------ weak perspective


def weak_projection(points, camera, box):
    """What an HMR model means by (s, tx, ty): [-1, 1]² of the crop, in pixels of the full image."""
    (s, tx, ty), (cx, cy, size) = camera, box
    x, y = s * (points[:, 0] + tx), s * (points[:, 1] + ty)
    return np.stack([cx + size / 2 * x, cy + size / 2 * y], -1)


@pytest.mark.parametrize("box", [(640, 360, 500), (900.5, 250.25, 333)])
@pytest.mark.parametrize("focal", [900.0, 5000.0])
def test_weak_perspective_and_ours_differ_by_perspective_alone(box, focal):
    body, pose, betas, weak = off_centre_body(), camera_pose(), np.array([0.5, -1.0]), (0.9, 0.03, 0.2)
    camera, body_pose = from_weak_perspective(pose, betas, weak, box, focal, WIDTH, HEIGHT)
    untranslated = body.pose(BodyPose(pose.reshape(24, 3), betas, ZERO))
    ours = camera.project(body.pose(body_pose))
    middle = np.array([WIDTH / 2, HEIGHT / 2])
    shrink = 1 + untranslated[:, 2:] / body_pose.transl[2]
    expected = middle + (weak_projection(untranslated, weak, box) - middle) / shrink
    np.testing.assert_allclose(ours[:, :2], expected, atol=1e-9)
    assert body_pose.transl[2] == pytest.approx(2 * focal / (0.9 * box[2]))


def test_weak_perspective_joints_stay_within_what_perspective_moves_them():
    body, pose, betas, weak, box = off_centre_body(), camera_pose(1), np.zeros(10), (0.9, 0.0, 0.1), (700, 380, 400)
    joints = body.posed_joints(BodyPose(pose.reshape(24, 3), betas, ZERO))
    in_crop = weak_projection(joints, weak, box)
    errors = []
    for focal in (1000, 10_000, 100_000):
        camera, body_pose = from_weak_perspective(pose, betas, weak, box, focal, WIDTH, HEIGHT)
        moved = np.linalg.norm(camera.project(body.posed_joints(body_pose))[:, :2] - in_crop, axis=1)
        off_axis = np.linalg.norm(in_crop - [WIDTH / 2, HEIGHT / 2], axis=1)
        depth = body_pose.transl[2]
        assert (moved <= 1.001 * off_axis * np.abs(joints[:, 2]) / (depth - np.abs(joints[:, 2])) + 1e-9).all()
        errors.append(moved.max())
    assert errors[0] > 1  # a body with depth near the camera: perspective shows
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.2)
    assert errors[2] == pytest.approx(errors[1] / 10, rel=0.05)


def test_weak_perspective_is_exact_for_a_flat_body():
    body = off_centre_body()
    flat = replace(
        body, v_template=body.v_template * [1, 1, 0], shapedirs=body.shapedirs * np.array([1, 1, 0])[:, None]
    )
    pose, weak, box = np.zeros(72), (0.8, -0.1, 0.3), (333.3, 444.4, 555.5)
    pose[0] = np.pi  # stays in its plane
    camera, body_pose = from_weak_perspective(pose, np.zeros(10), weak, box, 1200, WIDTH, HEIGHT)
    untranslated = flat.pose(BodyPose(pose.reshape(24, 3), np.zeros(10), ZERO))
    ours = camera.project(flat.pose(body_pose))[:, :2]
    np.testing.assert_allclose(ours, weak_projection(untranslated, weak, box), atol=1e-9)


def test_weak_perspective_camera_is_the_full_image_at_the_origin():
    camera, body_pose = from_weak_perspective(
        camera_pose()[None], np.zeros((1, 10)), (1, 0, 0), (640, 360, 400), 800, WIDTH, HEIGHT
    )
    np.testing.assert_array_equal(camera.K, [[800, 0, 640], [0, 800, 360], [0, 0, 1]])
    np.testing.assert_array_equal(camera.R, np.eye(3))
    np.testing.assert_array_equal(camera.t, ZERO)
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    np.testing.assert_array_equal(body_pose.transl, [0, 0, 4])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"pose": np.zeros(69)}, "72 numbers"),
        ({"pose": np.zeros((24, 3, 3))}, "matrix_to_axis_angle"),
        ({"pose": np.full(72, np.nan)}, "NaN"),
        ({"pose": "abc"}, "expected numbers"),
        ({"pose": {"a": 1}}, "expected numbers"),
        ({"betas": np.zeros((2, 10))}, "betas"),
        ({"betas": 1.0}, "betas"),
        ({"betas": [np.inf]}, "infinity"),
        ({"scale_translation": (1, 0)}, r"\(s, tx, ty\)"),
        ({"scale_translation": (-0.9, 0, 0)}, "above 0"),
        ({"box": (1, 2, 0)}, "above 0"),
        ({"box": (1, 2, 3, 4)}, "crop box"),
        ({"focal": np.nan}, "focal"),
        ({"focal": -5.0}, "above 0"),
        ({"width": 12.5}, "image size"),
        ({"height": 0}, "image size"),
    ],
)
def test_wrong_weak_perspective_outputs_are_bad_input(change, text):
    given = {
        **{"pose": np.zeros(72), "betas": np.zeros(10), "scale_translation": (1, 0, 0), "box": (5, 5, 5)},
        **{"focal": 100.0, "width": 64, "height": 48},
    }
    from_weak_perspective(**given)
    with pytest.raises(BadInput, match=text) as error:
        from_weak_perspective(**{**given, **change})
    message(error)


# ----------------------------------------------------------------------------------------- full images


def test_camera_space_projects_as_the_estimator_does():
    body, pose, betas, transl = off_centre_body(), camera_pose(2), np.ones(10), np.array([0.3, -0.2, 4.0])
    vertices = body.pose(BodyPose(pose.reshape(24, 3), betas, ZERO)) + transl
    theirs = vertices @ K.T
    theirs = theirs[:, :2] / theirs[:, 2:]
    camera, body_pose = from_camera_space(pose, betas, transl, K, WIDTH, HEIGHT)
    np.testing.assert_allclose(camera.project(body.pose(body_pose))[:, :2], theirs, atol=1e-9)
    camera, _ = from_camera_space(pose, betas, transl, K, WIDTH, HEIGHT, pixel_center=0.0)
    np.testing.assert_allclose(camera.project(body.pose(body_pose))[:, :2], theirs + 0.5, atol=1e-9)
    np.testing.assert_array_equal(camera.K_opencv, K)
    camera, _ = from_camera_space(pose, betas, transl, 700.0, WIDTH, HEIGHT)
    np.testing.assert_array_equal(camera.K, [[700, 0, 640], [0, 700, 360], [0, 0, 1]])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"transl": [0, 0, -3]}, "in front of the camera"),
        ({"transl": [0, 3]}, "transl"),
        ({"K": np.eye(4)}, "K: expected shape"),
        ({"K": np.diag([-1.0, 1, 1])}, "fx, fy > 0"),
        ({"K": K.T}, "fx, fy > 0"),
        ({"K": -2.0}, "fx, fy > 0"),
        ({"pixel_center": 1.0}, "pixel_center"),
    ],
)
def test_wrong_camera_space_outputs_are_bad_input(change, text):
    given = {"pose": np.zeros(72), "betas": np.zeros(10), "transl": [0, 0, 3], "K": K, "width": 64, "height": 48}
    from_camera_space(**given)
    with pytest.raises(BadInput, match=text) as error:
        from_camera_space(**{**given, **change})
    message(error)


# ------------------------------------------------------------------------------------------- the world


def world(up):
    """A standing person in a world with that axis up, and a camera in front of it."""
    up_vector = np.array([0, 1.0, 0]) if up == "y" else np.array([0, 0, 1.0])
    stand = ZERO if up == "y" else np.array([np.pi / 2, 0, 0])
    R, t = look_at(np.array([0.5, 0.3, 0.4]) + np.where(up_vector, 1.2, 3.0), ZERO, up_vector)
    pose = camera_pose(3).reshape(24, 3)
    pose[0] = stand
    return pose, R, t


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_world_is_kept_as_it_is(up):
    body, (pose, R, t), transl = off_centre_body(), world(up), np.array([0.1, 0.2, 0.3])
    camera, body_pose = from_world(pose, np.zeros(10), transl, R, t, K, WIDTH, HEIGHT, up=up)
    np.testing.assert_array_equal(camera.R, R)
    np.testing.assert_array_equal(camera.t, t)
    np.testing.assert_array_equal(body_pose.pose, pose)
    np.testing.assert_array_equal(body_pose.transl, transl)
    head, pelvis = camera.project(body.posed_joints(body_pose))[[15, 0]]
    assert head[1] < pelvis[1]  # upright in the picture


def test_another_up_axis_is_bad_input():
    for up, other in (("y", "z"), ("z", "y")):
        pose, R, t = world(up)
        with pytest.raises(BadInput, match=rf"\+{other} to point up.*\+{up}") as error:
            from_world(pose, np.zeros(10), ZERO, R, t, K, WIDTH, HEIGHT, up=other)
        message(error)
    pose, R, t = world("y")
    flip = np.diag([1.0, -1, -1])  # the world upside down
    pose[0] = matrix_to_axis_angle(flip @ axis_angle_to_matrix(pose[0]))
    with pytest.raises(BadInput, match="stand along -y"):
        from_world(pose, np.zeros(10), ZERO, R @ flip, t, K, WIDTH, HEIGHT)


def test_a_lying_person_and_a_camera_that_looks_down_are_fine():
    pose, R, t = world("y")
    lying = pose.copy()
    lying[0] = [np.pi / 2, 0, 0]
    from_world(lying, np.zeros(10), ZERO, R, t, K, WIDTH, HEIGHT)
    R, t = look_at([0, 4, 0], ZERO, (0, 0, 1))
    from_world(pose, np.zeros(10), ZERO, R, t, K, WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"up": "x"}, "expected y or z"),
        ({"R_w2c": np.diag([1.0, 1, -1])}, "expected rotations"),
        ({"R_w2c": 2 * np.eye(3)}, "expected rotations"),
        ({"R_w2c": np.eye(4)}, "shape"),
        ({"t_w2c": [0, 0, np.nan]}, "NaN"),
        ({"transl": np.zeros((2, 3))}, "transl.*one row a call"),
    ],
)
def test_wrong_worlds_are_bad_input(change, text):
    given = {"pose": np.zeros(72), "betas": np.zeros(10), "transl": ZERO, "R_w2c": np.eye(3), "t_w2c": ZERO}
    given |= {"K": K, "width": 64, "height": 48}
    from_world(**given)
    with pytest.raises(BadInput, match=text) as error:
        from_world(**{**given, **change})
    message(error)


# ------------------------------------------------------------------------------------------- EasyMocap


def test_easymocap_puts_every_vertex_where_it_does():
    body = off_centre_body()
    truth = BodyPose(camera_pose(4).reshape(24, 3), np.linspace(-1, 1, 10), np.array([0.4, 1.0, 2.0]))
    Rh, Th = zju_root(truth, body)
    no_root = truth.pose.copy()
    no_root[0] = 0
    at_rest = body.pose(BodyPose(no_root, truth.betas, ZERO))
    theirs = at_rest @ Rotation.from_rotvec(Rh).as_matrix().T + Th
    for poses in (no_root.reshape(1, 72), no_root[1:].reshape(69), no_root):
        given = from_easymocap(poses, truth.betas[None], Rh[None], Th[None], body)
        np.testing.assert_allclose(body.pose(given), theirs, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"poses": np.zeros(87)}, "SMPL-X"),
        ({"poses": np.zeros((2, 72))}, "2 frames or persons"),
        ({"poses": np.zeros(66)}, "72 numbers"),
        ({"poses": np.ones(72)}, "Rh holds the root"),
        ({"poses": np.full(72, np.inf)}, "infinity"),
        ({"Rh": np.zeros(4)}, "Rh"),
        ({"Th": [0, 0, np.nan]}, "Th"),
        ({"shapes": np.zeros((3, 10))}, "betas"),
    ],
)
def test_wrong_easymocap_outputs_are_bad_input(change, text):
    given = {"poses": np.zeros(72), "shapes": np.zeros(10), "Rh": ZERO, "Th": ZERO}
    with pytest.raises(BadInput, match=text) as error:
        from_easymocap(**{**given, **change}, body=load_body())
    message(error)


# ------------------------------------------------------------------------------------------- rotations


@pytest.mark.parametrize("angle", [0, 1e-300, 1e-12, 1e-8, 1e-4, 1, 2, 3, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12])
def test_matrices_come_back_as_axis_angle(angle):
    axes = np.concatenate([np.random.default_rng(5).normal(size=(200, 3)), np.eye(3), -np.eye(3)])
    rotation = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    back = matrix_to_axis_angle(axis_angle_to_matrix(rotation))
    np.testing.assert_allclose(back, rotation, atol=3e-15, rtol=1e-12)


def test_half_turns_come_back_as_one_of_two():
    axes = np.concatenate([np.random.default_rng(6).normal(size=(50, 3)), np.eye(3), -np.eye(3)])
    rotation = np.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    matrices = axis_angle_to_matrix(rotation)
    back = matrix_to_axis_angle(matrices)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), np.pi, atol=1e-12)
    np.testing.assert_allclose(axis_angle_to_matrix(back), matrices, atol=1e-14)
    exact = matrix_to_axis_angle(np.diag([1.0, -1, -1]))
    np.testing.assert_allclose(np.abs(exact), [np.pi, 0, 0], atol=0)


def test_shapes_and_rounding():
    rotation = np.random.default_rng(7).uniform(-1, 1, (2, 24, 3))
    matrices = axis_angle_to_matrix(rotation)
    np.testing.assert_allclose(matrix_to_axis_angle(matrices), rotation, atol=1e-14)
    np.testing.assert_allclose(matrix_to_axis_angle(matrices.astype(np.float32)), rotation, atol=1e-6)
    np.testing.assert_allclose(matrix_to_axis_angle(matrices.astype(np.float16)), rotation, atol=2e-3)
    assert matrix_to_axis_angle(np.eye(3)).shape == (3,)
    assert matrix_to_axis_angle(np.zeros((0, 3, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("matrix", "text"),
    [
        (np.diag([1.0, 1, -1]), "expected rotations"),
        (np.ones((3, 3)), "expected rotations"),
        (1.1 * np.eye(3), "expected rotations"),
        (np.eye(4), "shape"),
        (np.zeros(9), "shape"),
        (np.full((3, 3), np.nan), "NaN"),
    ],
)
def test_other_matrices_are_bad_input(matrix, text):
    with pytest.raises(BadInput, match=text) as error:
        matrix_to_axis_angle(matrix)
    message(error)


SIX_D = {
    "columns": lambda R: np.concatenate([R[..., 0], R[..., 1]], -1),
    "interleaved": lambda R: R[..., :2].reshape(*R.shape[:-2], 6),
    "rows": lambda R: np.concatenate([R[..., 0, :], R[..., 1, :]], -1),
}


@pytest.mark.parametrize("layout", SIX_D)
def test_six_numbers_are_a_rotation(layout):
    rotation = np.random.default_rng(8).uniform(-1, 1, (24, 3))
    R = axis_angle_to_matrix(rotation)
    given = SIX_D[layout](R)
    np.testing.assert_allclose(six_d_to_matrix(given, layout), R, atol=1e-14)
    np.testing.assert_allclose(six_d_to_matrix(3 * given, layout), R, atol=1e-14)
    np.testing.assert_allclose(matrix_to_axis_angle(six_d_to_matrix(given, layout)), rotation, atol=1e-14)
    for other in set(SIX_D) - {layout}:
        assert np.abs(six_d_to_matrix(given, other) - R).max() > 0.1
    noisy = given + np.random.default_rng(9).normal(0, 0.05, given.shape)
    closest = six_d_to_matrix(noisy, layout)
    np.testing.assert_allclose(closest @ closest.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(closest), 1, atol=1e-12)
    assert np.abs(closest - R).max() < 0.4


def test_wrong_six_numbers_are_bad_input():
    for values, layout, text in (
        (np.zeros((24, 6)), "rows", "independent"),
        (np.ones(6), "rows", "independent"),
        (np.ones(5), "rows", "shape"),
        (np.eye(6), "rot6d", "layout"),
        (np.full(6, np.nan), "columns", "NaN"),
    ):
        with pytest.raises(BadInput, match=text) as error:
            six_d_to_matrix(values, layout)
        message(error)


# ---------------------------------------------------------------- what estimators write, shape by shape


def test_batches_columns_tensors_and_rotation_matrices_are_taken():
    pose, transl = camera_pose(4).reshape(24, 3), np.array([0.1, 0.2, 3.0])
    plain = from_camera_space(pose, np.linspace(-1, 1, 10), transl, K, WIDTH, HEIGHT)
    tensor = torch.tensor(pose, dtype=torch.float64, requires_grad=True)
    for given in (pose[None], pose.reshape(1, 72), pose.reshape(72, 1), pose.tolist(), tensor, tensor[None]):
        camera, body_pose = from_camera_space(
            given, torch.linspace(-1, 1, 10, dtype=torch.float64)[None], transl[:, None], K[None], WIDTH, HEIGHT
        )
        np.testing.assert_array_equal(body_pose.pose, plain[1].pose)
        np.testing.assert_array_equal(body_pose.transl, plain[1].transl)
        np.testing.assert_allclose(body_pose.betas, plain[1].betas)
        np.testing.assert_array_equal(camera.K, plain[0].K)
    four = from_camera_space(pose, np.zeros(10), transl, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], WIDTH, HEIGHT)
    np.testing.assert_array_equal(four[0].K, plain[0].K)  # SLAHMR
    matrices = axis_angle_to_matrix(pose)  # 4D-Humans: global_orient [1, 1, 3, 3], body_pose [1, 23, 3, 3]
    both = torch.cat([torch.tensor(matrices[None, :1]), torch.tensor(matrices[None, 1:])], 1).float()
    turned = from_weak_perspective(
        both, np.zeros((1, 10)), [[0.9, 0, 0]], [[320.0, 240, 200]], [900.0], WIDTH, HEIGHT
    )
    np.testing.assert_allclose(axis_angle_to_matrix(turned[1].pose), matrices, atol=1e-6)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.zeros(63), "SMPL-X without the root"),
        (np.zeros(162), "SMPL-X without the root"),
        (np.zeros(66), "GVHMR.*from_smplx"),
        (np.zeros((22, 3)), "GVHMR.*from_smplx"),
        (np.zeros((1, 1, 66)), "from_smplx"),
        (np.zeros(69), "without the root"),
        (np.zeros((23, 3)), "without the root"),
        (np.zeros(156), "SMPL-H.*from_smplx"),
        (np.zeros((52, 3)), "SMPL-H.*from_smplx"),
        (np.zeros(165), "SMPL-X.*from_smplx"),
        (np.zeros((55, 3)), "SMPL-X.*from_smplx"),
        (np.zeros((5, 72)), "5 frames or persons"),
        (np.zeros((2, 24, 3)), "2 frames or persons"),
        (np.zeros((23, 3, 3)), "matrix_to_axis_angle"),
        (np.zeros((24, 6)), "six_d_to_matrix"),
        (np.zeros((24, 4)), "quaternions"),
        (np.zeros(216), "24 rotation matrices"),
        (np.full((24, 3), 90.0), "np.deg2rad"),
    ],
)
def test_a_pose_of_another_body_or_kind_says_what_it_is(pose, words):
    for given in (pose, torch.tensor(pose)):
        with pytest.raises(BadInput, match=words):
            from_camera_space(given, np.zeros(10), [0, 0, 3], K, WIDTH, HEIGHT)


@pytest.mark.parametrize("size", [66, 78, 87, 156, 159, 165])
def test_the_joints_that_smplx_shares_are_taken_and_the_pelvis_stays(size):
    body, pose = off_centre_body(), 0.1 * np.random.default_rng(size).normal(size=size)
    pelvis, transl = np.array([0.0, -0.4, 0.1]), np.array([1.0, 2, 3])
    taken = from_smplx(pose[None], transl, body, pelvis=pelvis)
    np.testing.assert_array_equal(taken.pose[:22].ravel(), pose[:66])
    assert not taken.pose[22:].any()
    turned = from_smplx(axis_angle_to_matrix(pose.reshape(-1, 3))[None], transl, body, pelvis=pelvis)
    np.testing.assert_allclose(turned.pose, taken.pose, atol=1e-12)
    np.testing.assert_allclose(body.posed_joints(taken)[0], pelvis + transl, atol=1e-12)
    for wrong in (np.zeros(72), np.zeros(63), np.zeros((3, 66))):
        with pytest.raises(BadInput, match="SMPL-X pose: expected 66"):
            from_smplx(wrong, transl, body)
