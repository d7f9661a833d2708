import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ihbench.body import PARENTS, canonical_pose, load_body, skinning, skinning_numpy

RNG_SEED = 0
GENERATORS = np.array(
    [
        [[0, 0, 0], [0, 0, -1], [0, 1, 0]],
        [[0, 0, 1], [0, 0, 0], [-1, 0, 0]],
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],
    ],
    dtype=np.float64,
)
ANGLES = [0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-4, 0.00999, 0.0100001, 0.1, 1, 3]
ANGLES += [np.pi - 1e-9, np.pi, np.pi + 1e-9, 2 * np.pi - 1e-9, 2 * np.pi, 2 * np.pi + 1e-9, 7, 100]


def axes() -> np.ndarray:
    random = np.random.default_rng(RNG_SEED).normal(size=(20, 3))
    return np.concatenate([np.eye(3), -np.eye(3), random / np.linalg.norm(random, axis=1, keepdims=True)])


def random_pose(scale: float = 1.0, seed: int = RNG_SEED) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, scale, (24, 3))


@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_agrees_with_scipy_near_every_singularity(angle):
    rotations = axes() * angle
    expected = Rotation.from_rotvec(rotations).as_matrix()
    tolerance = 4e-15 * max(1, angle)
    np.testing.assert_allclose(skinning_numpy.axis_angle_to_matrix(rotations), expected, atol=tolerance)
    actual = skinning.axis_angle_to_matrix(torch.from_numpy(rotations)).numpy()
    np.testing.assert_allclose(actual, expected, atol=tolerance)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-5, 5e-3])
def test_small_angles_keep_their_digits(angle):
    """R - I is K plus K²/2 to the next order: 1 - cos must not lose its digits."""
    rotation = np.array([0, 0, angle])
    for matrix in (
        skinning_numpy.axis_angle_to_matrix(rotation),
        skinning.axis_angle_to_matrix(torch.from_numpy(rotation)).numpy(),
    ):
        assert matrix[1, 0] == pytest.approx(np.sin(angle), rel=1e-15)
        assert 1 - matrix[0, 0] == pytest.approx(2 * np.sin(angle / 2) ** 2, abs=2.3e-16)


@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_gradient_is_right_at_every_angle(angle):
    rotations = torch.from_numpy(axes()[:8] * angle).requires_grad_()
    assert torch.autograd.gradcheck(skinning.axis_angle_to_matrix, rotations, atol=1e-7)


def test_axis_angle_and_its_gradient_agree_with_kornia():
    """Away from 0, where kornia switches to a first-order formula."""
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    rotations = torch.from_numpy(np.concatenate([axes() * angle for angle in (0.1, 1, 3, 7)])).requires_grad_()
    weight = torch.from_numpy(np.random.default_rng(1).normal(size=(len(rotations), 3, 3)))
    results = []
    for matrix in (skinning.axis_angle_to_matrix, axis_angle_to_rotation_matrix):
        out = matrix(rotations)
        results.append((out, *torch.autograd.grad((out * weight).sum(), rotations)))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=3e-5)  # kornia adds 1e-6 to the angle it divides by


def test_axis_angle_gradient_at_zero_is_the_generators():
    rotation = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(skinning.axis_angle_to_matrix, rotation)
    np.testing.assert_array_equal(jacobian.permute(2, 0, 1).numpy(), GENERATORS)


@pytest.mark.parametrize("angle", [0, 1e-6, 0.0099, 0.0101, 3.14])
def test_axis_angle_in_single_precision(angle):
    rotations = torch.from_numpy(axes() * angle).float().requires_grad_()
    matrices = skinning.axis_angle_to_matrix(rotations)
    matrices.square().sum().backward()
    assert matrices.dtype == torch.float32
    expected = skinning_numpy.axis_angle_to_matrix(rotations.detach().numpy())
    np.testing.assert_allclose(matrices.detach().numpy(), expected, atol=5e-7)
    assert torch.isfinite(rotations.grad).all()
    assert rotations.grad.abs().max() < 1e-4  # |R|² is 3 whatever the rotation


@pytest.mark.parametrize("scale", [0, 1e-9, 0.5, np.pi])
def test_torch_equals_its_numpy_twin(scale):
    body = load_body()
    pose, transl = random_pose(scale), np.array([0.3, -1, 4])
    expected = skinning_numpy.joint_transforms(pose, body.joints, PARENTS, transl)
    tensors = [torch.from_numpy(a.copy()) for a in (pose, body.joints, transl, body.v_template, body.weights)]
    pose_t, joints_t, transl_t, points_t, weights_t = tensors
    actual = skinning.joint_transforms(pose_t, joints_t, PARENTS, transl_t)
    np.testing.assert_allclose(actual.numpy(), expected, atol=1e-14)
    moved = skinning.lbs(points_t, weights_t, actual)
    np.testing.assert_allclose(moved.numpy(), skinning_numpy.lbs(body.v_template, body.weights, expected), atol=1e-14)
    posedirs = np.random.default_rng(1).normal(size=(11, 3, 207))
    np.testing.assert_allclose(
        skinning.pose_blend_offsets(pose_t, torch.from_numpy(posedirs)).numpy(),
        skinning_numpy.pose_blend_offsets(pose, posedirs),
        atol=1e-13,
    )


