"""The networks that correct poses and skinning weights: their sizes, where they start, and what they see."""

import pytest
import torch

from ihbench.nets.pose_correction import PoseCorrection
from ihbench.nets.positional_encoding import positional_encoding
from ihbench.nets.weight_offsets import WeightOffsets


def size(network):
    return sum(p.numel() for p in network.parameters())


def test_the_pose_network_begins_with_all_but_no_rotation():
    network = PoseCorrection(torch.Generator().manual_seed(0))
    assert size(network) == 34_373
    turns = network(torch.randn(23, 3, generator=torch.Generator().manual_seed(1)))
    assert 0 < (turns - torch.eye(3)).abs().max() < 1e-3
    turns.square().mul(torch.arange(9.0).reshape(3, 3)).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in network.parameters())


def test_the_weight_network_sees_the_encoding_twice():
    """Restated with the two inputs of the fourth layer side by side."""
    network = WeightOffsets(seed=0)
    assert size(network) == 68_888
    points = torch.randn(7, 3, generator=torch.Generator().manual_seed(1), requires_grad=True)
    encoded = positional_encoding(points, 10, first=1.0)
    x = encoded
    for layer in network.hidden:
        x = torch.relu(layer(x))
    expected = network.last(torch.relu(network.skip(torch.cat([encoded, x], 1))))
    got = network(points)
    torch.testing.assert_close(got, expected, atol=1e-6, rtol=1e-5)
    got.sum().backward()
    assert points.grad is None


@pytest.mark.parametrize("make", [lambda seed: PoseCorrection(torch.Generator().manual_seed(seed)), WeightOffsets])
def test_a_seed_gives_its_own_weights_and_leaves_others_random_numbers_alone(make):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first, again, other = (torch.cat([p.detach().flatten() for p in make(s).parameters()]) for s in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    if make is WeightOffsets:
        assert torch.equal(torch.rand(3), expected)
