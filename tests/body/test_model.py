import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from ihbench.body import JOINT_NAMES, PARENTS, PART_PALETTE, load_body, skinning_numpy
from ihbench.body.pose import BodyPose
from ihbench.errors import BadInput

POSE = np.random.default_rng(0).normal(0, 0.4, (24, 3))
BETAS = np.random.default_rng(1).normal(0, 1, 10)


def body_pose(pose=POSE, betas=BETAS, transl=(0.5, 1, -2)) -> BodyPose:
    return BodyPose(pose, betas, transl)


def test_importing_the_package_is_cheap():
    code = (
        "import sys, ihbench.body; ihbench.body.load_body(); "
        "print([m for m in ('torch', 'cv2', 'skimage', 'scipy', 'matplotlib', 'numba') if m in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_the_default_body_is_the_same_object_every_time():
    assert load_body() is load_body()


def test_arrays_cannot_be_changed():
    with pytest.raises(ValueError, match="read-only"):
        load_body().v_template[0] = 0


def test_missing_betas_are_zero_and_surplus_zeros_are_dropped():
    body = load_body()
    short, joints = body.shaped(BETAS[:3])
    padded = body.shaped(np.concatenate([BETAS[:3], np.zeros(297)]))
    np.testing.assert_allclose(short, padded[0], atol=1e-15)
    np.testing.assert_allclose(joints, padded[1], atol=1e-15)
    np.testing.assert_array_equal(body.shaped(np.zeros(0))[0], body.v_template)
    with pytest.raises(BadInput, match="10 shape coefficients, the data gives 12"):
        body.shaped(np.concatenate([np.zeros(11), [0.1]]))


def test_shapes_are_linear():
    body = load_body()
    one, _ = body.shaped(BETAS)
    two, _ = body.shaped(2 * BETAS)
    np.testing.assert_allclose(two - body.v_template, 2 * (one - body.v_template), atol=1e-12)


def test_pose_is_skinning_of_the_shaped_body():
    body, pose = load_body(), body_pose()
    vertices, joints = body.shaped(BETAS)
    transforms = body.joint_transforms(pose)
    np.testing.assert_allclose(body.pose(pose), skinning_numpy.lbs(vertices, body.weights, transforms), atol=1e-14)
    homogeneous = np.concatenate([joints, np.ones((24, 1))], 1)
    np.testing.assert_allclose(
        body.posed_joints(pose), np.einsum("kab,kb->ka", transforms, homogeneous)[:, :3], atol=1e-14
    )


def test_transl_only_moves():
    body = load_body()
    moved, still = body_pose(transl=(0.5, 1, -2)), body_pose(transl=(0, 0, 0))
    np.testing.assert_allclose(
        body.pose(moved) - body.pose(still), np.tile([0.5, 1, -2], (len(body.parts), 1)), atol=1e-13
    )
    np.testing.assert_allclose(body.posed_joints(moved) - body.posed_joints(still), np.tile([0.5, 1, -2], (24, 1)))


def test_offsets_turn_with_the_body():
    body = load_body()
    pose = np.zeros((24, 3))
    pose[0] = [0, np.pi / 2, 0]  # +x of the body becomes -z of the world
    turned = BodyPose(pose, np.zeros(10), np.zeros(3))
    offsets = np.tile([0.01, 0, 0], (len(body.parts), 1))
    change = body.pose(turned, offsets=offsets) - body.pose(turned)
    np.testing.assert_allclose(change, np.tile([0, 0, -0.01], (len(body.parts), 1)), atol=1e-14)


def test_blend_shapes_follow_the_joint_rotations_and_can_be_left_out():
    plain = load_body()
    posedirs = np.random.default_rng(3).normal(0, 1e-3, (len(plain.v_template), 3, 207))
    body = replace(plain, posedirs=posedirs)
    pose = body_pose()
    np.testing.assert_array_equal(body.pose(pose, blend_shapes=False), plain.pose(pose))
    feature = (skinning_numpy.axis_angle_to_matrix(POSE[1:]) - np.eye(3)).reshape(-1)
    corrected = plain.pose(pose, offsets=np.einsum("vcf,f->vc", posedirs, feature))
    np.testing.assert_allclose(body.pose(pose), corrected, atol=1e-12)
    root_only = np.zeros((24, 3))
    root_only[0] = [1, 2, 3]
    np.testing.assert_array_equal(body.pose(body_pose(root_only)), plain.pose(body_pose(root_only)))


def test_skeleton_facts():
    body = load_body()
    assert len(JOINT_NAMES) == len(PARENTS) == 24
    assert all(parent < k for k, parent in enumerate(PARENTS))
    assert tuple(body.parents) == PARENTS
    assert body.parts.shape == (len(body.v_template),)
    assert set(body.parts) == set(range(24))
    left = [k for k, name in enumerate(JOINT_NAMES) if name.startswith("left")]
    assert (body.joints[left, 0] > 0).all()  # left is +x
    assert JOINT_NAMES[PARENTS[JOINT_NAMES.index("left_elbow")]] == "left_shoulder"


def test_part_colours_are_well_apart():
    from skimage.color import rgb2lab

    lab = rgb2lab(PART_PALETTE[None] / 255.0)[0]
    distance = np.linalg.norm(lab[:, None] - lab, axis=-1) + 1e3 * np.eye(24)
    assert distance.min() > 35
    grey = rgb2lab(np.linspace(0, 1, 16)[None, :, None].repeat(3, 2))[0]  # backgrounds
    assert np.linalg.norm(lab[:, None] - grey, axis=-1).min() > 15


def test_content_sha_changes_with_any_array():
    body = load_body()
    assert body.content_sha() == replace(body).content_sha()
    assert len(body.content_sha()) == 12
    changes = {"v_template": body.v_template + 1e-12, "faces": body.faces[::-1], "uv": 1 - body.uv}
    shas = {replace(body, **{name: value}).content_sha() for name, value in changes.items()}
    assert len(shas | {body.content_sha()}) == 4
