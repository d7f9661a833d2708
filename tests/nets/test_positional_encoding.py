"""The positional encoding against its formula."""

import numpy as np
import pytest
import torch

from ihbench.nets.positional_encoding import band_window, positional_encoding, windowed_encoding


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


def test_bands_come_on_along_half_a_cosine():
    """HumanNeRF's window: bands 0 … F-1, each over one unit of progress."""
    assert band_window(0, 6).tolist() == [0] * 6
    assert band_window(1.5, 6).tolist() == pytest.approx([1, 0.5, 0, 0, 0, 0])
    assert band_window(2.25, 6).tolist() == pytest.approx([1, 1, 0.1464, 0, 0, 0], abs=1e-4)
    assert band_window(1e7, 6).tolist() == [1] * 6
    points = torch.tensor([[0.1, -0.7, 0.35]])
    full = positional_encoding(points, 4, 1.0)[:, 3:]
    assert torch.equal(windowed_encoding(points, torch.ones(4)), full)
    window = torch.tensor([1.0, 0.5, 0.0, 0.0])
    assert torch.allclose(windowed_encoding(points, window), full * window.repeat(6))
