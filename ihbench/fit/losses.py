"""Losses over some of an image's pixels, where others are unknown: means by weights, 1 - SSIM, LPIPS."""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from ihbench.metrics.ssim_torch import ssim_map_torch

Perceptual = Callable[[Tensor, Tensor], Tensor]  # two images [h, w, 3] in [0, 1] -> a distance


def masked_mean(
    values: Tensor,  # [h, w, 3]
    weight: Tensor,  # [h, w, 1]
) -> Tensor:
    """Mean over pixels and channels by the weights; weights of less than one pixel count as one."""
    return (values * weight).sum() / (3 * weight.sum().clamp(min=1))


def where_known(
    rgb: Tensor,  # [h, w, 3] the rendering
    image: Tensor,  # [h, w, 3]
    unknown: Tensor,  # [h, w, 1]
) -> tuple[Tensor, Tensor]:
    """Rendering and image [h, w, 3]. Where `unknown` is 1 both are the rendering itself, without gradient and within
    0 to 1 as an image is: a window that reaches there compares the avatar with itself."""
    own = rgb.detach().clamp(0, 1)
    return torch.where(unknown > 0, own, rgb), torch.where(unknown > 0, own, image)


def dissimilarity(
    rgb: Tensor,  # [h, w, 3]
    image: Tensor,  # [h, w, 3]
    weight: Tensor,  # [h, w, 1]
) -> Tensor:
    """Mean of 1 - SSIM of two images by the weights; 0 without any."""
    similarity = ssim_map_torch(rgb.permute(2, 0, 1), image.permute(2, 0, 1)).permute(1, 2, 0)
    return masked_mean(1 - similarity, weight)


def pyramid_distance(rgb: Tensor, image: Tensor) -> Tensor:  # [h, w, 3]
    """Mean absolute differences of a pyramid of band-passed images, each band half as fine as the one before, summed:
    edges and texture count beside colours, wherever they are a little displaced (Lap1 of Bojanowski et al. 2018)."""
    difference = (rgb - image).permute(2, 0, 1)[None]
    total = difference.new_zeros(())
    while min(difference.shape[-2:]) >= 4:
        coarse = F.avg_pool2d(difference, 2, ceil_mode=True, count_include_pad=False)
        smooth = F.interpolate(coarse, difference.shape[-2:], mode="bilinear", align_corners=False)
        total = total + (difference - smooth).abs().mean()
        difference = coarse
    return total + difference.abs().mean()


def perceptual(net: str, device: torch.device, least: int | None = None) -> Perceptual | str:
    """LPIPS with one of its networks as a differentiable loss; the reason when its weights are not here. Images of a
    side below `least` px are padded with grey: by default as the metric pads them."""
    from ihbench.metrics.lpips import MIN_SIDE, PADDING, load

    network = load(net)
    if isinstance(network, str):
        return network
    # the metric's own network stays as it is, on the CPU
    package = copy.deepcopy(network.package).to(device).requires_grad_(False)
    side = MIN_SIDE if least is None else least

    def distance(rgb: Tensor, image: Tensor) -> Tensor:
        height, width = rgb.shape[:2]
        pad = (0, max(side - width, 0), 0, max(side - height, 0))
        x, y = (F.pad(each.permute(2, 0, 1)[None], pad, value=PADDING) for each in (rgb, image))
        return package(2 * x - 1, 2 * y - 1).sum()

    return distance
