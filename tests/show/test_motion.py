"""Motions: files of several makers, built-in loops, rates, and where in the world they are put."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ihbench import registry
from ihbench.body import load_body
from ihbench.body.pose import BodyPose
from ihbench.body.root_convention import zju_root
from ihbench.errors import BadInput
from ihbench.show.motion import Motion, find_motion, placed, read_motion, stand_of, up_axis

BETAS = np.zeros(10)


@pytest.fixture(scope="module")
def body():
    return load_body()


def some_poses(count=5, seed=0):
    rng = np.random.default_rng(seed)
    pose = rng.normal(0, 0.3, (count, 24, 3))
    pose[:, 22:] = 0
    return pose, rng.normal(0, 1, (count, 3))


def test_files_of_several_makers_hold_the_same_motion(body, tmp_path):
    pose, transl = some_poses()
    smplh = np.concatenate([pose[:, :22].reshape(5, 66), np.ones((5, 90))], 1)  # hands that SMPL does not have
    roots = [zju_root(BodyPose(p, BETAS, t), body) for p, t in zip(pose, transl, strict=True)]
    zju = pose.copy()
    zju[:, 0] = [Rh for Rh, _ in roots]
    files = {
        "amass": {"poses": smplh, "trans": transl, "mocap_framerate": np.float64(120), "gender": "neutral"},
        "amass-x": {"poses": np.pad(smplh, ((0, 0), (0, 9))), "trans": transl, "mocap_frame_rate": np.int64(120)},
        "smpl": {"poses": pose.reshape(5, 72), "trans": transl, "mocap_framerate": np.array([120.0])},
        "ours": {
            "pose": pose[::-1],
            "transl": transl[::-1],
            "betas": BETAS,
            "frames": np.arange(5)[::-1],
            "fps": 120,
        },
        "zju": {"pose": zju, "transl": np.stack([Th for _, Th in roots]), "root": "zju", "fps": np.float32(120)},
        "instantavatar": {"thetas": pose.reshape(5, 72), "transl": transl, "fps": 120},
    }
    for name, arrays in files.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
        motion = read_motion(tmp_path / f"{name}.npz", body, BETAS)
        np.testing.assert_allclose(motion.pose, pose, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(motion.transl, transl, atol=1e-9, err_msg=name)
        assert (motion.fps, motion.seconds) == (120, pytest.approx(4 / 120))


@pytest.mark.parametrize(
    ("arrays", "word"),
    [
        ({"vertices": np.zeros(3)}, "found none of them"),
        ({"poses": np.zeros((3, 70))}, r"got \[3, 70\]"),
        ({"poses": np.full((3, 72), np.nan)}, "NaN"),
        ({"poses": np.full((3, 72), 90.0)}, "radians"),
        ({"poses": np.zeros((3, 72)), "trans": np.zeros((2, 3))}, "got 3 and 2"),
        ({"poses": np.zeros((3, 72)), "mocap_framerate": -1.0}, "frames a second"),
        ({"poses": np.array(["a", "b"])}, "numbers"),
    ],
)
def test_other_files_are_refused_in_a_line(body, tmp_path, arrays, word):
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(BadInput, match=word) as refusal:
        read_motion(tmp_path / "m.npz", body, BETAS)
    assert "m.npz" in str(refusal.value)


def test_a_name_that_nobody_knows(body):
    with pytest.raises(BadInput, match="did you mean 'march'"):
        find_motion("marsh", 25, body, BETAS)


def test_resampling_keeps_what_is_there_and_turns_evenly_between():
    pose = np.zeros((3, 24, 3))
    pose[1, 5, 0], pose[2, 5, 0] = 0.4, 1.2
    transl = np.array([[0.0, 0, 0], [0, 0, 1], [0, 0, 5]])
    motion = Motion(pose, transl, 10.0)
    assert np.array_equal(motion.resampled(10).pose, pose)
    double = motion.resampled(20)
    np.testing.assert_allclose(double.pose[:, 5, 0], [0, 0.2, 0.4, 0.8, 1.2], atol=1e-9)
    np.testing.assert_allclose(double.transl[:, 2], [0, 0.5, 1, 3, 5], atol=1e-9)
    assert len(motion.resampled(10, 7)) == 7
    near = np.zeros((2, 24, 3))
    near[:, 0, 1] = 3.0, -3.0  # the short way, over half a turn
    angle = Motion(near, np.zeros((2, 3)), 1.0).resampled(2).pose[1, 0]
    assert np.linalg.norm(angle) == pytest.approx(np.pi, abs=1e-6)


@pytest.mark.parametrize("name", registry.names("motion"))
def test_built_in_motions_stand_on_the_floor_and_have_no_seam(body, name):
    motion = find_motion(name, 4, body, BETAS)
    assert motion.cyclic
    lowest = [body.pose(p)[:, 1].min() for p in motion.body_poses(BETAS)]
    np.testing.assert_allclose(lowest, 0, atol=1e-9)
    if name != "turn":  # whose angle goes on
        steps = np.abs(np.diff(motion.pose, axis=0)).max((1, 2))
        assert np.abs(motion.pose[0] - motion.pose[-1]).max() <= steps.max() + 1e-9
    assert motion.pose.std(0).max() > 0.1  # it moves
    assert len(find_motion(name, 25, body, BETAS)) == round(25 * registry.load("motion", name).seconds)


def test_a_motion_is_put_where_another_body_stands(body):
    pose, transl = some_poses(4)
    pose[:, 0] = [[np.pi / 2, 0, 0]] * 4  # z up
    motion = Motion(pose, transl, 10.0)
    there_pose = np.zeros((24, 3))
    there_pose[0] = Rotation.from_euler("y", 130, degrees=True).as_rotvec()
    there = stand_of(body, BodyPose(there_pose, BETAS, np.array([5.0, 1, 2])), np.array([0.0, 1, 0]))
    moved = placed(motion, body, BETAS, there)
    own, seen = motion.body_poses(BETAS), moved.body_poses(BETAS)
    start = stand_of(body, seen[0], up_axis(seen))
    np.testing.assert_allclose(start.axes, there.axes, atol=1e-9)
    np.testing.assert_allclose(start.pelvis, there.pelvis, atol=1e-9)
    first = body.pose(own[0]).mean(0)
    turn = there.axes @ stand_of(body, own[0], np.array([0.0, 0, 1])).axes.T
    for a, b in zip(own, seen, strict=True):  # one rigid movement for all frames
        np.testing.assert_allclose(
            (body.pose(a) - first) @ turn.T, body.pose(b) - body.pose(seen[0]).mean(0), atol=1e-9
        )


@pytest.mark.parametrize("axis", [(0.0, 1, 0), (0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_up_is_the_axis_nearest_to_how_bodies_stand(axis):
    rng = np.random.default_rng(1)
    upright, _ = Rotation.align_vectors([axis], [[0.0, 1, 0]])
    poses = []
    for _ in range(20):
        lean = Rotation.from_rotvec(rng.normal(0, 0.2, 3))
        pose = np.zeros((24, 3))
        pose[0] = (upright * lean).as_rotvec()
        poses.append(BodyPose(pose, BETAS, np.zeros(3)))
    assert np.array_equal(up_axis(poses), axis)


def test_up_of_a_tilted_world_is_the_bodies_own():
    pose = np.zeros((24, 3))
    pose[0] = (0.7, 0, 0)
    up = up_axis([BodyPose(pose, BETAS, np.zeros(3))])
    np.testing.assert_allclose(up, Rotation.from_rotvec(pose[0]).apply([0, 1, 0]), atol=1e-12)
