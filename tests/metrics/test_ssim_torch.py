"""The differentiable SSIM is the same SSIM, and its gradient is right."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ihbench.metrics import ssim_map
from ihbench.metrics.oracles.oracle import ssim_map_oracle
from ihbench.metrics.ssim_torch import ssim_map_torch


def images(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(*shape, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2)]


@pytest.mark.parametrize("shape", [(3, 1, 1), (1, 2, 30), (3, 20, 17)])
@pytest.mark.parametrize("options", [{}, {"window": 7, "sigma": 1.0, "data_range": 2.0}])
def test_equals_the_oracle(shape, options):
    pred, truth = images(*shape)
    expected = ssim_map_oracle(*(image.permute(1, 2, 0).numpy() for image in (pred, truth)), **options)
    np.testing.assert_allclose(ssim_map_torch(pred, truth, **options).permute(1, 2, 0), expected, rtol=0, atol=1e-10)


def test_map_and_gradient_agree_with_kornia():
    """Where no window reaches the border, which kornia mirrors in another way."""
    from kornia.metrics import ssim

    results = []
    for similarity in (ssim_map_torch, lambda a, b: ssim(a[None], b[None], 11)[0]):
        pred, truth = (image.requires_grad_() for image in images(3, 30, 26))
        inner = similarity(pred, truth)[:, 5:-5, 5:-5]
        results.append((inner, *torch.autograd.grad(inner.square().sum(), (pred, truth))))
    for ours, theirs in zip(*results, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)


def test_float32_on_pictures():
    rows, columns = np.mgrid[:64, :64] / 64
    truth = np.stack([0.5 + 0.4 * np.sin(9 * rows + k * columns) for k in range(3)], -1)
    pred = np.clip(truth + 0.1 * np.random.default_rng(0).standard_normal(truth.shape), 0, 1)
    values = ssim_map_torch(*(torch.tensor(image, dtype=torch.float32).permute(2, 0, 1) for image in (pred, truth)))
    np.testing.assert_allclose(values.permute(1, 2, 0), ssim_map(pred, truth), rtol=0, atol=2e-5)


def test_leading_dimensions_are_free():
    pred, truth = images(2, 4, 3, 16, 12)
    values = ssim_map_torch(pred, truth)
    assert values.shape == pred.shape
    torch.testing.assert_close(values[1, 2], ssim_map_torch(pred[1, 2], truth[1, 2]), rtol=0, atol=1e-12)


@pytest.mark.parametrize("shape", [(1, 7, 12), (2, 3, 4)])
def test_gradients(shape):
    pred, truth = (image.requires_grad_() for image in images(*shape, seed=3))
    assert torch.autograd.gradcheck(lambda a, b: ssim_map_torch(a, b), (pred, truth), fast_mode=True)


@pytest.mark.parametrize("level", [0.0, 0.9, 1.0])
def test_flat_and_equal_images_are_one_with_a_finite_zero_gradient(level):
    pred = torch.full((3, 24, 24), level, requires_grad=True)
    values = ssim_map_torch(pred, torch.full((3, 24, 24), level))
    values.mean().backward()
    assert (values == 1).all()
    assert pred.grad is not None
    assert pred.grad.abs().max() < 1e-7


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_raised(dtype):
    pred, truth = images(3, 16, 16, dtype=dtype)
    values = ssim_map_torch(pred, truth)
    assert values.dtype == torch.float32
    torch.testing.assert_close(values.double(), ssim_map_torch(pred.double(), truth.double()), rtol=0, atol=5e-5)


def test_the_same_call_gives_the_same_bits():
    results = []
    for _ in range(2):
        pred, truth = images(3, 40, 40, dtype=torch.float32)
        pred.requires_grad_()
        ssim_map_torch(pred, truth).mean().backward()
        results.append(pred.grad)
    assert torch.equal(*results)


def test_mismatches_are_refused():
    with pytest.raises(ValueError, match=r"\(3, 4, 4\).*\(3, 5, 4\)"):
        ssim_map_torch(torch.zeros(3, 4, 4), torch.zeros(3, 5, 4))
    with pytest.raises(ValueError, match="window"):
        ssim_map_torch(torch.zeros(3, 4, 4), torch.zeros(3, 4, 4), window=4)
