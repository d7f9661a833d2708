import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ihbench.camera import Camera, look_at, off_orthogonal
from ihbench.errors import BadInput

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
        ({"distortion": np.zeros(4)}, "distortion.*from_opencv"),
        ({"t": np.zeros((3, 1))}, "t.*from_opencv"),
        ({"R": np.zeros(3)}, "R.*from_opencv"),
        ({"R": 2 * np.eye(3)}, "R Rᵀ = 1"),
        ({"R": np.diag([1.0, 1, -1])}, "reflection"),
        ({"K": np.diag([-1.0, 1, 1])}, "check the signs"),
        ({"K": np.array([[1, 0, 0], [0, 1, 0], [5, 4, 1.0]])}, "transposed"),
        ({"K": np.diag([1.0, 1, 2])}, "divide it by its last number"),
        ({"width": 4.5}, "whole numbers"),
        ({"width": [4, 4]}, "whole numbers"),
        ({"width": "4"}, "whole numbers"),
        ({"width": np.inf}, "whole numbers"),
        ({"height": True}, "whole numbers"),
        ({"K": "abc"}, "expected numbers"),
        ({"t": [None, 0, 0]}, "expected numbers"),
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


OPENCV = {"K": np.array([[70.0, 0, 30], [0, 72, 25], [0, 0, 1]]), "R": np.array([0.1, -0.2, 0.3])}
LENS = np.array([0.1, -0.02, 1e-3, 2e-3, 0.05])


@pytest.mark.parametrize("column", [np.ravel, lambda x: np.reshape(x, (-1, 1)), lambda x: np.reshape(x, (1, -1))])
@pytest.mark.parametrize("kind", [np.asarray, np.ndarray.tolist, torch.tensor, lambda x: x.astype(np.float32)])
@pytest.mark.parametrize("zeros", [0, 3, 7, 9])
def test_an_opencv_calibration_is_taken_as_opencv_writes_it(column, kind, zeros):
    matrix = Rotation.from_rotvec(OPENCV["R"]).as_matrix()
    plain = Camera(OPENCV["K"] + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]], matrix, np.array([1.0, 2, 3]), 60, 50, LENS)
    vector = column(OPENCV["R"])
    for R in (kind(vector), kind(matrix)):
        lens = kind(column(np.pad(LENS, (0, zeros))))
        camera = Camera.from_opencv(kind(OPENCV["K"]), R, kind(column(np.array([1.0, 2, 3]))), 60, 50, lens)
        for name in ("K", "R", "t", "distortion"):
            np.testing.assert_allclose(getattr(camera, name), getattr(plain, name), atol=1e-7)
        projected = cv2.projectPoints(np.array([[0.1, 0.2, 2.0]]), vector, camera.t, OPENCV["K"], LENS)[0]
        np.testing.assert_allclose(camera.project(np.array([0.1, 0.2, 2.0]))[:2] - 0.5, projected[0, 0], atol=1e-4)


def test_a_short_distortion_is_filled_and_zeros_are_none():
    def lens(values):
        return Camera.from_opencv(OPENCV["K"], np.eye(3), np.zeros(3), 60, 50, values).distortion

    np.testing.assert_array_equal(lens(LENS[:4]), [*LENS[:4], 0])
    for none in (None, [], np.zeros((1, 5)), np.zeros((14, 1))):
        assert lens(none) is None
    assert a_camera(np.zeros(5)).distortion is None


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"distortion": np.ones(8)}, "cv2.undistort"),
        ({"distortion": [0.1] * 6}, "fisheye"),
        ({"K": np.array([70.0, 72, 30, 25])}, "fx, 0, cx"),
        ({"K": np.eye(4)}, "upper left 3×3"),
        ({"t": np.zeros((3, 4))}, "its last column is t"),
        ({"t": np.zeros(2)}, "three numbers"),
        ({"R": np.eye(4)}, "its last column is t"),
        ({"R": np.full(3, np.nan)}, "NaN"),
    ],
)
def test_an_opencv_calibration_that_cannot_be_kept_is_refused(change, word):
    with pytest.raises(BadInput, match=word) as error:
        Camera.from_opencv(**{**OPENCV, "t": np.zeros(3), "width": 60, "height": 50, **change})
    assert isinstance(error.value, ValueError)
    assert "\n" not in str(error.value)


def test_a_matrix_whose_square_overflows_is_no_rotation():
    turned = np.stack([np.eye(3), np.full((3, 3), 1e300), -np.full((3, 3), 1e300)])
    assert (off_orthogonal(turned) < 1e-9).tolist() == [True, False, False]


@pytest.mark.parametrize("size", [4, 4.0, np.float32(4), np.array(4), np.array([4]), torch.tensor(4.0)])
def test_a_whole_size_is_taken_from_any_type_of_number(size):
    camera = Camera(np.eye(3), np.eye(3), np.zeros(3), size, size)
    assert (camera.width, camera.height) == (4, 4)
    assert type(camera.width) is int


def test_what_a_factorisation_leaves_off_zero_is_no_other_camera():
    exact = np.array([[900.0, 1, 300], [0, 910, 200], [0, 0, 1]])
    off = exact + 1e-13 * np.array([[0, 0, 0], [900, 0, 0], [1, -1, 1e-3]])
    np.testing.assert_array_equal(Camera(off, np.eye(3), np.zeros(3), 60, 50).K, exact)
