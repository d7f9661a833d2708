"""The projected box of a posed body."""

from dataclasses import replace

import numpy as np

from ihbench.fit.body_box import body_box
from tests.bench.fake_capture import a_camera, a_pose, the_body

BODY = the_body()


def test_the_box_holds_the_body_and_little_else():
    camera, vertices = a_camera(0.4, 128), BODY.pose(a_pose(0.3, 0.5))
    box = body_box(camera, vertices)
    x0, y0, width, height = box.window
    assert box.inside.shape == (height, width)
    x, y = (camera.project(vertices)[:, :2] - [x0, y0]).astype(int).T
    assert box.inside[y, x].all()
    assert box.inside.any(0).all(), "the window is the smallest"
    assert box.inside.any(1).all()
    # a box along the world's axes, seen from a corner: its figure does not fill the window
    assert 0.5 < box.inside.mean() < 1
    wider = body_box(camera, vertices, grown=0.2)
    assert wider.window[2] > width + 5


def test_a_box_seen_along_an_axis_is_a_rectangle_of_its_nearest_face():
    vertices = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.0]])
    camera = replace(a_camera(0.0, 100), R=np.eye(3), t=np.array([0, 0, 2.05]))
    camera = replace(camera, K=np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]))
    x0, y0, width, height = body_box(camera, vertices).window
    # corners at 0.55 m, 2 m away: 27.5 px beside the centre, rounded to pixels
    assert (x0, y0) == (22, 22)
    assert 55 <= width == height <= 57
    assert body_box(camera, vertices).inside.all()


def test_a_body_behind_around_or_beside_the_camera_has_the_whole_image():
    camera = a_camera(0.0, 32)
    for shift in ((0, 0, 9), (0, 0, 2.9), (30, 0, 0)):
        box = body_box(camera, BODY.pose(a_pose(transl=shift)))
        assert box.window == (0, 0, 32, 32), shift
        assert box.inside.all()
    far = body_box(camera, BODY.pose(a_pose(transl=(0.0, 0.0, -1e7))))
    assert far.inside.any()
