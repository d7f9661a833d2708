"""Crops as tensors, and the noise that all of them share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.part_map import part_colours


@dataclass(frozen=True)
class DiffusionBatch:
    """Crops of one width."""

    pixels: Tensor  # [B, 3, H, W] in [-1, 1]
    unknown: Tensor  # [B, 1, H, W] 1 where the truth is not known
    person: Tensor  # [B, 1, H, W] 1 where a pixel is known to show the person
    parts: Tensor  # [B, 3, H, W] part map in [0, 1]
    seen: Tensor  # [B, 4, H, W] RGB in [0, 1] of surface that other frames show, and 1 there
    fill: Tensor | None = None  # [B, 3, H, W] in [-1, 1] what painting begins with in unknown pixels

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def guide(self) -> Tensor:
        """[B, 7, H, W] what guides the ControlNet: the part map, then what other frames show."""
        return guide_of(self.parts, self.seen)


def guide_of(parts: Tensor, seen: Tensor) -> Tensor:
    """[B, 7, H, W] of a part map [B, 3, H, W] and of what other frames show [B, 4, H, W]."""
    return torch.cat([parts, seen], 1)


def batch_of(views: list[CropView], device: torch.device) -> DiffusionBatch:
    """Views of equal crop size as tensors. Where each has a `fill` the batch has."""
    images = np.stack([view.image for view in views])
    unknown = np.stack([view.unknown for view in views])[:, None]
    colours = np.stack([part_colours(view.parts) if view.guide is None else view.guide for view in views])
    fills = [view.fill for view in views if view.fill is not None]
    nothing = np.zeros((*views[0].parts.shape, 4), np.uint8)
    seen = np.stack([nothing if view.elsewhere is None else view.elsewhere for view in views])
    return DiffusionBatch(
        pixels=signed(torch.from_numpy(images).to(device)),
        unknown=torch.from_numpy(unknown).to(device).float(),
        person=torch.from_numpy(np.stack([view.person for view in views])[:, None]).to(device).float(),
        parts=torch.from_numpy(colours).to(device).movedim(-1, 1).float() / 255,
        seen=torch.from_numpy(seen).to(device).movedim(-1, 1).float() / 255,
        fill=signed(torch.from_numpy(np.stack(fills)).to(device)) if len(fills) == len(views) else None,
    )


def signed(images: Tensor) -> Tensor:
    """[B, H, W, 3] of 0 to 255 -> [B, 3, H, W] in [-1, 1]."""
    return images.movedim(-1, 1).float() / 127.5 - 1


def by_width(views: list[CropView]) -> dict[int, list[int]]:
    """Crop width in px -> numbers of the views that have it, in order."""
    out: dict[int, list[int]] = {}
    for k, view in enumerate(views):
        out.setdefault(view.crop.width, []).append(k)
    return dict(sorted(out.items()))


def shared_noise(backbone: Backbone, seed: int, width: int, height: int | None = None) -> Tensor:
    """[C, h, w] start of every frame's sampling: one square field for the whole sequence, of which narrower crops get
    the middle (temporal stability), and lower ones, in px of the image, its first rows."""
    side = backbone.size // backbone.codec.block
    generator = torch.Generator().manual_seed(seed)
    field = torch.randn(backbone.codec.channels, side, side, generator=generator)
    own = width // backbone.codec.block
    left = (side - own) // 2
    rows = side if height is None else height // backbone.codec.block
    return field[:, :rows, left : left + own].to(backbone.device)
