"""The texel network: a learned map, smoothed by convolutions, is decoded texel by texel to offset, scale and colour.

Layers and their initialisation (torch's defaults) are the released ones: modules.py:114-137 and 508-582.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

SMOOTHING_LAYERS, SMOOTHING_SIDE = 3, 5  # convolutions, their side in texels
SHARED_LAYERS = 4  # before input and hidden are joined


@dataclass(frozen=True)
class TexelOutputs:
    """What M texels are decoded to, before the avatar gives it units."""

    offset: Tensor  # [M, 3]
    scale: Tensor  # [M]
    color: Tensor  # [M, 3]


def smoothing(channels: int) -> nn.Sequential:
    """Convolutions [B, C, S, S] -> [B, C, S, S] without bias or activation: one linear map that reaches 6 texels."""
    return nn.Sequential(
        *(
            nn.Conv2d(channels, channels, SMOOTHING_SIDE, padding=SMOOTHING_SIDE // 2, bias=False)
            for _ in range(SMOOTHING_LAYERS)
        )
    )


class TexelNorm(nn.BatchNorm1d):
    """Batch norm whose running statistics move in steps of a fit and when they are measured, not when a picture is
    looked at."""

    measured = False

    def forward(self, input: Tensor) -> Tensor:
        if self.training and not (torch.is_grad_enabled() or self.measured):
            return nn.functional.batch_norm(input, None, None, self.weight, self.bias, training=True, eps=self.eps)
        return super().forward(input)


def _layer(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, outputs), TexelNorm(outputs))


class TexelDecoder(nn.Module):
    """Every hidden layer is linear, batch norm, softplus; batch statistics are over all texels given at once."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.shared = nn.ModuleList(_layer(inputs if k == 0 else width, width) for k in range(SHARED_LAYERS))
        self.joined = _layer(inputs + width, width)
        self.heads = nn.ModuleDict(
            {
                name: nn.Sequential(_layer(width, width), _layer(width, width), nn.Linear(width, outputs))
                for name, outputs in (("offset", 3), ("scale", 1), ("color", 3))
            }
        )

    def forward(self, texels: Tensor) -> TexelOutputs:  # [M, inputs]
        hidden = texels
        for layer in self.shared:
            hidden = softplus(layer(hidden))
        hidden = softplus(self.joined(torch.cat([texels, hidden], 1)))
        offset, scale, color = (self._head(name, hidden) for name in ("offset", "scale", "color"))
        return TexelOutputs(offset, torch.sigmoid(scale)[:, 0], torch.sigmoid(color))

    def _head(self, name: str, hidden: Tensor) -> Tensor:  # [M, width] -> [M, outputs]
        *layers, last = self.heads[name]  # pyright: ignore[reportGeneralTypeIssues]
        for layer in layers:
            hidden = softplus(layer(hidden))
        return last(hidden)


@torch.no_grad()
def measure_statistics(decoder: nn.Module, batches: Iterable[Tensor]) -> None:
    """Set the running statistics of all batch norms to their means over these inputs [M, inputs] of the decoder."""
    norms = [module for module in decoder.modules() if isinstance(module, TexelNorm)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum, norm.measured = None, True  # None: a plain mean
    for batch in batches:
        decoder(batch)
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum, norm.measured = momentum, False
