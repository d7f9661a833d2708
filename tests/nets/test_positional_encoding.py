"""The positional encoding against its formula."""

import numpy as np
import torch

from ihbench.nets.positional_encoding import positional_encoding


def test_positional_encoding():
    """[x, sin(π 2^k x), cos(π 2^k x)]; at 0 it is 0, 0 and 1."""
    zero = positional_encoding(torch.zeros(1, 3), 6)[0]
    assert zero.shape == (3 + 36,)
    assert zero.tolist() == [0.0] * 21 + [1.0] * 18
    points = torch.tensor([[0.1, -0.7, 0.35]], dtype=torch.float64)
    got = positional_encoding(points, 4)[0]
    angle = (points[0, :, None] * np.pi * 2.0 ** torch.arange(4, dtype=torch.float64)).flatten()
    torch.testing.assert_close(got, torch.cat([points[0], angle.sin(), angle.cos()]))
    assert positional_encoding(points, 0).tolist() == points.tolist()


def test_the_lowest_frequency_may_be_another():
    points = torch.tensor([[0.1, -0.7, 0.35]], dtype=torch.float64)
    got = positional_encoding(points, 10, first=1.0)[0]
    angle = (points[0, :, None] * 2.0 ** torch.arange(10, dtype=torch.float64)).flatten()
    torch.testing.assert_close(got, torch.cat([points[0], angle.sin(), angle.cos()]))
