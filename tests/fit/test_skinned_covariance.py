"""Covariances from scales and quaternions, and under the linear part of a skinning transform."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ihbench.body.skinning import axis_angle_to_matrix, lbs
from ihbench.fit.gaussians.skinned_covariance import blended_linear, quaternion_to_matrix, skinned_covariance


def some(count=20, seed=0):
    rng = np.random.default_rng(seed)
    scales = torch.tensor(10 ** rng.uniform(-3, 0, (count, 3)))
    return scales, torch.tensor(rng.normal(size=(count, 4)))


def test_quaternions_of_any_length_are_rotations():
    _, q = some()
    expected = Rotation.from_quat(q.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(quaternion_to_matrix(q).numpy(), expected, atol=1e-14)
    torch.testing.assert_close(quaternion_to_matrix(1e3 * q), quaternion_to_matrix(q))
    assert torch.equal(quaternion_to_matrix(torch.zeros(4)), torch.eye(3))


def test_a_known_covariance():
    """A needle along x, turned by 90° about z, lies along y."""
    q = torch.tensor([math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)], dtype=torch.float64)
    got = skinned_covariance(torch.tensor([1.0, 0.1, 0.01], dtype=torch.float64), q)
    torch.testing.assert_close(
        got, torch.diag(torch.tensor([0.01, 1.0, 1e-4], dtype=torch.float64)), atol=1e-15, rtol=0
    )


def test_it_is_the_product_and_symmetric_to_the_bit():
    scales, q = (each.float() for each in some(200))
    linear = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(0))
    got = skinned_covariance(scales, q, linear)
    assert torch.equal(got, got.mT)
    twin = quaternion_to_matrix(q.double())
    twin = linear.double() @ twin @ torch.diag_embed(scales.double() ** 2) @ twin.mT @ linear.double().mT
    torch.testing.assert_close(got.double(), twin, atol=1e-5, rtol=1e-4)
    assert (torch.linalg.eigvalsh(got.double()) > -1e-6 * got.double().flatten(1).abs().amax(1)[:, None]).all()


def test_a_rotation_turns_it():
    """GauHuman's acceptance check 2: a pure root turn R gives R Σ Rᵀ; the identity changes nothing."""
    scales, q = some()
    rest = skinned_covariance(scales, q)
    turn = axis_angle_to_matrix(torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64))
    torch.testing.assert_close(skinned_covariance(scales, q, turn), turn @ rest @ turn.T)
    torch.testing.assert_close(skinned_covariance(scales, q, torch.eye(3, dtype=torch.float64)), rest)


def test_a_blend_of_rotations_shears():
    """3DGS-Avatar's acceptance check 4: half identity, half a 90° turn leaves a quarter of the determinant."""
    scales, q = some()
    transforms = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    transforms[1, :3, :3] = axis_angle_to_matrix(torch.tensor([0, 0, math.pi / 2], dtype=torch.float64))
    weights = torch.full((len(q), 2), 0.5, dtype=torch.float64)
    posed = skinned_covariance(scales, q, blended_linear(weights, transforms))
    ratio = torch.linalg.det(posed) / torch.linalg.det(skinned_covariance(scales, q))
    torch.testing.assert_close(ratio, torch.full_like(ratio, 0.25), atol=1e-9, rtol=1e-6)


def test_the_linear_part_is_the_derivative_of_skinning():
    rng = np.random.default_rng(1)
    weights = torch.tensor(rng.dirichlet(np.ones(4), 6))
    transforms = torch.eye(4, dtype=torch.float64).repeat(3, 4, 1, 1)  # of three poses
    transforms[..., :3, :] = torch.tensor(rng.normal(size=(3, 4, 3, 4)))
    points = torch.tensor(rng.normal(size=(6, 3)))
    linear = blended_linear(weights, transforms)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 0.5
        difference = lbs(points + step, weights, transforms) - lbs(points - step, weights, transforms)
        torch.testing.assert_close(linear[..., axis], difference)


def test_gradients():
    scales, q = some(3)
    linear = torch.randn(3, 3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inputs = [each.clone().requires_grad_() for each in (scales, q, linear)]
    assert torch.autograd.gradcheck(skinned_covariance, inputs)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e6])
def test_extreme_scales_stay_finite(scale):
    scales = torch.tensor([[1.0, scale, scale]], requires_grad=True)
    q = torch.tensor([[0.5, 0.5, -0.5, 0.5]], requires_grad=True)
    skinned_covariance(scales, q).sum().backward()
    assert scales.grad is not None
    assert scales.grad.isfinite().all()
