"""The Gaussian feature MLP: from a Gaussian's place and feature to what is added to its attributes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from ihbench.methods.occgaussian.config import DecoderConfig
from ihbench.nets.positional_encoding import positional_encoding

OUTPUTS = 7  # colour, opacity logit, log scales


@dataclass(frozen=True)
class Added:
    colours: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    log_scales: Tensor  # [N, 3]


class FeatureDecoder(nn.Module):
    """Encoded place ⊕ feature ⊕ whether it was queried ⊕ mean distance of those asked → hidden layers with ReLU. The
    last layer's first weights are all but 0, so that a fit begins with nothing added."""

    def __init__(self, config: DecoderConfig, feature: int, seed: int):
        super().__init__()
        self.octaves = config.octaves
        inputs = 3 + 6 * config.octaves + feature + 2
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            sizes = pairwise([inputs, *[config.width] * config.depth])
            self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in sizes)
            self.last = nn.Linear(config.width, OUTPUTS)
            nn.init.uniform_(self.last.weight, -config.last, config.last)
            nn.init.zeros_(self.last.bias)

    def forward(
        self,
        means: Tensor,  # [N, 3] m, canonical; no gradient goes to them
        features: Tensor,  # [N, size]
        queried: Tensor,  # [N] 1 for an answer to a query, 0 for its own feature
        distance: Tensor,  # [N] m, 0 for its own
    ) -> Added:
        encoded = positional_encoding(means.detach(), self.octaves, first=1.0)
        x = torch.cat([encoded, features, queried[:, None], distance[:, None]], 1)
        for layer in self.hidden:
            x = layer(x).relu()
        out = self.last(x)
        return Added(out[:, :3], out[:, 3], out[:, 4:])
