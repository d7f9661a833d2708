"""Linear layers with LeakyReLU between them, in PyTorch's own initialisation: what all networks here are."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional as F


class LeakyLayers(nn.Module):
    """Slope .01, none after the last layer. Who computes the first layer apart goes on with `after_first`."""

    def __init__(self, sizes: Sequence[int]):
        """Widths from the input to the output, at least three."""
        super().__init__()
        layers = [nn.Linear(inputs, outputs) for inputs, outputs in pairwise(sizes)]
        self.first, self.last = layers[0], layers[-1]
        self.hidden = nn.ModuleList(layers[1:-1])

    def forward(self, x: Tensor) -> Tensor:
        return self.after_first(self.first(x))

    def after_first(
        self,
        x: Tensor,  # [N, first width] what the first layer gives; it is overwritten
    ) -> Tensor:
        x = F.leaky_relu(x, inplace=True)
        for layer in self.hidden:
            x = F.leaky_relu(layer(x), inplace=True)
        return self.last(x)
