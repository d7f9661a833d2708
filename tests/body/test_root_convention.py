from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench.body import Body, from_zju_root, load_body, zju_root
from ihbench.body.pose import BodyPose
from ihbench.errors import BadInput


def off_centre_body() -> Body:
    """A pelvis off the origin, as SMPL has it: with J0 = 0 the two conventions could not be told apart."""
    body = load_body()
    return replace(body, v_template=body.v_template + np.array([0.02, -0.25, 0.03]))


def random_body_pose(seed: int, root_angle: float | None = None) -> BodyPose:
    rng = np.random.default_rng(seed)
    pose = rng.normal(0, 0.5, (24, 3))
    if root_angle is not None:
        pose[0] *= root_angle / np.linalg.norm(pose[0])
    return BodyPose(pose, rng.normal(0, 1, 10), rng.normal(0, 2, 3))


def zju_vertices(body, body_pose: BodyPose, Rh, Th) -> np.ndarray:
    """R(Rh) LBS(zero root) + Th, as ZJU-MoCap's own reader computes them."""
    pose = body_pose.pose.copy()
    pose[0] = 0
    at_rest = body.pose(BodyPose(pose, body_pose.betas, np.zeros(3)))
    return at_rest @ Rotation.from_rotvec(Rh).as_matrix().T + Th


@pytest.mark.parametrize("root_angle", [0.0, 1e-9, 1.0, np.pi - 1e-7, np.pi, 6.28])
def test_both_conventions_put_every_vertex_in_the_same_place(root_angle):
    body = off_centre_body()
    body_pose = random_body_pose(0, root_angle)
    Rh, Th = zju_root(body_pose, body)
    np.testing.assert_allclose(zju_vertices(body, body_pose, Rh, Th), body.pose(body_pose), atol=1e-12)
    if root_angle in (1.0, np.pi):
        assert np.abs(Th - body_pose.transl).max() > 1e-3


def test_there_and_back():
    body = off_centre_body()
    for seed in range(5):
        body_pose = random_body_pose(seed)
        Rh, Th = zju_root(body_pose, body)
        poses = body_pose.pose.copy()
        poses[0] = 0
        for layout in (poses.reshape(1, 72), poses[1:].reshape(69)):
            back = from_zju_root(layout, body_pose.betas[None], Rh[None], Th[None], body)
            np.testing.assert_allclose(back.pose, body_pose.pose, atol=0)
            np.testing.assert_allclose(back.transl, body_pose.transl, atol=1e-14)
            np.testing.assert_array_equal(back.betas, body_pose.betas)


def test_wrong_pose_layouts_are_bad_input():
    body, zeros = load_body(), np.zeros(3)
    with pytest.raises(BadInput, match="72 numbers"):
        from_zju_root(np.zeros(75), np.zeros(10), zeros, zeros, body)
    with pytest.raises(BadInput, match="Rh holds the root"):
        from_zju_root(np.ones(72), np.zeros(10), zeros, zeros, body)


@pytest.mark.parametrize(
    ("size", "word"), [(66, "GVHMR"), (156, "SMPL-H"), (165, "SMPL-X"), (63, "without the root")]
)
def test_a_pose_of_another_body_says_what_it_is(size, word):
    with pytest.raises(BadInput, match=f"got {size}; {size} are .*{word}"):
        from_zju_root(np.zeros(size), np.zeros(10), np.zeros(3), np.zeros(3), load_body())
