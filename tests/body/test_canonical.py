import numpy as np
import pytest

from ihbench.body import CANONICAL_POSES, JOINT_INDEX, canonical_pose, load_body
from ihbench.body.pose import BodyPose
from ihbench.errors import BadInput


def joint(pose_name: str, joint_name: str) -> np.ndarray:
    joints = load_body().posed_joints(BodyPose(canonical_pose(pose_name), np.zeros(10), np.zeros(3)))
    return joints[JOINT_INDEX[joint_name]]


@pytest.mark.parametrize("name", CANONICAL_POSES)
def test_canonical_poses_are_mirror_symmetric(name):
    pose = canonical_pose(name)
    assert pose.shape == (24, 3)
    for joint_name, k in JOINT_INDEX.items():
        if joint_name.startswith("left_"):
            mirrored = JOINT_INDEX[joint_name.replace("left_", "right_")]
            np.testing.assert_array_equal(pose[k], pose[mirrored] * [1, -1, -1])


def test_a_pose_lowers_the_arms_by_45_degrees_and_spreads_the_legs():
    arm = joint("a_pose", "left_wrist") - joint("a_pose", "left_shoulder")
    t_arm = joint("t_pose", "left_wrist") - joint("t_pose", "left_shoulder")
    turn = np.arctan2(arm[1], arm[0]) - np.arctan2(t_arm[1], t_arm[0])
    assert np.rad2deg(turn) == pytest.approx(-45)
    assert joint("a_pose", "left_ankle")[0] > joint("t_pose", "left_ankle")[0] + 0.3


def test_big_pose_and_vitruvian_differ_only_below_the_ankle():
    np.testing.assert_allclose(joint("big_pose", "left_ankle"), joint("vitruvian", "left_ankle"))
    assert np.linalg.norm(joint("big_pose", "left_foot") - joint("vitruvian", "left_foot")) > 0.01
    assert np.rad2deg(canonical_pose("big_pose")[[1, 2, 7, 8], 2]) == pytest.approx([45, -45, -30, 30])


def test_gaussianavatar_keeps_the_arms_straight():
    np.testing.assert_allclose(joint("gaussianavatar", "left_wrist"), joint("t_pose", "left_wrist"))
    assert np.rad2deg(canonical_pose("gaussianavatar")[[1, 2], 2]) == pytest.approx([30, -30])
    assert not canonical_pose("t_pose").any()


def test_unknown_names_get_the_nearest_one():
    with pytest.raises(BadInput, match="did you mean 'a_pose'"):
        canonical_pose("apose")
