"""The terms of the loss. Certain by name: colours, eikonal, decomposition (Vid2Avatar's own), occlusion and
completeness. Formulas and weights of the last two, and the term on known background, are inferred; METHOD.md."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ihbench.methods.wild2avatar.config import Wild2AvatarConfig
from ihbench.methods.wild2avatar.target import Target

LEAST = 1e-3  # inside logarithms
FULL = 200  # epochs: what the schedules of the released code count to


@dataclass(frozen=True)
class Rays:
    """What was rendered of a view's rays."""

    pixels: Tensor  # [N] int64
    colours: Tensor  # [N, 3] of all layers together
    human: Tensor  # [N] A_h
    occlusion: Tensor | None  # [N] A_o; None without that layer
    beside: Tensor  # [N] bool: misses the body, and the surface of the last refresh by more than .05 m


def mean_of(values: Tensor, chosen: Tensor) -> Tensor:
    """Mean over the chosen; 0, and not NaN, where there are none."""
    return torch.where(chosen, values, 0.0).sum() / chosen.sum().clamp(min=1)


def binary_entropy(alpha: Tensor) -> Tensor:
    """[] Vid2Avatar's: 0 where alphas are 0 or 1."""
    inside = alpha.clamp(LEAST, 1 - LEAST)
    return -2 * (inside * inside.log() + (1 - inside) * (1 - inside).log()).mean()


def ray_losses(rays: Rays, target: Target, config: Wild2AvatarConfig, epoch: float) -> dict[str, Tensor]:
    """The weighted terms by name. `epoch` counts to `FULL`; see `config.ramp_epochs`."""
    at, alpha = rays.pixels, rays.human
    person, unknown, body, empty = target.person[at], target.unknown[at], target.body[at], target.background[at]
    if config.interval == "body":
        # the other rays are empty by rule; counted, they leave nothing of this term at the silhouette's rim
        empty = empty & (target.near[at] < target.far[at])
    # not by a product alone: what is unknown may be NaN
    known = target.coloured[at]
    wanted = torch.where(known[:, None], target.colours[at], 0.0)
    terms = {
        "colours": config.colours * mean_of((rays.colours - wanted).abs().mean(1), known),
        "entropy": config.entropy * binary_entropy(alpha),
        "beside": config.beside * (1 + epoch**2 / 40) * mean_of(alpha, rays.beside),
        "inside": config.inside * max(1 - epoch / FULL, 0) * mean_of(1 - alpha, body),
        "completeness": config.completeness * mean_of(-(alpha + LEAST).log(), body | person),
        "background": config.background_alpha * mean_of(-(1 - alpha + LEAST).log(), empty),
        "around": config.around * mean_of(alpha, unknown & ~body),
    }
    if rays.occlusion is not None:
        layer = rays.occlusion
        hidden = unknown & body
        shown = mean_of(-(1 - layer + LEAST).log(), person)
        explained = mean_of(-(layer + LEAST).log(), hidden)
        terms["occlusion"] = config.occlusion_loss * (shown + explained)
        terms["sparsity"] = config.sparsity * mean_of(layer, ~person & ~hidden)
    return {name: term for name, term in terms.items() if term.requires_grad or not torch.is_grad_enabled()}


def eikonal(
    gradient: Tensor,  # [N, 3]
) -> Tensor:
    return (gradient.norm(dim=1) - 1).square().mean()
