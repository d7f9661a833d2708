"""Weighted sums of a table's rows, forward and backward, against dense float64 sums."""

import numpy as np
import pytest
import torch

from ihbench.nets.weighted_rows import weighted_rows


def a_table(rows=40, channels=19, points=60, each=5, seed=0):
    rng = np.random.default_rng(seed)
    table = torch.tensor(rng.normal(size=(rows, channels)), dtype=torch.float32, requires_grad=True)
    index = torch.tensor(rng.integers(0, rows, (points, each)), dtype=torch.int32)
    weight = torch.tensor(rng.normal(size=(points, each)), dtype=torch.float32)
    some = torch.tensor(rng.integers(0, points, 77))  # points may come twice
    return table, index, weight, some


def dense(table, index, weight, points):
    matrix = torch.zeros(len(points), len(table), dtype=torch.float64)
    for row, point in enumerate(points.tolist()):
        for r, w in zip(index[point].tolist(), weight[point].tolist(), strict=True):
            matrix[row, r] += w
    return matrix @ table.double()


@pytest.mark.parametrize("channels", [1, 3, 16, 32, 35])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sums_and_gradients_are_those_of_the_dense_matrix(channels, dtype):
    """float32 takes the kernel, float64 torch's own scatter."""
    table, index, weight, points = a_table(channels=channels)
    table = table.detach().to(dtype).requires_grad_()
    given = torch.tensor(np.random.default_rng(1).normal(size=(len(points), channels)), dtype=dtype)
    got = weighted_rows(table, index, weight, points)
    expected = dense(table, index, weight, points)
    torch.testing.assert_close(got.double(), expected, atol=1e-5, rtol=1e-5)
    (gradient,) = torch.autograd.grad(got, table, given)
    (true,) = torch.autograd.grad(expected, table, given.double())
    torch.testing.assert_close(gradient.double(), true.double(), atol=1e-5, rtol=1e-5)


def test_decay_is_the_gradient_of_the_squared_table_and_no_value():
    table, index, weight, points = a_table()
    plain = weighted_rows(table, index, weight, points)
    decayed = weighted_rows(table, index, weight, points, decay=0.5)
    assert torch.equal(plain, decayed)
    (without,) = torch.autograd.grad(plain.sum(), table)
    (with_decay,) = torch.autograd.grad(decayed.sum(), table)
    torch.testing.assert_close(with_decay - without, 0.5 * table.detach(), atol=1e-5, rtol=1e-5)


def test_a_gradient_that_is_no_block_of_memory_counts_as_well():
    table, index, weight, points = a_table()
    given = torch.randn(table.shape[1], len(points)).T
    out = weighted_rows(table, index, weight, points)
    first = torch.autograd.grad(out, table, given, retain_graph=True)[0]
    assert torch.equal(first, torch.autograd.grad(out, table, given.contiguous())[0])


def test_no_points():
    table, index, weight, _ = a_table()
    out = weighted_rows(table, index, weight, torch.empty(0, dtype=torch.int64))
    assert out.shape == (0, table.shape[1])
    assert not torch.autograd.grad(out.sum(), table)[0].any()
