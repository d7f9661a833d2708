"""Isotropic Gaussian splatting: one function, three back ends that agree (float64 torch, numba on the CPU, gsplat).

The Gaussians are the paper's: a centre, one scale, a colour, opacity 1. What every back end draws is defined here:

- Projection: `p = R x + t`; depth `z = p_z`; centre `u = K p / z` with pixel centres at +0.5; footprint variance
  `(f s / z)^2 + LOW_PASS` px² with `f = sqrt(fx fy)`.
- At distance d px from its centre a splat has alpha `min(ALPHA_MAX, exp(-d² / (2 variance)))`; below `ALPHA_MIN` it
  is dropped. The constants are those of 3D Gaussian splatting (Kerbl et al. 2023, released code) as `gsplat` has
  them.
- Splats are composited front to back in the order of their depth, compared as float32; equal depths keep the order of
  their index. What is left of the transmittance shows the background.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.errors import MissingPrerequisite
from ihbench.render.splats import LOW_PASS, NEAR, Splats

BACKENDS = ("auto", "reference", "numba", "gsplat")


def render_gaussians(
    means: Tensor,  # [N, 3] m, world
    scales: Tensor,  # [N] m, standard deviation
    colors: Tensor,  # [N, C]
    camera: Camera,
    background: Sequence[float] | Tensor = (1.0, 1.0, 1.0),  # [C], or [1] for all channels
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Draw opaque isotropic Gaussians -> rgb [H, W, C], alpha [H, W], in the dtype and on the device of `means`.

    Differentiable in `means`, `scales` and `colors`; under `torch.no_grad()` nothing is kept for a backward pass. The
    background is a constant: no gradient flows to it. `scales` enter squared.

    `backend`: "reference" is the float64 twin (slow, any device), "numba" the CPU, "gsplat" CUDA (the `cuda` extra),
    "auto" gsplat for CUDA tensors and numba otherwise (the reference where numba is not installed).

    A Gaussian with a value that is NaN or infinite, or that leaves float32 when projected, is not drawn and gets a
    zero gradient: one bad Gaussian must not blacken the picture. Whoever trains checks the parameters for finiteness.

    Raises ValueError for a camera with lens distortion (undistort the image, use `camera.undistorted()`), for wrong
    shapes, for negative scales and 8-bit colours, and for an unknown back end; `MissingPrerequisite`, an ImportError
    and a RuntimeError, where the asked-for back end cannot run here or draws otherwise than the others.
    """
    background = _check(means, scales, colors, camera, background)
    backend = _choose_backend(backend, means.device)
    splats = project_gaussians(means, scales, colors, camera)
    if backend == "numba":
        from ihbench.render.splat_numba import composite
    elif backend == "gsplat":
        from ihbench.render.splat_gsplat import composite
    else:
        from ihbench.render.splat_reference import composite
    rgb, alpha = composite(splats, camera.height, camera.width, background)
    return rgb.to(means.dtype), alpha.to(means.dtype)


def warm_up(device: str = "cpu") -> None:
    """Draw two Gaussians forward and backward, so that the back end's compilation is not charged to whoever draws
    first. Takes many seconds the first time after installation, milliseconds later (compiled code is kept)."""
    camera = Camera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(3), np.zeros(3), 8, 8)
    means = torch.tensor([[0.0, 0, 1], [0.1, 0, 2]], device=device, requires_grad=True)
    scales = torch.full((2,), 0.1, device=device, requires_grad=True)
    colors = torch.full((2, 3), 0.5, device=device, requires_grad=True)
    rgb, alpha = render_gaussians(means, scales, colors, camera)
    (rgb.sum() + alpha.sum()).backward()


def project_gaussians(means: Tensor, scales: Tensor, colors: Tensor, camera: Camera) -> Splats:
    """World Gaussians -> splats of this camera, without those behind the near plane and the non-finite ones.

    Means [N, 3] m, scales [N] m, colors [N, C]. Positions are float64 whatever the inputs are, so that the order of
    depth is the same in every back end.
    """
    splats = _project(means, scales, colors, camera)
    if not _all_drawable(splats):
        # projected anew without the bad ones: masking afterwards would still send NaN through the backward pass
        keep = _drawable(splats).nonzero()[:, 0]
        splats = _project(means[keep], scales[keep], colors[keep], camera)
    return splats


