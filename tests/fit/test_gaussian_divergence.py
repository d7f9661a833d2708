"""The divergence between Gaussians, against closed forms, torch.distributions and exact fractions."""

import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.distributions import MultivariateNormal, kl_divergence

from ihbench.fit.gaussians.divergence import gaussian_divergence
from ihbench.fit.gaussians.skinned_covariance import quaternion_to_matrix, skinned_covariance

UPRIGHT = torch.tensor([[1.0, 0, 0, 0]])


def some(count, seed, dtype=torch.float64, low=-1.0):
    rng = np.random.default_rng(seed)
    parts = rng.normal(size=(count, 3)), rng.uniform(low, 0, (count, 3)), rng.normal(size=(count, 4))
    return tuple(torch.tensor(each, dtype=dtype) for each in parts)


def round_ones(distance, scale, other):
    """KL of two round Gaussians so far apart, of these scales."""
    apart = torch.tensor([[distance, 0.0, 0.0]], dtype=torch.float64)
    logs = [torch.full((1, 3), math.log(s), dtype=torch.float64) for s in (scale, other)]
    return gaussian_divergence(apart, logs[0], UPRIGHT, 0 * apart, logs[1], UPRIGHT).item()


def test_the_table_of_the_released_gate():
    assert round_ones(0, 0.01, 0.01) == 0
    assert round_ones(0.03, 0.01, 0.01) == pytest.approx(4.5)
    assert round_ones(math.sqrt(0.8), 1, 1) == pytest.approx(0.4)  # .894 s
    assert round_ones(math.sqrt(0.2), 1, 1) == pytest.approx(0.1)  # .447 s
    assert round_ones(0, 1, 2) == pytest.approx(0.9544, abs=5e-5)
    assert round_ones(0, 2, 1) == pytest.approx(2.4206, abs=5e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_gaussians_have_none_to_the_bit(dtype):
    same = some(500, 0, dtype, low=-9.0)
    assert torch.equal(gaussian_divergence(*same, *same), torch.zeros(500, dtype=torch.float64))
    opposite = (same[0], same[1], -same[2])  # the same rotation
    assert gaussian_divergence(*same, *opposite).abs().max() == 0


def test_against_torch_distributions():
    one, other = some(200, 0), some(200, 1)
    normals = [MultivariateNormal(m, skinned_covariance(s.exp(), q)) for m, s, q in (one, other)]
    torch.testing.assert_close(gaussian_divergence(*one, *other), kl_divergence(*normals), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-6, 1e-3, 1.0])
def test_needles_turned_a_little(angle):
    """1:1000. Both lie in the plane of the turn: ½ sin² (r - 1)²/r with r the ratio of the variances."""
    logs = torch.tensor([[0.0, math.log(1e-3), 0.0]], dtype=torch.float64)
    q = torch.tensor([[math.cos(angle / 2), 0, 0, math.sin(angle / 2)]], dtype=torch.float64)
    zero = torch.zeros(1, 3, dtype=torch.float64)
    got = gaussian_divergence(zero, logs, q, zero, logs, UPRIGHT).item()
    assert got == pytest.approx(0.5 * math.sin(angle) ** 2 * (1e6 - 1) ** 2 / 1e6, rel=1e-6)


@pytest.mark.parametrize("change", [1e-12, 1e-9, 1e-5, 0.0499, 0.0501, 1.0])
def test_small_differences_keep_their_digits(change):
    """φ(x) = eˣ - 1 - x by its series in exact fractions."""
    x = Fraction(2 * change)
    exact, term = Fraction(0), Fraction(1)
    for k in range(1, 40):
        term = term * x / k
        exact += term if k > 1 else 0
    zero, logs = torch.zeros(1, 3, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    got = gaussian_divergence(zero, logs + change, UPRIGHT, zero, logs, UPRIGHT).item()
    assert got == pytest.approx(float(exact) * 1.5, rel=1e-13)


@given(st.integers(0, 2**32 - 1), st.floats(-12, 0))
def test_never_negative_and_blind_to_a_common_motion(seed, low):
    one, other = some(8, seed, low=low), some(8, seed + 1, low=low)
    got = gaussian_divergence(*one, *other)
    assert (got >= 0).all()
    turn = torch.tensor([[0.3, -0.5, 0.7, 0.2]], dtype=torch.float64)
    moved = [(m @ quaternion_to_matrix(turn)[0].T + 3, s, product(turn, q)) for m, s, q in (one, other)]
    torch.testing.assert_close(gaussian_divergence(*moved[0], *moved[1]), got, rtol=1e-6, atol=1e-9)


def product(first, second):
    w, v = first[:, :1], first[:, 1:].expand(len(second), 3)
    a, b = second[:, :1], second[:, 1:]
    return torch.cat([w * a - (v * b).sum(1, keepdim=True), w * b + a * v + torch.linalg.cross(v, b)], 1)


def test_far_ends_are_no_nan():
    zero = torch.zeros(1, 3)
    tiny, huge = zero - 1e4, zero + 1e4
    assert gaussian_divergence(zero, huge, UPRIGHT, zero, tiny, UPRIGHT).item() > 1e30
    assert gaussian_divergence(zero, tiny, UPRIGHT, zero, huge, UPRIGHT).item() > 1e4 - 10
    assert gaussian_divergence(zero, zero, 0 * UPRIGHT, zero, zero, UPRIGHT).item() == 0
