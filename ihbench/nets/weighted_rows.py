"""Weighted sums of a table's rows: how a point reads feature maps bilinearly, with a fast backward pass on the CPU.

The gradient of a table is a scatter of many rows into few, which torch does on a CPU ten times as slowly as one
thread here. The order of the sums does not depend on anything.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import embedding_bag


def weighted_rows(
    table: Tensor,  # [R, C] float
    index: Tensor,  # [N, K] int32 rows of the table
    weight: Tensor,  # [N, K] float32
    points: Tensor,  # [n] int64, which of the N
    decay: float = 0.0,
) -> Tensor:
    """[n, C] sum over k of weight[p, k] table[index[p, k]], differentiable in the table.

    `decay` is added to the gradient as decay * table: that of decay / 2 * |table|², whose value is not computed.
    """
    return _WeightedRows.apply(table, index, weight, points, decay)


class _WeightedRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table, index, weight, points, decay) -> Any:
        index, weight = index[points], weight[points]
        ctx.decay = decay
        ctx.save_for_backward(table, index, weight)
        return embedding_bag(index, table.detach(), per_sample_weights=weight.to(table.dtype), mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        table, index, weight = ctx.saved_tensors
        gradient = table.detach() * ctx.decay if ctx.decay else torch.zeros_like(table)
        (given,) = grad_outputs
        if table.device.type == "cpu" and table.dtype == torch.float32:
            rows = given.float().contiguous().numpy()
            _scatter(rows, index.numpy(), weight.numpy(), gradient.numpy())
        else:
            spread = given[:, None, :] * weight[:, :, None].to(given.dtype)
            gradient.index_add_(0, index.flatten().long(), spread.flatten(0, 1).to(gradient.dtype))
        return gradient, None, None, None, None


@njit(cache=True, nogil=True)
def _scatter(rows, index, weight, gradient):
    """gradient[index[i, k]] += weight[i, k] rows[i]. Unsigned, so that numba leaves out its test for negative indices
    and the inner loop becomes vector instructions: five times as fast."""
    channels = np.uint64(gradient.shape[1])
    for i in range(np.uint64(index.shape[0])):
        for k in range(np.uint64(index.shape[1])):
            w, row = weight[i, k], np.uint64(index[i, k])
            for c in range(channels):
                gradient[row, c] += w * rows[i, c]
