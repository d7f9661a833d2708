"""The grid over four coordinates: its compiled loops against tensors in float64, its sizes against torch-ngp's."""

import pytest
import torch

from ihbench.nets.hash_grid import LARGEST_START, features_by_torch
from ihbench.nets.hash_grid_4d import HashGrid4d

SMALL = {"levels": 4, "coarsest": 3, "finest": 21, "log2_size": 10}


def a_grid(seed=0, **sizes):
    grid = HashGrid4d(torch.Generator().manual_seed(seed), **sizes)
    with torch.no_grad():
        grid.table.mul_(1 / LARGEST_START)
    return grid


@pytest.mark.parametrize("features", [1, 2])
def test_the_loops_are_the_tensors(features):
    """Dense and hashed levels; values, and gradients of points and table for a random pull."""
    grid = a_grid(features=features, **SMALL)
    rows = grid.starts.diff().tolist()
    assert rows[0] >= 4**4 < 2**10 == rows[-1] < int(grid.sides[-1]) ** 4, "both kinds of level"
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(300, 4, generator=generator).requires_grad_()
    pull = torch.randn(300, grid.width, generator=generator)
    exact = [each.detach().double().requires_grad_() for each in (points, grid.table)]
    got, expected = grid(points), features_by_torch(exact[0], exact[1], grid.scales, grid.sides, grid.starts)
    torch.testing.assert_close(got.double(), expected, atol=2e-5, rtol=0)
    gradients = torch.autograd.grad(got, [points, grid.table], pull)
    for own, true in zip(gradients, torch.autograd.grad(expected, exact, pull.double()), strict=True):
        assert ((own.double() - true).norm() / true.norm()) < 1e-4
    (of_table,) = torch.autograd.grad(grid(points.detach()), [grid.table], pull)
    torch.testing.assert_close(of_table, gradients[1], atol=0, rtol=0)


def test_gradients_are_those_of_central_differences():
    grid = a_grid(levels=2, coarsest=2, finest=4, log2_size=7).double()
    points = torch.rand(4, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: grid(p), (points,))


def test_the_released_sizes():
    """16 levels of 2 in 2^19 rows from 16 to 2048 · 1.5: 15.5 M parameters, the first two levels dense."""
    grid = HashGrid4d(torch.Generator().manual_seed(0), log2_size=19, finest=3072)
    assert grid.starts.diff()[:3].tolist() == [83_528, 331_776, 2**19]
    assert (grid.width, grid.table.numel()) == (32, 15_510_672)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_lies_outside_reads_nothing(dtype):
    grid = a_grid(**SMALL).to(dtype)
    points = torch.tensor(
        [[0.5, 0.5, 0.5, 1.01], [-0.01, 0.5, 0.5, 0.5], [0.5, torch.nan, 0.5, 0.5], [1.0, 0.0, 1.0, 0.0]],
        dtype=dtype,
        requires_grad=True,
    )
    features = grid(points)
    assert not features[:3].any()
    assert features[3].any()
    (gradient,) = torch.autograd.grad(features.sum(), points)
    assert not gradient[:3].nan_to_num(nan=1.0).any()
