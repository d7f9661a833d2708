import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench.camera import Camera, look_at

DISTORTION = np.array([-0.12, 0.06, 1e-3, -8e-4, 0.01])


def a_camera(distortion=None, width=64, height=48):
    R, t = look_at(np.array([0.4, 0.3, -2.5]), np.zeros(3))
    return Camera(np.array([[70.0, 0, 30], [0, 72, 25], [0, 0, 1]]), R, t, width, height, distortion)


def test_projection_agrees_with_opencv_including_its_half_pixel():
    import cv2

    points = np.random.default_rng(0).normal(0, 0.4, (50, 3))
    K = np.array([[70.0, 0, 30], [0, 72, 25], [0, 0, 1]])
    base = a_camera()
    camera = Camera.from_opencv(K, base.R, base.t, 64, 48, DISTORTION)
    theirs, _ = cv2.projectPoints(points, cv2.Rodrigues(base.R)[0], base.t, K, DISTORTION)
    np.testing.assert_allclose(camera.project(points)[:, :2], theirs[:, 0] + 0.5, atol=1e-9)
    np.testing.assert_allclose(camera.K_opencv, K)


def test_scaling_moves_every_pixel_with_the_image():
    camera = a_camera(DISTORTION)
    points = np.random.default_rng(1).normal(0, 0.4, (20, 3))
    half = camera.scaled(32, 24)
    np.testing.assert_allclose(half.project(points)[:, :2] * 2, camera.project(points)[:, :2], atol=1e-9)


def test_cropping_shifts_by_whole_pixels():
    camera = a_camera()
    point = np.array([0.1, 0.2, 0.0])
    shift = camera.project(point)[:2] - camera.cropped(7, 5, 20, 20).project(point)[:2]
    np.testing.assert_allclose(shift, [7, 5], atol=1e-12)


def test_center_is_where_the_camera_stands():
    np.testing.assert_allclose(a_camera().center, [0.4, 0.3, -2.5], atol=1e-12)


def test_look_at_is_a_rotation_with_up_in_the_upper_image_half():
    camera = a_camera()
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(camera.R) == pytest.approx(1)
    assert camera.project(np.array([0, 0.3, 0.0]))[1] < camera.project(np.zeros(3))[1]
    assert Rotation.from_matrix(camera.R).magnitude() <= np.pi


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"K": np.eye(2)}, "K"),
        ({"t": np.array([0, np.nan, 0])}, "t"),
        ({"width": 0}, "size"),
        ({"distortion": np.zeros(4)}, "distortion"),
    ],
)
def test_wrong_shapes_and_values_are_refused_by_name(change, word):
    good = {"K": np.eye(3), "R": np.eye(3), "t": np.zeros(3), "width": 4, "height": 4}
    with pytest.raises(ValueError, match=word):
        Camera(**{**good, **change})


@pytest.mark.parametrize(
    ("eye", "target"), [((0, 3, 0), (0, 0, 0)), ((1, 2, 3), (1, 2, 3)), ((0, -1e9, 0), (0, 0, 0))]
)
def test_a_view_along_its_own_up_is_refused_and_not_nan(eye, target):
    with pytest.raises(ValueError, match="look_at: expected a view direction that is not along up"):
        look_at(np.array(eye, float), np.array(target, float))
    R, _ = look_at(np.array([1e-6, 3.0, 0.0]), np.zeros(3))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
