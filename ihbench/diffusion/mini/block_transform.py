"""A fixed autoencoder for small images: luma and chroma, block DCT, the lowest frequencies, standardised.

Costs nothing to train, and is exact but for the frequencies it drops (4:2:0-like chroma). Each 4×4 block of pixels
becomes one latent pixel with `luma + 2 · chroma` channels. Both steps are orthonormal, so a squared error in latents,
times `scale²`, is the squared error of the pixels.
"""

from __future__ import annotations

import numpy as np
import torch
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.modeling_utils import ModelMixin
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d


class BlockTransform(ModelMixin, ConfigMixin):
    """`encode` and `decode` between images [B, 3, H, W] in [-1, 1] and latents [B, C, H / block, W / block]."""

    mean: Tensor
    scale: Tensor
    kernel: Tensor

    @register_to_config
    def __init__(self, block: int = 4, luma: int = 16, chroma: int = 4):
        super().__init__()
        kernel = _kernel(block, luma, chroma)
        self.register_buffer("kernel", torch.from_numpy(kernel), persistent=False)
        self.register_buffer("mean", torch.zeros(len(kernel)))
        self.register_buffer("scale", torch.ones(len(kernel)))

    @property
    def channels(self) -> int:
        return len(self.kernel)

    @property
    def block(self) -> int:
        return self.config["block"]

    @torch.no_grad()
    def standardise(self, images: Tensor, where: Tensor) -> None:
        """Set mean and scale to the statistics of the blocks of `images` [B, 3, H, W] at which `where` [B, 1, H, W]
        has a True pixel."""
        raw = conv2d(images, self.kernel, stride=self.block)
        chosen = torch.nn.functional.max_pool2d(where.float(), self.block)[:, 0] > 0
        values = raw.movedim(1, -1)[chosen]
        self.mean.copy_(values.mean(0))
        self.scale.copy_(values.std(0).clamp(min=1e-3))

    def encode(self, images: Tensor) -> Tensor:
        raw = conv2d(images.to(self.kernel.dtype), self.kernel, stride=self.block)
        return (raw - self.mean[:, None, None]) / self.scale[:, None, None]

    def decode(self, latents: Tensor) -> Tensor:
        raw = latents.to(self.kernel.dtype) * self.scale[:, None, None] + self.mean[:, None, None]
        return conv_transpose2d(raw, self.kernel, stride=self.block)


def _kernel(block: int, luma: int, chroma: int) -> np.ndarray:
    """[C, 3, block, block] orthonormal rows: an opponent colour times a cosine pattern, lowest frequencies first."""
    if not 1 <= luma <= block**2 or not 1 <= chroma <= block**2:
        raise ValueError(f"block transform: expected 1 to {block**2} coefficients, got {luma} luma, {chroma} chroma")
    k = np.arange(block)
    dct = np.sqrt(2 / block) * np.cos(np.pi * k[:, None] * (k + 0.5) / block)
    dct[0] /= np.sqrt(2)
    order = sorted(((i, j) for i in k for j in k), key=lambda ij: (ij[0] + ij[1], max(ij), ij[0]))
    patterns = np.stack([np.outer(dct[i], dct[j]) for i, j in order])
    colours = np.array([[1, 1, 1], [1, 0, -1], [1, -2, 1]]) / np.sqrt([[3], [2], [6]])
    rows = [
        colour[:, None, None] * pattern
        for colour, count in zip(colours, (luma, chroma, chroma), strict=True)
        for pattern in patterns[:count]
    ]
    return np.stack(rows).astype(np.float32)
