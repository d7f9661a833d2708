"""The Kullback-Leibler divergence between Gaussians given by scales and quaternions, without any matrix inverted.

The textbook form ½ [tr(Σ1⁻¹Σ0) + Δᵀ Σ1⁻¹ Δ + ln |Σ1|/|Σ0| - 3] takes large numbers from each other where Gaussians
are thin or alike. With R = R1ᵀ R0, whose squared entries sum to one over rows and over columns, the same is

    ½ Σ_jk R_jk² φ(ln(s0_k² / s1_j²)) + ½ |diag(1/s1) R1ᵀ Δ|²,        φ(x) = eˣ - 1 - x >= 0,

a sum of terms none of which is negative: exactly 0 for equal Gaussians, and good to rounding for needles.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ihbench.fit.gaussians.skinned_covariance import quaternion_to_matrix

SERIES_BELOW = 0.1  # there eˣ - 1 - x would lose digits
LARGEST_EXPONENT = 300.0  # keeps squares finite, so that nothing becomes 0 times infinity


def gaussian_divergence(
    means: Tensor,  # [N, 3] of N0
    log_scales: Tensor,  # [N, 3] ln of standard deviations
    quaternions: Tensor,  # [N, 4] w first, of any length
    other_means: Tensor,  # [N, 3] of N1
    other_log_scales: Tensor,  # [N, 3]
    other_quaternions: Tensor,  # [N, 4]
) -> Tensor:
    """[N] float64: KL(N0 ‖ N1) in nats, row by row."""
    means, log_scales, quaternions, other_means, other_log_scales, other_quaternions = (
        each.detach().double()
        for each in (means, log_scales, quaternions, other_means, other_log_scales, other_quaternions)
    )
    squared = quaternion_to_matrix(_relative(other_quaternions, quaternions)).square()  # [N, 3 of N1, 3 of N0]
    ratio = 2 * (log_scales[:, None, :] - other_log_scales[:, :, None])
    spread = (squared * _phi(ratio)).sum((1, 2))
    apart = (quaternion_to_matrix(other_quaternions).mT @ (means - other_means)[:, :, None])[:, :, 0]
    scaled = apart * (-other_log_scales).clamp(max=LARGEST_EXPONENT).exp()
    return 0.5 * (spread + scaled.square().sum(1))


def _relative(first: Tensor, second: Tensor) -> Tensor:
    """[N, 4]: conj(first) second; for equal quaternions exactly a multiple of (1, 0, 0, 0)."""
    w, x, y, z = first.unbind(-1)
    a, b, c, d = second.unbind(-1)
    parts = (
        w * a + x * b + y * c + z * d,
        (w * b - x * a) + (z * c - y * d),
        (w * c - y * a) + (x * d - z * b),
        (w * d - z * a) + (y * b - x * c),
    )
    return torch.stack(parts, -1)


def _phi(x: Tensor) -> Tensor:
    """eˣ - 1 - x."""
    small = x.abs() < SERIES_BELOW
    near = torch.where(small, x, torch.zeros_like(x))
    series = torch.zeros_like(x)
    for power in range(9, 1, -1):
        series = series * near + 1 / math.factorial(power)
    return torch.where(small, series * near * near, torch.expm1(x.clamp(max=2 * LARGEST_EXPONENT)) - x)
