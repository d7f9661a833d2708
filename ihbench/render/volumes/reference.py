"""The volume renderer's twin: float64, ray by ray, every sample evaluated, formulas as they are written; and the
plain dense renderer.

α_s = (1 - exp(-σ_s δ_s)) f_s, T_s = Π_{u<s} (1 - α_u + 1e-10), colour = Σ T_s α_s c_s + (1 - Σ T_s α_s) background
(HumanNeRF, core/nets/human_nerf/network.py:176-201).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ihbench.render.volumes.compositing import CLEAR, Composited, alpha_composite
from ihbench.render.volumes.fast import sample_opacity
from ihbench.render.volumes.field import Field
from ihbench.render.volumes.rays import Rays


def reference_rays(
    field: Field,  # in float64
    rays: Rays,  # float64
    depths: Tensor,  # [N, S] m
    lengths: Tensor,  # [N, S] m
) -> tuple[Tensor, Tensor, Tensor]:
    """rgb [N, 3] premultiplied, alpha [N], depth [N] (weights times depths). Differentiable."""
    colors, alphas, behind = [], [], []
    for n in range(len(rays)):
        values = field.values(rays.origins[n] + depths[n, :, None] * rays.directions[n])
        through, color, alpha, far = (depths.new_ones(()), depths.new_zeros(3), depths.new_zeros(()),
                                      depths.new_zeros(()))  # fmt: skip
        for s in range(depths.shape[1]):
            own = 1 - torch.exp(-values.density[s] * lengths[n, s])
            if values.likelihood is not None:
                own = own * values.likelihood[s]
            weight = through * own
            color, alpha, far = color + weight * values.rgb[s], alpha + weight, far + weight * depths[n, s]
            through = through * (1 - own + CLEAR)
        colors.append(color)
        alphas.append(alpha)
        behind.append(far)
    return torch.stack(colors), torch.stack(alphas), torch.stack(behind)


def dense_rays(
    field: Field,
    rays: Rays,
    depths: Tensor,  # [N, S] m
    lengths: Tensor,  # [N, S] m
) -> Composited:
    """The renderer that everybody writes first: every sample of every ray in one batch, in the rays' own float type.
    What the fast one is timed against."""
    values = field.values(rays.points(depths).flatten(0, 1))
    alpha = sample_opacity(values, lengths.flatten()).view_as(depths)
    return alpha_composite(alpha, values.rgb.view(*depths.shape, 3), depths)