def test_leading_batch_dimensions_are_free():
    body = load_body()
    poses = np.stack([random_pose(0.5, seed) for seed in range(6)]).reshape(2, 3, 24, 3)
    transl = np.random.default_rng(2).normal(size=(2, 3, 3))
    points, weights = body.v_template[::100].copy(), body.weights[::100].copy()
    transforms = skinning.joint_transforms(
        torch.from_numpy(poses), torch.from_numpy(body.joints.copy()), PARENTS, torch.from_numpy(transl)
    )
    moved = skinning.lbs(torch.from_numpy(points), torch.from_numpy(weights), transforms)
    posedirs = torch.ones(5, 3, 207, dtype=torch.float64)
    assert skinning.pose_blend_offsets(torch.from_numpy(poses), posedirs).shape == (2, 3, 5, 3)
    for i in range(2):
        for j in range(3):
            one = skinning_numpy.joint_transforms(poses[i, j], body.joints, PARENTS, transl[i, j])
            np.testing.assert_allclose(transforms[i, j].numpy(), one, atol=1e-14)
            np.testing.assert_allclose(moved[i, j].numpy(), skinning_numpy.lbs(points, weights, one), atol=1e-14)


def test_a_batch_of_translations_moves_one_pose():
    joints = torch.from_numpy(load_body().joints.copy())
    transl = torch.arange(6.0, dtype=torch.float64).reshape(2, 3)
    transforms = skinning.joint_transforms(torch.zeros(24, 3, dtype=torch.float64), joints, PARENTS, transl)
    assert transforms.shape == (2, 24, 4, 4)
    torch.testing.assert_close(transforms[:, :, :3, 3], transl[:, None].expand(2, 24, 3))


@pytest.mark.parametrize("scale", [0, 1e-3, 1.0, np.pi])
def test_posing_is_differentiable_everywhere(scale):
    """Gradients through the whole chain, at the zero pose too, where a careless norm gives NaN."""
    body = load_body()
    joints = torch.from_numpy(body.joints.copy()).requires_grad_()
    points = torch.from_numpy(body.v_template[::2000].copy()).requires_grad_()
    weights = torch.from_numpy(body.weights[::2000].copy())
    pose = torch.from_numpy(random_pose(scale)).requires_grad_()
    transl = torch.zeros(3, dtype=torch.float64, requires_grad=True)

    def posed(pose, joints, points, transl):
        return skinning.lbs(points, weights, skinning.joint_transforms(pose, joints, PARENTS, transl))

    assert torch.autograd.gradcheck(posed, (pose, joints, points, transl), atol=1e-6, fast_mode=True)


def test_the_zero_pose_moves_nothing():
    body = load_body()
    transforms = skinning_numpy.joint_transforms(np.zeros((24, 3)), body.joints, PARENTS)
    np.testing.assert_array_equal(transforms, np.broadcast_to(np.eye(4), (24, 4, 4)))


def test_each_transform_carries_its_own_joint_to_where_its_parent_puts_it():
    body = load_body()
    transforms = skinning_numpy.joint_transforms(random_pose(), body.joints, PARENTS)
    for k in range(1, 24):
        own = transforms[k, :3, :3] @ body.joints[k] + transforms[k, :3, 3]
        parent = transforms[PARENTS[k], :3, :3] @ body.joints[k] + transforms[PARENTS[k], :3, 3]
        np.testing.assert_allclose(own, parent, atol=1e-14)


def test_the_root_turns_about_the_pelvis():
    body = load_body()
    pose = canonical_pose("a_pose")
    pose[0] = [0.3, 2, -1]
    transl = np.array([1.0, 2, 3])
    upright = canonical_pose("a_pose")
    still = skinning_numpy.lbs(
        body.v_template, body.weights, skinning_numpy.joint_transforms(upright, body.joints, PARENTS)
    )
    turned = skinning_numpy.lbs(
        body.v_template, body.weights, skinning_numpy.joint_transforms(pose, body.joints, PARENTS, transl)
    )
    R, pelvis = Rotation.from_rotvec(pose[0]).as_matrix(), body.joints[0]
    np.testing.assert_allclose(turned, (still - pelvis) @ R.T + pelvis + transl, atol=1e-13)


def test_opposite_half_turns_blend_to_something_finite():
    """Two bones turned by +π and -π about the same axis are the same rotation; +π/2 and -π/2 cancel in the mean."""
    points = torch.tensor([[0.3, 0.2, 0.1]], dtype=torch.float64)
    weights = torch.tensor([[0.5, 0.5]], dtype=torch.float64)
    joints = torch.zeros(2, 3, dtype=torch.float64)
    for angle, expected in ((np.pi, [-0.3, -0.2, 0.1]), (np.pi / 2, [0, 0, 0.1])):
        pose = torch.tensor([[0, 0, angle], [0, 0, -2 * angle]], dtype=torch.float64, requires_grad=True)
        moved = skinning.lbs(points, weights, skinning.joint_transforms(pose, joints, (-1, 0)))
        np.testing.assert_allclose(moved.detach().numpy()[0], expected, atol=1e-15)
        moved.sum().backward()
        assert torch.isfinite(pose.grad).all()
