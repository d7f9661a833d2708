"""1 - SSIM as a loss over some of an image's pixels, where others are unknown."""

from __future__ import annotations

import torch
from torch import Tensor

from ihbench.metrics.ssim_torch import ssim_map_torch


def where_known(rgb: Tensor, image: Tensor, unknown: Tensor) -> tuple[Tensor, Tensor]:
    """What is shown and what is wanted [h, w, 3]. Where `unknown` [h, w, 1] is 1 both are the rendering itself,
    without gradient: a window that reaches there compares the avatar with itself."""
    own = rgb.detach()
    return torch.where(unknown > 0, own, rgb), torch.where(unknown > 0, own, image)


def dissimilarity(seen: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    """Mean of 1 - SSIM of two images [h, w, 3] by the weights [h, w, 1]; 0 without any."""
    similarity = ssim_map_torch(seen.permute(2, 0, 1), wanted.permute(2, 0, 1)).permute(1, 2, 0)
    return ((1 - similarity) * weight).sum() / (3 * weight.sum().clamp(min=1))
