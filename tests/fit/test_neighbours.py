"""Nearest neighbours by a k-d tree, and the spacing of points."""

import math

import numpy as np
import pytest
import torch

from ihbench.fit.gaussians.neighbours import SMALLEST_SPACING, distance_to, nearest, spacing


def test_against_all_distances():
    points = torch.tensor(np.random.default_rng(0).normal(size=(60, 3)))
    every = torch.cdist(points, points).fill_diagonal_(math.inf)
    distance, number = nearest(points, 4)
    expected = every.topk(4, largest=False)
    torch.testing.assert_close(distance, expected.values)
    assert torch.equal(number, expected.indices)


@pytest.mark.parametrize("count", [2, 3, 9, 40])
def test_no_point_is_its_own_neighbour_among_coincident_ones(count):
    distance, number = nearest(torch.zeros(count, 3), 2)
    assert number.shape == (count, min(2, count - 1))
    assert (distance == 0).all()
    assert (number != torch.arange(count)[:, None]).all()
    assert all(len(set(row)) == len(row) for row in number.tolist())


@pytest.mark.parametrize("count", [0, 1])
def test_too_few(count):
    distance, number = nearest(torch.zeros(count, 3), 3)
    assert distance.shape == number.shape == (count, 0)
    assert spacing(torch.zeros(count, 3)).tolist() == [np.float32(SMALLEST_SPACING)] * count


def test_spacing_is_the_root_mean_square_of_three():
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [50, 50, 50]])
    assert spacing(points)[0].item() == pytest.approx(math.sqrt((1 + 4 + 9) / 3))
    assert spacing(torch.zeros(5, 3))[0].item() == pytest.approx(math.sqrt(1e-7))


def test_distance_to_others():
    distance, number = distance_to(torch.tensor([[0.0, 0, 0], [5, 0, 0]]), torch.tensor([[4.0, 0, 0], [0, 1, 0]]))
    assert distance.tolist() == [1, 1]
    assert number.tolist() == [1, 0]
