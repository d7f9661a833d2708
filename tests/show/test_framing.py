"""Cameras around a body: all of it in the picture, upright, from the side that was asked for, and once around."""

import numpy as np
import pytest

from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.show.framing import MARGIN, SIDES, WANDERS, Framing, orbit
from ihbench.show.motion import stand_of, up_axis

WORLDS = {  # rotation vector of an upright body's root
    "y up": (0.0, 0.4, 0.0),
    "z up": (np.pi / 2, 0.0, 0.0),
    "y down": (np.pi, 0.0, 0.0),
}


@pytest.fixture(scope="module")
def body():
    return load_body()


def framing_of(body, root, places=((0.0, 0.0, 0.0),)):
    pose = np.zeros((24, 3))
    pose[0] = root
    poses = [BodyPose(pose, np.zeros(10), np.array(place)) for place in places]
    pelvis = np.stack([body.posed_joints(p)[0] for p in poses])
    vertices = [body.pose(p) for p in poses]
    return Framing.of(vertices, list(range(len(poses))), pelvis, stand_of(body, poses[0], up_axis(poses))), vertices


@pytest.mark.parametrize("root", WORLDS.values(), ids=WORLDS)
@pytest.mark.parametrize("size", [(200, 200), (120, 300), (400, 150)])
def test_the_body_fills_the_picture_and_stays_in_it(body, root, size):
    framing, (vertices,) = framing_of(body, root, ((2.0, -1.0, 30.0),))
    filled = []
    for camera in orbit(framing, 8, *size):
        p = camera.project(vertices)
        assert (p[:, 2] > 0).all()
        reach = 2 * np.abs(p[:, :2] / size - 0.5)
        filled.append(reach.max())
        head, feet = p[vertices @ framing.stand.up > (vertices @ framing.stand.up).max() - 0.1], p
        assert head[:, 1].max() < feet[:, 1].mean()
    assert 0.9 / MARGIN < max(filled) <= 1.005 / MARGIN


def test_sides_are_the_bodys_own(body):
    framing, _ = framing_of(body, (0.0, 2.0, 0.0))
    left_hand = framing.stand.pelvis + 0.5 * framing.stand.axes[:, 0]
    x = {side: framing.camera(0, degrees, 100, 100).project(left_hand) for side, degrees in SIDES.items()}
    assert x["front"][0] > 55 > 45 > x["back"][0]  # who faces us has the left hand on our right
    assert x["left"][2] < x["right"][2]


@pytest.mark.parametrize("frames", [1, 7, 60])
def test_an_orbit_ends_where_it_began(body, frames):
    framing, _ = framing_of(body, (0.0, 0.3, 0.0))
    first, beyond = orbit(framing, frames, 64, 64)[0], framing.camera(frames, 360.0, 64, 64)
    np.testing.assert_allclose(beyond.R, first.R, atol=1e-12)
    np.testing.assert_allclose(beyond.t, first.t, atol=1e-12)


def test_the_camera_goes_with_who_walks_away_and_not_with_who_sways(body):
    walking, there = framing_of(body, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 0.3, 4.0)))
    np.testing.assert_allclose(np.diff(walking.centre, axis=0), [[0, 0, 2]] * 2, atol=1e-9)
    for k, vertices in enumerate(there):
        p = walking.camera(k, 90.0, 100, 100).project(vertices)[:, :2]
        assert p.min() > 0
        assert p.max() < 100
    swaying, _ = framing_of(body, (0.0, 0.0, 0.0), ((0.0, 0.0, 0.0), (0.9 * WANDERS, 0.0, 0.0)))
    assert not np.diff(swaying.centre, axis=0).any()
