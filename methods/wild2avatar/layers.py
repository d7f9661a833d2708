"""What rays show of occluder and background, and all three parts together.

C = C_o + (1 - A_o) [C_h + (1 - A_h) C_b]
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ihbench.methods.wild2avatar.person.human_rays import HumanRays
from ihbench.methods.wild2avatar.scene_network import SceneNetwork
from ihbench.methods.wild2avatar.three_parts import ThreeParts
from ihbench.render.volumes.compositing import ray_weights
from ihbench.render.volumes.density_laws import opacity


@dataclass(frozen=True)
class Layer:
    rgb: Tensor  # [N, 3] premultiplied
    alpha: Tensor  # [N]


def occlusion_layer(
    scene: SceneNetwork, parts: ThreeParts, frame: int, samples: int, generator: torch.Generator | None = None
) -> Layer:
    """What stands before the inner sphere; `samples` on each ray, moved by chance with a generator."""
    return _layer(scene, parts.occlusion, parts, frame, samples, generator)


def background_layer(
    scene: SceneNetwork, parts: ThreeParts, frame: int, samples: int, generator: torch.Generator | None = None
) -> Layer:
    """What lies beyond the outer sphere. Opaque wherever its last sample has any density."""
    return _layer(scene, parts.background, parts, frame, samples, generator)


def _layer(scene, part, parts, frame, samples, generator) -> Layer:
    shares = torch.linspace(0, 1, samples, device=parts.enter.device).expand(len(parts.enter), -1)
    if generator is not None and samples > 1:
        move = torch.rand(len(shares), samples, generator=generator).to(shares.device) - 0.5
        shares = (shares + move / (samples - 1)).clamp(0, 1)
    points, lengths = part(shares)
    density, rgb = scene(points, parts.directions, frame)
    weights, _ = ray_weights(opacity(density, lengths))
    return Layer((weights[..., None] * rgb).sum(1), weights.sum(1))


def together(
    occlusion: Layer | None,
    human: HumanRays,
    background: Tensor,  # [N, 3] or [3]
) -> Tensor:
    """[N, 3] the ray's colour, front to back."""
    rgb = human.rgb + (1 - human.alpha)[:, None] * background
    return rgb if occlusion is None else occlusion.rgb + (1 - occlusion.alpha)[:, None] * rgb
