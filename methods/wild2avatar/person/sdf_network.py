"""The person's shape: a signed distance field in the canonical pose, as a network (Vid2Avatar, networks.py).

    [γ(x) ⊕ pose/π] → layers with softplus (β = 100), the encoding again at `skip` (÷ √2) → distance, features

Weights are normalised and start as a sphere of radius .6 m (geometric initialisation of IDR); the pose's columns
start at 0. Positive outside.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from ihbench.methods.wild2avatar.person.activation import sharp_softplus
from ihbench.nets.positional_encoding import positional_encoding

RADIUS = 0.6  # m
POSE = 69  # values of the joints other than the root


class SdfNetwork(nn.Module):
    def __init__(self, generator: torch.Generator, width: int, depth: int, skip: int, frequencies: int, posed: bool):
        super().__init__()
        self.frequencies, self.skip, self.posed = frequencies, skip, posed
        self.encoded = 3 + 6 * frequencies
        layers = []
        for k in range(depth):
            inputs = (self.encoded + POSE * posed) if k == 0 else width
            outputs = width - self.encoded if 0 < skip == k + 1 < depth else width
            layer = nn.Linear(inputs, outputs)
            nn.init.normal_(layer.weight, 0, math.sqrt(2 / outputs), generator)
            nn.init.zeros_(layer.bias)
            with torch.no_grad():
                if k == 0:
                    layer.weight[:, 3:] = 0
                elif k == skip:
                    layer.weight[:, 3 - self.encoded :] = 0
            layers.append(weight_norm(layer))
        last = nn.Linear(width, 1 + width)
        nn.init.normal_(last.weight, 0, math.sqrt(1 / width), generator)
        nn.init.normal_(last.weight[:1], math.sqrt(math.pi / width), 1e-4, generator)
        nn.init.zeros_(last.bias)
        nn.init.constant_(last.bias[:1], -RADIUS)
        self.layers, self.last = nn.ModuleList(layers), weight_norm(last)

    def forward(
        self,
        points: Tensor,  # [N, 3] m, canonical
        pose: Tensor | None = None,  # [69] rad; None where the shape does not follow the pose
    ) -> tuple[Tensor, Tensor]:
        """Distances [N] m and features [N, width]."""
        encoded = x = positional_encoding(points, self.frequencies, 1.0)
        if self.posed:
            pose = points.new_zeros(POSE) if pose is None else pose / math.pi
            x = torch.cat([x, pose.expand(len(points), -1)], 1)
        for k, layer in enumerate(self.layers):
            if k > 0 and k == self.skip:
                x = torch.cat([x, encoded], 1) / math.sqrt(2)
            x = sharp_softplus(layer(x))
        out = self.last(x)
        return out[:, 0], out[:, 1:]

    def with_gradient(
        self,
        points: Tensor,  # [N, 3] m, canonical
        pose: Tensor | None = None,  # [69] rad
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Distances [N], features [N, width] and gradients [N, 3] of the distance; differentiable where the caller's
        grad mode is on, the gradients as well."""
        learning = torch.is_grad_enabled()
        with torch.enable_grad():
            places = points if points.requires_grad else points.detach().requires_grad_()
            distance, features = self(places, pose)
            (gradient,) = torch.autograd.grad(distance.sum(), places, create_graph=learning, retain_graph=learning)
        if not learning:
            distance, features = distance.detach(), features.detach()
        return distance, features, gradient
