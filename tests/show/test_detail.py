"""No finer than it was photographed: what is drawn larger is enlarged, without halos."""

import numpy as np
import pytest

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.show.detail import drawn, pixel_at

POSE = BodyPose(np.zeros((24, 3)), np.zeros(10), np.array([1.0, 2.0, 3.0]))


@pytest.fixture(scope="module")
def body():
    return load_body()


class Board:
    """Draws a dark half on the background, and remembers the sizes that it was asked for."""

    def __init__(self):
        self.sizes = []

    def render(self, camera, body_pose, background, frame):
        self.sizes.append((camera.width, camera.height))
        alpha = np.zeros((camera.height, camera.width), np.float32)
        alpha[:, camera.width // 2 :] = 1
        return np.where(alpha[..., None] > 0, np.float32(0.25), np.float32(background)), alpha


def camera_of(body, side, distance):
    pelvis = body.posed_joints(POSE)[0]
    R, t = look_at(pelvis + np.array([0, 0, distance]), pelvis)
    return Camera(np.array([[200.0, 0, side / 2], [0, 200, side / 2], [0, 0, 1]]), R, t, side, side)


def test_a_pixel_covers_what_it_covers(body):
    camera = camera_of(body, 100, 4.0)
    pelvis = body.posed_joints(POSE)[0]
    beside = pelvis + np.array([pixel_at(camera, POSE, body), 0, 0])
    apart = camera.project(beside) - camera.project(pelvis)
    assert np.linalg.norm(apart[:2]) == pytest.approx(1)


def test_finer_pixels_are_enlarged_ones_and_others_are_drawn_as_asked(body):
    camera, board = camera_of(body, 100, 4.0), Board()
    for pixel, size in ((None, 100), (0.01, 100), (0.02, 100), (0.04, 50), (0.08, 25)):
        rgb, alpha = drawn(board, camera, POSE, (0.5, 0.5, 0.5), None, body, pixel)
        assert board.sizes[-1] == (size, size)
        assert (rgb.shape, alpha.shape) == ((100, 100, 3), (100, 100))
        assert rgb.min() >= 0.25 - 1e-6
        assert rgb.max() <= 0.5 + 1e-6  # cubics alone would overshoot
        assert np.abs(rgb[:, :40] - 0.5).max() < 1e-6
        assert np.abs(rgb[:, 60:] - 0.25).max() < 1e-6
    linear = drawn(board, camera, POSE, (0.0, 0.0, 0.0), None, body, 0.08, sharp=False)
    np.testing.assert_allclose(linear[0], 0.25 * linear[1][..., None].repeat(3, 2), atol=1e-6)
