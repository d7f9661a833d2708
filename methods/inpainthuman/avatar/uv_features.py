"""Multi-scale UV feature maps (sec. 3.2): L square maps over UV space, sampled bilinearly and summed."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from ihbench.body.uv import map_coordinates


def bilinear_corners(
    uv: NDArray[np.float64],  # [N, 2], v up
    nearest: NDArray[np.int64],  # [R, R] flat index of the nearest texel inside a chart, its own inside one
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Flat texel indices [N, 4] and weights [N, 4] of the bilinear sample at each uv.

    A corner outside every chart is replaced by its nearest inside texel: the effect of padding the charts, without
    letting features of another body part or of the empty background bleed across a seam.
    """
    resolution = len(nearest)
    position = np.clip(map_coordinates(uv, resolution), 0, resolution - 1)
    low = np.floor(position).astype(np.int64)
    (x0, y0), (fx, fy) = low.T, (position - low).T
    x1, y1 = np.minimum(x0 + 1, resolution - 1), np.minimum(y0 + 1, resolution - 1)
    index = nearest[np.stack([y0, y0, y1, y1], 1), np.stack([x0, x1, x0, x1], 1)]
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    return index, weight.astype(np.float32)


class UVFeatures(nn.Module):
    """The learnable maps and where each canonical point samples them.

    All levels share one table [sum of R², C]; the sum over levels is then a single weighted gather of 4·L rows.
    """

    index: Tensor
    weight: Tensor

    def __init__(
        self,
        corners: list[tuple[NDArray[np.int64], NDArray[np.float32]]],  # per level, of `bilinear_corners`
        resolutions: tuple[int, ...],
        channels: int,
        std: float,
        fusion: str,
        generator: torch.Generator,
    ):
        super().__init__()
        start = np.cumsum([0] + [r * r for r in resolutions])
        self.levels = len(resolutions)
        self.fusion = fusion
        self.out_channels = channels * (self.levels if fusion == "concat" else 1)
        self.table = nn.Parameter(torch.randn(int(start[-1]), channels, generator=generator) * std)
        index = [torch.from_numpy(i + s) for (i, _), s in zip(corners, start[:-1], strict=True)]
        self.register_buffer("index", torch.cat(index, 1), persistent=False)  # [N, 4 L]
        self.register_buffer("weight", torch.from_numpy(np.concatenate([w for _, w in corners], 1)), persistent=False)

    def forward(self, points: Tensor) -> Tensor:  # [n] point numbers
        """Features [n, C] (sum) or [n, L C] (concat) of the chosen points."""
        index, weight = self.index[points], self.weight[points]
        if self.fusion == "sum":
            return embedding_bag(index, self.table, per_sample_weights=weight, mode="sum")
        n = len(points)
        per_level = embedding_bag(
            index.reshape(n * self.levels, 4),
            self.table,
            per_sample_weights=weight.reshape(n * self.levels, 4),
            mode="sum",
        )
        return per_level.reshape(n, -1)
