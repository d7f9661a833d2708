"""Gaussians from the world to one image, in torch, float64: what every back end composites.

Positions and covariances are float64 whatever the inputs are: the order of depth is then the same in every back end,
and the determinant of a needle's footprint keeps its digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.render.splats import Ellipses, Preset, Splats


def intrinsics(camera: Camera) -> np.ndarray:
    """[3, 3] K with what lies under its diagonal taken as 0."""
    K = np.triu(camera.K)
    K[2, 2] = 1.0
    return K


def clamped_directions(camera: Camera, preset: Preset) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest x / z, y / z in the image and `preset.clamp` of half its size around it."""
    K, size = intrinsics(camera), np.array([camera.width, camera.height])
    focal = np.diag(K)[:2]
    beyond = preset.clamp * size / (2 * focal)
    return -K[:2, 2] / focal - beyond, (size - K[:2, 2]) / focal + beyond


def depths(means: Tensor, camera: Camera) -> Tensor:
    """[N] m, float64, along the camera's axis."""
    return means.double() @ _on(camera.R[2], means) + float(camera.t[2])


def covariances_of(scales: Tensor, quaternions: Tensor | None) -> Tensor:
    """Standard deviations [N, 3] m along the axes that quaternions [N, 4] (w, x, y, z; of any length) turn to, or
    [N] m of spheres -> world covariances [N, 3, 3] m², float64."""
    scales = scales.double()
    if quaternions is None:
        return torch.diag_embed(scales.square()[:, None].expand(-1, 3))
    w, x, y, z = torch.nn.functional.normalize(quaternions.double(), dim=-1).unbind(-1)
    axes = torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ],
        -1,
    ).reshape(-1, 3, 3)  # fmt: skip
    spread = axes * scales[:, None]
    return spread @ spread.transpose(1, 2)


def project_circles(means: Tensor, scales: Tensor, colors: Tensor, camera: Camera, preset: Preset) -> Splats:
    """Opaque isotropic Gaussians of means [N, 3] m, scales [N] m, colors [N, C]; undrawable ones and all."""
    K = intrinsics(camera)
    p = torch.addmm(_on(K @ camera.t, means), means.double(), _on((K @ camera.R).T, means))
    xy, z = p.split((2, 1), 1)
    variance = (scales.double()[:, None] / z).square() * (K[0, 0] * K[1, 1]) + preset.low_pass
    return Splats(xy / z, variance[:, 0], z.detach()[:, 0].float(), colors)


def project_ellipses(
    means: Tensor, covariances: Tensor, opacities: Tensor, colors: Tensor, camera: Camera, preset: Preset
) -> Ellipses:
    """Gaussians of means [N, 3] m and covariances [N, 3, 3] m², by the projection's linear part at their centres
    (Zwicker et al. 2002); undrawable ones and all.

    With the rows A_i of K R, the projection u_i and the third row r of R, the derivative of u_i along the world is
    (A_i - u_i r) / z. Far beside the image that overstates the footprint, so u_i is taken from a direction that is
    clamped to the image and `preset.clamp` of half its size around it, as gsplat does.
    """
    K = intrinsics(camera)
    p = torch.addmm(_on(camera.t, means), means.double(), _on(camera.R.T, means))
    z = p[:, 2]
    direction = p[:, :2] / z[:, None]
    to_pixels, offset = _on(K[:2, :2].T, means), _on(K[:2, 2], means)
    low, high = (_on(x, means) for x in clamped_directions(camera, preset))
    clamped = torch.addmm(offset, torch.minimum(torch.maximum(direction, low), high), to_pixels)
    R = _on(camera.R, means)
    derivative = (_on(K[:2, :2], means) @ R[:2] + offset[:, None] * R[2] - clamped[:, :, None] * R[2]) / z[
        :, None, None
    ]
    footprint = derivative @ covariances.double() @ derivative.transpose(1, 2)
    covariance = torch.stack(
        [
            footprint[:, 0, 0] + preset.low_pass,
            (footprint[:, 0, 1] + footprint[:, 1, 0]) / 2,
            footprint[:, 1, 1] + preset.low_pass,
        ],
        1,
    )
    xy = torch.addmm(offset, direction, to_pixels)
    return Ellipses(xy, covariance, opacities, z.detach().float(), colors)


def drawable_only(
    project: Callable[..., Splats | Ellipses], inputs: tuple[Tensor, ...], preset: Preset
) -> tuple[Splats | Ellipses, Tensor | None]:
    """project(*inputs) of those that can be drawn, and their indices; None where that is all."""
    splats = project(*inputs)
    if _all_drawable(splats, preset):
        return splats, None
    # projected anew without the bad ones: masking afterwards would still send NaN through the backward pass
    keep = _drawable(splats, preset).nonzero()[:, 0]
    return project(*(x[keep] for x in inputs)), keep


def _on(array: np.ndarray, means: Tensor) -> Tensor:
    return torch.from_numpy(np.array(array, np.float64)).to(means.device)


def _values(splats: Splats | Ellipses) -> list[Tensor]:
    """What must be finite in float32."""
    if isinstance(splats, Splats):
        return [splats.xy, splats.variance, splats.colors]
    return [splats.xy, splats.covariance, splats.opacity, splats.colors]


@torch.no_grad()
def _drawable(splats: Splats | Ellipses, preset: Preset) -> Tensor:
    """[N] bool: in front of the near plane, every value finite in float32, and the footprint an ellipse."""
    good = (splats.depth > preset.near) & splats.depth.isfinite()
    for x in _values(splats):
        good &= x.float().isfinite().reshape(len(x), -1).all(1)
    if isinstance(splats, Ellipses):
        good &= _determinant(splats.covariance) > 0
    return good


@torch.no_grad()
def _all_drawable(splats: Splats | Ellipses, preset: Preset) -> bool:
    """Whether `_drawable` holds for all, from a few sums; False may also mean that a sum of finite values overflowed.

    A fast way out of the common case, in which nothing is wrong.
    """
    if len(splats.depth) == 0:
        return True
    total = splats.depth.sum()
    for x in _values(splats):
        total = total + x.float().sum()
    good = total.isfinite() & (splats.depth.min() > preset.near)
    if isinstance(splats, Ellipses):
        good &= _determinant(splats.covariance).min() > 0
    return bool(good)


def _determinant(covariance: Tensor) -> Tensor:
    xx, xy, yy = covariance.unbind(1)
    return xx * yy - xy * xy


@torch.no_grad()
def radii(ellipses: Ellipses, height: int, width: int, preset: Preset) -> Tensor:
    """[M] px: how far along its longer axis an alpha reaches `alpha_min`; 0 where that is at no pixel centre's row or
    column of the image."""
    xx, xy, yy = ellipses.covariance.unbind(1)
    largest = (xx + yy) / 2 + (((xx - yy) / 2).square() + xy.square()).sqrt()
    cut = 2 * (ellipses.opacity.double() / preset.alpha_min).clamp(min=1).log()
    first = torch.full((2,), 0.5, dtype=torch.float64, device=xx.device)
    last = torch.tensor([width - 0.5, height - 0.5], dtype=torch.float64, device=xx.device)
    beside = ellipses.xy - ellipses.xy.clamp(first, last)
    reaches = (beside.square() <= torch.stack([xx, yy], 1) * cut[:, None]).all(1)
    return torch.where(reaches & (ellipses.opacity >= preset.alpha_min), (cut * largest).sqrt(), 0.0)


def log_cut(preset: Preset) -> float:
    """Squared distance over variance at which an opaque footprint ends."""
    return -2 * math.log(preset.alpha_min)
