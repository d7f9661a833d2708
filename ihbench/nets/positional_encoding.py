"""Sines and cosines of a position, as NeRF gives it to its networks (Mildenhall et al. 2020, sec. 5.1)."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def positional_encoding(
    points: Tensor,  # [N, 3] m
    frequencies: int,
    first: float = math.pi,  # rad/m of the lowest frequency: π, or 1 in the code that comes from HumanNeRF
) -> Tensor:
    """[N, 3 + 6 F]: the points themselves, then sine and cosine at `first` times 1, 2, 4, …."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=points.dtype, device=points.device)
    flat = (points[:, :, None] * (first * octaves)).reshape(len(points), 3 * frequencies)
    return torch.cat([points, flat.sin(), flat.cos()], 1)
