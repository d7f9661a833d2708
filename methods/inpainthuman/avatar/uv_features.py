"""Multi-scale UV feature maps (sec. 3.2): L square maps over UV space, sampled bilinearly and summed."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.body.uv import map_coordinates
from ihbench.nets.weighted_rows import weighted_rows


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

    All levels share one table [sum of R², C]; the sum over levels is then a single weighted sum of rows. `decay` is
    the weight of half the squared table in the loss.
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
        self.fusion = fusion
        self.out_channels = channels * (len(resolutions) if fusion == "concat" else 1)
        self.table = nn.Parameter(torch.randn(int(start[-1]), channels, generator=generator) * std)
        corners = [nearest_only(index + s, weight) for (index, weight), s in zip(corners, start[:-1], strict=True)]
        self.rows = [index.shape[1] for index, _ in corners]  # of each level
        index, weight = (np.concatenate(parts, 1) for parts in zip(*corners, strict=True))
        self.register_buffer("index", torch.from_numpy(index.astype(np.int32)), persistent=False)  # [N, rows]
        self.register_buffer("weight", torch.from_numpy(weight), persistent=False)

    def forward(self, points: Tensor, decay: float = 0.0) -> Tensor:  # [n] point numbers
        """Features [n, C] (sum) or [n, L C] (concat) of the chosen points."""
        if self.fusion == "sum":
            return weighted_rows(self.table, self.index, self.weight, points, decay)
        decays = [decay] + [0.0] * (len(self.rows) - 1)
        parts = zip(self.index.split(self.rows, 1), self.weight.split(self.rows, 1), decays, strict=True)
        return torch.cat([weighted_rows(self.table, *part[:2], points, part[2]) for part in parts], 1)


def nearest_only(
    index: NDArray[np.int64],  # [N, 4]
    weight: NDArray[np.float32],  # [N, 4]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """One row a point, where all points stand on texels of the level; else the four as they are."""
    best = weight.argmax(1)[:, None]
    alone = np.take_along_axis(weight, best, 1)
    if not (alone > 1 - 1e-5).all():
        return index, weight
    return np.take_along_axis(index, best, 1), np.ones_like(alone)
