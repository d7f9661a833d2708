"""The networks of HumanNeRF: colour and density of a place in the T-pose, and where a pose moves it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ihbench.nets.motion_weights import started
from ihbench.nets.positional_encoding import positional_encoding, windowed_encoding

LAST_LAYER = 1e-5  # m, bound of the first weights of what moves places: a fit begins with all but no offset


class CanonicalNetwork(nn.Module):
    """Place in the T-pose → colour in [0, 1] and what the density law makes a density of; no direction of view.

    Encoding, hidden layers with ReLU, the encoding once more before the third last of them, four outputs (HumanNeRF,
    canonical_mlps/mlp_rgb_sigma.py: 8 × 256 and ten octaves from 1 rad/m).
    """

    def __init__(
        self,
        generator: torch.Generator,
        depth: int = 8,
        width: int = 256,
        bands: int = 10,
        first_density: float = 0.0,  # first bias of the raw density
    ):
        super().__init__()
        encoded = 3 + 6 * bands
        self.bands, self.again = bands, depth - 3
        inputs = [encoded, *(width + (encoded if k == self.again and k else 0) for k in range(1, depth))]
        self.hidden = nn.ModuleList(_layer(n, width, math.sqrt(2), generator) for n in inputs)
        self.last = _layer(width, 4, 1.0, generator)
        nn.init.constant_(self.last.bias[3], first_density)

    def forward(self, places: Tensor) -> tuple[Tensor, Tensor]:  # [M, 3] m
        """rgb [M, 3] and raw density [M]."""
        encoded = positional_encoding(places, self.bands, first=1.0)
        out = self.last(_through(self.hidden, encoded, encoded, self.again))
        return out[:, :3].sigmoid(), out[:, 3]


class NonRigidNetwork(nn.Module):
    """Pose and place in the T-pose → offset in m (HumanNeRF, non_rigid_motion_mlps/mlp_offset.py: 6 × 128, six
    octaves without the place itself, which come in again before the second last layer).

    While no octave is on, everything that goes in is 0, so are all hidden values, and the offset is the last bias.
    """

    def __init__(
        self, generator: torch.Generator, depth: int = 6, width: int = 128, bands: int = 6, joints: int = 23
    ):
        super().__init__()
        encoded, pose = 6 * bands, 3 * joints
        self.pose, self.again = pose, depth - 2
        inputs = [pose + encoded, *(width + (encoded if k == self.again and k else 0) for k in range(1, depth))]
        self.hidden = nn.ModuleList(_layer(n, width, math.sqrt(2), generator) for n in inputs)
        self.last = nn.Linear(width, 3)
        nn.init.uniform_(self.last.weight, -LAST_LAYER, LAST_LAYER, generator)
        nn.init.zeros_(self.last.bias)

    def forward(
        self,
        places: Tensor,  # [M, 3] m
        pose: Tensor,  # [69] rad
        window: Tensor,  # [bands] of the octaves
    ) -> Tensor:
        """[M, 3] m."""
        if not window.any():
            return self.last.bias.expand(len(places), 3)
        encoded = windowed_encoding(places, window)
        first = self.hidden[0]
        assert isinstance(first, nn.Linear)
        # the pose is the same for all places: what the first layer makes of it goes into its bias
        of_pose, of_place = first.weight.split([self.pose, encoded.shape[1]], 1)
        x = F.linear(encoded, of_place, first.bias + of_pose @ pose).relu()
        return self.last(_through(self.hidden[1:], x, encoded, self.again - 1))


def _layer(inputs: int, outputs: int, gain: float, generator: torch.Generator) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    started(layer.weight, inputs, outputs, gain, generator)
    nn.init.zeros_(layer.bias)
    return layer


def _through(layers: nn.ModuleList | Sequence, x: Tensor, encoded: Tensor, again: int) -> Tensor:
    """Layers with ReLU; the encoding, in front, joins what goes into number `again`, unless that is the first."""
    for k, layer in enumerate(layers):
        assert isinstance(layer, nn.Linear)
        if k == again and layer.in_features != x.shape[1]:
            of_encoded, of_hidden = layer.weight.split([encoded.shape[1], x.shape[1]], 1)
            x = (F.linear(encoded, of_encoded, layer.bias) + F.linear(x, of_hidden)).relu()
        else:
            x = layer(x).relu()
    return x
