"""Screen gradients and radii as density control gathers them."""

import math

import pytest
import torch

from ihbench.fit.gaussians.density_state import DensityState
from ihbench.fit.gaussians.gaussian_set import Rows

SIDES = (200, 100)  # px, width and height


def test_the_released_statistic():
    """Half-image units, norms summed, divided by the steps with a radius; the largest radius."""
    state = DensityState.none(3)
    state.add(torch.tensor([[3e-3, 0], [0, 4e-3], [1.0, 1.0]]), torch.tensor([2.0, 5.0, 0.0]), *SIDES)
    state.add(torch.tensor([[3e-3, 8e-3], [0, 0], [1.0, 1.0]]), torch.tensor([1.0, 0.0, 0.0]), *SIDES)
    assert state.mean().tolist() == [pytest.approx((0.3 + 0.5) / 2), pytest.approx(0.2), 0]
    assert state.steps.tolist() == [2, 1, 0]
    assert state.radius.tolist() == [2, 5, 0]


def test_a_gaussian_drawn_behind_others_counts():
    """A radius and no gradient: the mean falls, as released."""
    state = DensityState.none(1)
    state.add(torch.tensor([[0.01, 0.0]]), torch.ones(1), *SIDES)
    state.add(torch.zeros(1, 2), torch.ones(1), *SIDES)
    assert state.mean().item() == pytest.approx(0.5)


def test_what_is_not_finite_is_left_out_and_counted():
    state = DensityState.none(4)
    bad = torch.tensor([[math.nan, 0.0], [math.inf, 0.0], [1.0, 0.0], [1.0, 0.0]])
    state.add(bad, torch.tensor([1.0, 1.0, math.nan, 1.0]), *SIDES)
    assert state.mean().tolist() == [0, 0, 0, 100]
    assert state.steps.tolist() == [0, 0, 0, 1]
    assert state.radius.tolist() == [0, 0, 0, 1]
    assert state.refused.item() == 3


def test_other_lengths_are_refused():
    with pytest.raises(ValueError, match=r"expected \(3, 2\) and \(3,\), got \(2, 2\) and \(3,\)"):
        DensityState.none(3).add(torch.zeros(2, 2), torch.zeros(3), *SIDES)


def test_it_follows_the_set_and_begins_anew():
    state = DensityState.none(3)
    state.add(torch.tensor([[0.01, 0], [0.02, 0], [0.03, 0]]), torch.tensor([1.0, 2.0, 3.0]), *SIDES)
    state.rearrange(Rows.made(torch.tensor([False, True, True]), torch.tensor([0])))
    assert state.mean().tolist() == [pytest.approx(2), pytest.approx(3), 0]
    assert state.radius.tolist() == [2, 3, 0]
    state.clear()
    assert state.mean().sum() == state.radius.sum() == state.steps.sum() == 0


def test_saved_and_restored():
    state = DensityState.none(2)
    state.add(torch.tensor([[0.01, math.nan], [0.02, 0]]), torch.ones(2), *SIDES)
    other = DensityState.of({"more": torch.zeros(1), **state.tensors()})
    for name, value in state.tensors().items():
        assert torch.equal(other.tensors()[name], value)
    state.clear()  # a copy does not follow
    assert other.mean()[1].item() == pytest.approx(2)
    with pytest.raises(ValueError, match="gradient_sum, steps, radius, refused missing"):
        DensityState.of({})