def _project(means: Tensor, scales: Tensor, colors: Tensor, camera: Camera) -> Splats:
    K = np.triu(camera.K)
    K[2, 2] = 1.0
    to_pixels = torch.from_numpy((K @ camera.R).T).to(means.device)
    p = torch.addmm(torch.from_numpy(K @ camera.t).to(means.device), means.double(), to_pixels)
    xy, z = p.split((2, 1), 1)
    variance = (scales.double()[:, None] / z).square() * (K[0, 0] * K[1, 1]) + LOW_PASS
    return Splats(xy / z, variance[:, 0], z.detach()[:, 0].float(), colors)


@torch.no_grad()
def _drawable(splats: Splats) -> Tensor:
    """[N] bool: in front of the near plane, and every value finite in float32."""
    finite = splats.xy.float().isfinite().all(1) & splats.variance.float().isfinite()
    return finite & splats.colors.float().isfinite().all(1) & (splats.depth > NEAR) & splats.depth.isfinite()


@torch.no_grad()
def _all_drawable(splats: Splats) -> bool:
    """Whether `_drawable` holds for all, from four sums; False may also mean that a sum of finite values overflowed.

    A fast way out of the common case, in which nothing is wrong.
    """
    if len(splats.depth) == 0:
        return True
    total = splats.xy.float().sum() + splats.variance.float().sum() + splats.colors.float().sum() + splats.depth.sum()
    return bool(total.isfinite() & (splats.depth.min() > NEAR))


def _check(
    means: Tensor, scales: Tensor, colors: Tensor, camera: Camera, background: Sequence[float] | Tensor
) -> Tensor:
    """Raise ValueError for what cannot be drawn; the background as [C] in the dtype and on the device of `means`."""
    if not isinstance(camera, Camera):
        raise ValueError(f"splat camera: expected an ihbench.camera.Camera, got {type(camera).__name__}")
    if camera.distortion is not None:
        raise ValueError(
            "splat camera: expected no lens distortion; undistort the image and use camera.undistorted()"
        )
    for name, tensor in (("means", means), ("scales", scales), ("colors", colors)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"splats: {name}: expected a tensor of floats, got {kind}; colours are in 0..1")
        if tensor.device != means.device:
            raise ValueError(f"splats: {name} are on {tensor.device}, means on {means.device}; move them together")
    n = len(means) if means.ndim else 0
    if means.shape != (n, 3) or scales.shape != (n,) or colors.ndim != 2 or len(colors) != n or colors.shape[1] < 1:
        word = ""
        if scales.shape in ((n, 1), (n, 3)):
            word = "; Gaussians are isotropic here, one scale each"
        elif means.ndim == 2 and means.shape[0] == 3:
            word = "; one row a Gaussian: transpose"
        raise ValueError(
            "splats: expected means [N, 3], scales [N], colors [N, C], got "
            f"{list(means.shape)}, {list(scales.shape)}, {list(colors.shape)}{word}"
        )
    if n:
        # NaN is neither: a Gaussian that is not finite is not drawn
        smallest, brightest = torch.stack([scales.detach().amin().double(), colors.detach().amax().double()]).tolist()
        if -math.inf < smallest < 0:
            raise ValueError(
                f"splats: scales: expected standard deviations in metres, got {smallest:.4g}; "
                f"logarithms, as splat files hold them, go through exp()"
            )
        if colors.shape[1] == 3 and 16 < brightest < 256:
            raise ValueError(f"splats: colors: expected values in 0..1, got up to {brightest:.4g}; divide by 255")
    try:
        background = torch.as_tensor(background, dtype=torch.float64).detach()
    except (TypeError, ValueError):
        raise ValueError(f"splat background: expected numbers in 0..1, got {background!r}") from None
    if colors.shape[1] == 3 and background.numel() and 16 < float(background.max()) < 256:
        raise ValueError(f"splat background: expected values in 0..1, got {background.tolist()}; divide by 255")
    background = background.to(means.device)
    channels = colors.shape[1]
    if background.numel() not in (1, channels):
        raise ValueError(f"splat background: expected 1 or {channels} values, got {background.numel()}")
    return background.reshape(-1).expand(channels)


def _choose_backend(backend: str, device: torch.device) -> str:
    if backend not in BACKENDS:
        raise ValueError(f"splat back end {backend!r}: expected one of {', '.join(BACKENDS)}")
    if backend == "auto":
        if device.type == "cuda":
            backend = "gsplat"
        elif device.type == "cpu" and find_spec("numba") is not None:
            backend = "numba"
        else:
            backend = "reference"
    if backend == "numba":
        if find_spec("numba") is None:
            raise MissingPrerequisite(
                "splat back end 'numba' asked for, but numba is not installed: pip install numba"
            )
        if device.type != "cpu":
            raise ValueError(f"splat back end 'numba': expected tensors on the CPU, got {device}")
    return backend
