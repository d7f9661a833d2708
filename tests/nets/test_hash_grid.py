"""The hash grid's compiled loops against tensors in float64, and its sizes against tiny-cuda-nn's."""

import numpy as np
import pytest
import torch

from ihbench.nets.hash_grid import LARGEST_START, HashGrid, features_by_torch


def a_grid(seed=0, scale=1.0, **sizes):
    grid = HashGrid(torch.Generator().manual_seed(seed), **sizes)
    with torch.no_grad():
        grid.table.mul_(scale / LARGEST_START)
    return grid


def twin(grid, points, table):
    return features_by_torch(points, table, grid.scales, grid.sides, grid.starts)


SMALL = {"levels": 5, "coarsest": 4, "finest": 37, "log2_size": 9}


@pytest.mark.parametrize("features", [1, 2, 3])
def test_the_loops_are_the_tensors(features):
    """Dense and hashed levels; values, and gradients of points and table for a random pull."""
    grid = a_grid(features=features, **SMALL)
    rows = grid.starts.diff().tolist()
    assert rows[0] == 4**3 < 2**9 == rows[-1] < int(grid.sides[-1]) ** 3, "both kinds of level"
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(300, 3, generator=generator).requires_grad_()
    pull = torch.randn(300, grid.width, generator=generator)
    exact = [each.detach().double().requires_grad_() for each in (points, grid.table)]
    got, expected = grid(points), twin(grid, *exact)
    torch.testing.assert_close(got.double(), expected, atol=2e-5, rtol=0)
    gradients = torch.autograd.grad(got, [points, grid.table], pull)
    for own, true in zip(gradients, torch.autograd.grad(expected, exact, pull.double()), strict=True):
        assert ((own.double() - true).norm() / true.norm()) < 1e-4


def test_gradients_are_those_of_central_differences():
    grid = a_grid(levels=2, coarsest=2, finest=5, log2_size=4).double()
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, t: twin(grid, p, t), (points, grid.table))


def test_a_lattice_corner_reads_its_row():
    """At a corner of the coarsest lattice the other seven have no weight."""
    grid = a_grid(**SMALL)
    corner = torch.tensor([1.0, 2.0, 3.0])
    place = (corner - 0.5) / grid.scales[0]
    row = int(corner @ torch.tensor([1.0, 4.0, 16.0]))
    torch.testing.assert_close(grid(place[None])[0, :2], grid.table[row], atol=1e-5, rtol=0)


def test_the_released_sizes():
    """16 levels of 2 in 2^16 rows from 16 to 2048: 1.80 M parameters, growth 1.382, values within 1e-4."""
    grid = HashGrid(torch.Generator().manual_seed(0))
    assert (grid.width, grid.table.numel()) == (32, 1_796_048)
    assert grid.sides[[0, -1]].tolist() == [16, 2048]
    growth = ((grid.scales[1:] + 1) / (grid.scales[:-1] + 1)).numpy()
    assert growth == pytest.approx(np.full(15, 1.382), abs=1e-3)
    assert 0.9e-4 < grid.table.abs().max() <= 1e-4


def test_what_lies_outside_is_read_at_the_border_without_a_pull():
    grid = a_grid(**SMALL)
    points = torch.tensor([[-3.0, 0.4, 2.0], [0.0, 0.4, 1.0], [torch.nan, 0.4, torch.inf]], requires_grad=True)
    features = grid(points)
    assert torch.equal(features[0], features[1])
    assert torch.equal(features[2], features[1])
    (gradient,) = torch.autograd.grad(features.sum(), points)
    assert not gradient[[0, 0, 2, 2], [0, 2, 0, 2]].any()
    assert gradient[:, 1].all()


def test_sizes_that_make_no_grid_are_refused():
    for sizes in ({"coarsest": 32, "finest": 16}, {"levels": 0}, {"log2_size": 40}):
        with pytest.raises(ValueError, match="hash grid: expected"):
            HashGrid(torch.Generator(), **sizes)


def test_no_point_at_all():
    grid = a_grid(**SMALL)
    points = torch.zeros(0, 3, requires_grad=True)
    features = grid(points)
    assert tuple(features.shape) == (0, grid.width)
    features.sum().backward()
    assert not grid.table.grad.any()
