"""Push–pull: spread the colours of known person pixels over the hidden ones, from fine to coarse and back.

What `mini` finds in the hidden pixels of its masked image, where Stable Diffusion finds grey. So small a model spends
most of its training on learning to carry colours across a hole; here that is done, and it learns the rest.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

FULL = 0.25  # share of known pixels in a cell at which its own mean is taken as it is


def push_pull(
    images: Tensor,  # [B, 3, H, W]
    known: Tensor,  # [B, 1, H, W] 1 where a pixel's colour may be spread
) -> Tensor:
    """[B, 3, H, W]: known pixels as they are, every other the mean of the known around it, 0 without any."""
    weight = known.to(images.dtype)
    levels = [(images * weight, weight)]
    while max(levels[-1][1].shape[-2:]) > 1:
        colour, share = (_even(value) for value in levels[-1])
        levels.append((avg_pool2d(colour, 2), avg_pool2d(share, 2)))
    colour, share = levels[-1]
    out = colour / share.clamp(min=1e-6)
    for colour, share in reversed(levels[:-1]):
        size = (colour.shape[-2] + colour.shape[-2] % 2, colour.shape[-1] + colour.shape[-1] % 2)
        wider = interpolate(out, size=size, mode="bilinear", align_corners=False)
        wider = wider[..., : colour.shape[-2], : colour.shape[-1]]
        own = colour / share.clamp(min=1e-6)
        out = torch.lerp(wider, own, (share / FULL).clamp(max=1))
    return out


def _even(value: Tensor) -> Tensor:
    return pad(value, (0, value.shape[-1] % 2, 0, value.shape[-2] % 2))
