"""Sines and cosines of a position, as NeRF gives it to its networks (Mildenhall et al. 2020, sec. 5.1), and with
bands that come on during a fit."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def positional_encoding(
    points: Tensor,  # [N, D], such as places in m
    frequencies: int,
    first: float = math.pi,  # rad/m of the lowest frequency: π, or 1 in the code that comes from HumanNeRF
) -> Tensor:
    """[N, D + 2 D F]: the points themselves, then sine and cosine at `first` times 1, 2, 4, …."""
    octaves = 2.0 ** torch.arange(frequencies, dtype=points.dtype, device=points.device)
    flat = (points[:, :, None] * (first * octaves)).flatten(1)
    return torch.cat([points, flat.sin(), flat.cos()], 1)


def band_window(
    progress: float,  # bands that are on; at or beyond `frequencies` all are
    frequencies: int,
) -> Tensor:
    """[F] in [0, 1]: bands come on one after the other, each along half a cosine (BARF; HumanNeRF,
    embedders/hannw_fourier.py:26-41)."""
    share = (progress - torch.arange(frequencies, dtype=torch.float64)).clamp(0, 1)
    return ((1 - torch.cos(math.pi * share)) / 2).float()


def windowed_encoding(
    points: Tensor,  # [N, 3] m
    window: Tensor,  # [F]
    first: float = 1.0,  # rad/m
) -> Tensor:
    """[N, 6 F]: sines, then cosines, each band times its window; without the points themselves."""
    encoded = positional_encoding(points, len(window), first)[:, 3:]
    return encoded * window.to(points).repeat(6)
