"""What is added to the logarithms of skinning weights at a place, from a network (GauHuman)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ihbench.nets.positional_encoding import positional_encoding


class WeightOffsets(nn.Module):
    """Canonical position → 24 offsets: encoding, three hidden layers, the encoding once more, a fourth, the output.

    As released by GauHuman (nets/mlp_delta_weight_lbs.py): ten octaves from 1 rad/m, width 128, 68,888 parameters,
    PyTorch's own initialisation with no layer at zero: a fit begins with weights off by about 0.1 in their logarithm.
    """

    def __init__(self, seed: int, width: int = 128, frequencies: int = 10, joints: int = 24):
        super().__init__()
        encoded = 3 + 6 * frequencies
        self.frequencies = frequencies
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.hidden = nn.ModuleList(nn.Linear(n, width) for n in (encoded, width, width))
            self.skip = nn.Linear(encoded + width, width)
            self.last = nn.Linear(width, joints)

    def forward(
        self,
        points: Tensor,  # [N, 3] m, canonical
    ) -> Tensor:
        """[N, 24] to be added to ln w. No gradient goes to the points."""
        encoded = positional_encoding(points.detach(), self.frequencies, first=1.0)
        x = encoded
        for layer in self.hidden:
            x = layer(x).relu_()
        # the layer over both, without a copy of what is put side by side
        of_encoded, of_hidden = self.skip.weight.split([encoded.shape[1], x.shape[1]], 1)
        x = (F.linear(encoded, of_encoded, self.skip.bias) + F.linear(x, of_hidden)).relu_()
        return self.last(x)
