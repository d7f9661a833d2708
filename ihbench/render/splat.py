"""Gaussian splatting: one function, three back ends that agree (float64 torch, numba on the CPU, gsplat on CUDA).

What every back end draws is defined here:

- Projection: `p = R x + t`; depth `z = p_z`; centre `u = K p / z` with pixel centres at +0.5.
- Footprint of a general Gaussian: covariance `J R Σ Rᵀ Jᵀ + LOW_PASS I` px², J the projection's derivative at the
  centre, its off-axis terms clamped `CLAMP` of half an image beside it. Alpha at d px from the centre is
  `min(alpha_max, opacity exp(-dᵀ Σ'⁻¹ d / 2))`; below `ALPHA_MIN` it is dropped.
- Footprint of an opaque isotropic Gaussian, InpaintHuman's: variance `(f s / z)² + LOW_PASS` px² with
  `f = sqrt(fx fy)`. That is the general one on the camera's axis; beside it, it lacks the off-axis terms and stays a
  circle (at 20° the general one is 1.13 times as wide across).
- Splats are composited front to back in the order of their depth, compared as float32; equal depths keep the order of
  their index. What is left of the transmittance shows the background.

`preset` names the constants (`ihbench.render.splats.PRESETS`): "opaque" has alpha_max 0.999 and no stop, "3dgs"
alpha_max 0.99 and ends a pixel before the splat that would bring its transmittance to 1e-4 or less (Kerbl et al.
2023, released code; near plane and clamp as gsplat has them).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from importlib.util import find_spec
from typing import Any, Literal, overload

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.errors import MissingPrerequisite
from ihbench.render import splats as constants
from ihbench.render.spherical_harmonics import DEGREES, colors_of
from ihbench.render.splat_projection import (
    covariances_of,
    depths,
    drawable_only,
    project_circles,
    project_ellipses,
    radii,
)  # fmt: skip
from ihbench.render.splats import Ellipses, Preset, Screen, Splats, as_ellipses

BACKENDS = ("auto", "reference", "numba", "gsplat")
OUTPUTS = ("rgb", "alpha", "depth", "screen")


@overload
def render_gaussians(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Sequence[float] | Tensor = ...,
    backend: str = ...,
    *,
    quaternions: Tensor | None = ...,
    opacities: Tensor | None = ...,
    sh_degree: int | None = ...,
    preset: Literal["opaque", "3dgs"] = ...,
) -> tuple[Tensor, Tensor]: ...
@overload
def render_gaussians(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    background: Sequence[float] | Tensor = ...,
    backend: str = ...,
    *,
    quaternions: Tensor | None = ...,
    opacities: Tensor | None = ...,
    sh_degree: int | None = ...,
    preset: Literal["opaque", "3dgs"] = ...,
    outputs: Sequence[str],
) -> tuple[Any, ...]: ...
def render_gaussians(
    means: Tensor,  # [N, 3] m, world
    scales: Tensor,  # [N] or [N, 3] m, standard deviations, or [N, 3, 3] m², covariances
    colors: Tensor,  # [N, C], or spherical harmonics [N, K, 3]
    camera: Camera,
    background: Sequence[float] | Tensor = (1.0, 1.0, 1.0),  # [C], or [1] for all channels
    backend: str = "auto",
    *,
    quaternions: Tensor | None = None,  # [N, 4] w x y z, of any length: what turns the axes of scales [N, 3]
    opacities: Tensor | None = None,  # [N] 0..1; None: opaque
    sh_degree: int | None = None,  # 0..3; None: `colors` are colours
    preset: Literal["opaque", "3dgs"] = "opaque",
    outputs: Sequence[str] = ("rgb", "alpha"),
) -> tuple[Any, ...]:
    """Draw Gaussians -> what `outputs` names, in its order, in the dtype and on the device of `means`:

    - "rgb" [H, W, C]
    - "alpha" [H, W]
    - "depth" [H, W] m: depths along the camera's axis weighted as colours are, over 0; divide by alpha for the
      expected depth
    - "screen": a `Screen`, whose `gradient` the backward pass fills in. Per px, of the centres alone; the released 3D
      Gaussian splatting counts in half images (times width / 2, height / 2)

    Differentiable in `means`, `scales`, `colors`, `quaternions` and `opacities`; under `torch.no_grad()` nothing is
    kept for a backward pass. The background is a constant: no gradient flows to it. `scales` enter squared. Depth
    hands its gradient to the means.

    Scales [N] without opacities under "opaque" draw InpaintHuman's circles, by a path of their own; scales [N] with
    opacities, or under "3dgs", draw general Gaussians with covariance s² I. A covariance's symmetric half counts.
    With `sh_degree`, `colors` are coefficients, K >= (sh_degree + 1)², of which the first (sh_degree + 1)² count.

    `backend`: "reference" is the float64 twin (slow, any device), "numba" the CPU, "gsplat" CUDA (the `cuda` extra),
    "auto" gsplat for CUDA tensors and numba otherwise (the reference where numba is not installed).

    A Gaussian with a value that is NaN or infinite, or that leaves float32 when projected, is not drawn and gets a
    zero gradient: one bad Gaussian must not blacken the picture. Whoever trains checks the parameters for finiteness.

    Raises ValueError for a camera with lens distortion (undistort the image, use `camera.undistorted()`), for wrong
    shapes, for negative scales, opacities beside 0..1 and 8-bit colours, and for an unknown back end, preset or
    output; `MissingPrerequisite`, an ImportError and a RuntimeError, where the asked-for back end cannot run here or
    draws otherwise than the others.
    """
    rules = _preset(preset)
    _check_outputs(outputs)
    _check(means, scales, colors, camera, quaternions, opacities, sh_degree)
    backend = _choose_backend(backend, means.device)
    if sh_degree is not None:
        center = torch.from_numpy(-camera.R.T @ camera.t).to(means.device)
        colors = colors_of(colors, means, center, sh_degree)
    background = _background(background, colors)
    circles = preset == "opaque" and scales.ndim == 1 and opacities is None
    channels = colors
    if "depth" in outputs:
        channels = torch.cat([colors, depths(means, camera).to(colors.dtype)[:, None]], 1)
        background = torch.cat([background, background.new_zeros(1)])
    screen = None
    if backend == "numba" and (not circles or _has_vectors()):
        from ihbench.render.splat_numba import draw_gaussians, draw_isotropic

        screen = Screen(means.new_zeros(len(means))) if "screen" in outputs else None
        inputs = (means, scales, channels, camera, background, rules)
        if circles:
            picture, alpha = draw_isotropic(*inputs, screen)
        else:
            picture, alpha = draw_gaussians(*inputs, quaternions, opacities, screen)
    else:
        splats, keep = _project(means, scales, channels, camera, quaternions, opacities, rules, circles)
        if "screen" in outputs:
            screen = _screen(splats, keep, means, camera, rules)
        picture, alpha = _compositor(backend)(splats, camera.height, camera.width, background, rules)
    picture, alpha = picture.to(means.dtype), alpha.to(means.dtype)
    found = {"rgb": picture[..., : colors.shape[1]], "alpha": alpha, "depth": picture[..., -1], "screen": screen}
    return tuple(found[name] for name in outputs)


def warm_up(device: str = "cpu") -> None:
    """Draw two Gaussians forward and backward, so that the back end's compilation is not charged to whoever draws
    first. Takes many seconds the first time after installation, milliseconds later (compiled code is kept)."""
    camera = Camera(np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), np.eye(3), np.zeros(3), 8, 8)
    means = torch.tensor([[0.0, 0, 1], [0.1, 0, 2]], device=device, requires_grad=True)
    scales = torch.full((2,), 0.1, device=device, requires_grad=True)
    colors = torch.full((2, 3), 0.5, device=device, requires_grad=True)
    for opacities in (None, torch.ones(2, device=device)):
        rgb, alpha = render_gaussians(means, scales, colors, camera, opacities=opacities)
        (rgb.sum() + alpha.sum()).backward()


def project_gaussians(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    *,
    quaternions: Tensor | None = None,
    opacities: Tensor | None = None,
    preset: str = "opaque",
) -> Splats | Ellipses:
    """World Gaussians -> splats of this camera, without those behind the near plane and the non-finite ones.

    Arguments as `render_gaussians` has them, but no spherical harmonics.
    """
    circles = preset == "opaque" and scales.ndim == 1 and opacities is None
    return _project(means, scales, colors, camera, quaternions, opacities, _preset(preset), circles)[0]


def _project(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    quaternions: Tensor | None,
    opacities: Tensor | None,
    rules: Preset,
    circles: bool,
) -> tuple[Splats | Ellipses, Tensor | None]:
    """The drawable splats and the indices of their Gaussians; None for all."""
    if circles:
        return drawable_only(partial(project_circles, camera=camera, preset=rules), (means, scales, colors), rules)
    # a number of its own for each, so that what belongs to a Gaussian can be picked with it
    opacities = means.new_ones(len(means)) if opacities is None else opacities
    inputs = (means, scales, opacities, colors, *(() if quaternions is None else (quaternions,)))

    def project(
        means: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor, turns: Tensor | None = None
    ) -> Ellipses:
        covariances = scales if scales.ndim == 3 else covariances_of(scales, turns)
        return project_ellipses(means, covariances, opacities, colors, camera, rules)

    return drawable_only(project, inputs, rules)


def _screen(splats: Splats | Ellipses, keep: Tensor | None, means: Tensor, camera: Camera, rules: Preset) -> Screen:
    """Radii now, and the gradient of the centres when it comes."""

    def of_all(values: Tensor) -> Tensor:
        everybody = values.new_zeros(len(means), *values.shape[1:]) if keep is not None else values
        return (everybody if keep is None else everybody.index_copy(0, keep, values)).to(means.dtype)

    screen = Screen(of_all(radii(as_ellipses(splats), camera.height, camera.width, rules)))

    def fill(gradient: Tensor) -> None:
        screen.add(of_all(gradient.detach()))

    if splats.xy.requires_grad:
        splats.xy.register_hook(fill)
    return screen


def _compositor(backend: str) -> Any:
    if backend == "numba":
        from ihbench.render.splat_numba import composite
    elif backend == "gsplat":
        from ihbench.render.splat_gsplat import composite
    else:
        from ihbench.render.splat_reference import composite
    return composite


def _has_vectors() -> bool:
    from ihbench.render import splat_numba

    return splat_numba.vectors()


# ----------------------------------------------------------------------------------------------------
# What cannot be drawn


def _preset(name: str) -> Preset:
    if name not in constants.PRESETS:
        raise ValueError(f"splat preset {name!r}: expected one of {', '.join(constants.PRESETS)}")
    return constants.PRESETS[name]


def _check_outputs(outputs: Sequence[str]) -> None:
    if isinstance(outputs, str) or not outputs:
        raise ValueError(f"splat outputs: expected names such as ('rgb', 'alpha'), got {outputs!r}")
    unknown = [name for name in outputs if name not in OUTPUTS]
    if unknown:
        raise ValueError(f"splat output {unknown[0]!r}: expected some of {', '.join(OUTPUTS)}")


def _check(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    camera: Camera,
    quaternions: Tensor | None,
    opacities: Tensor | None,
    sh_degree: int | None,
) -> None:
    """Raise ValueError for what cannot be drawn."""
    if not isinstance(camera, Camera):
        raise ValueError(f"splat camera: expected an ihbench.camera.Camera, got {type(camera).__name__}")
    if camera.distortion is not None:
        raise ValueError(
            "splat camera: expected no lens distortion; undistort the image and use camera.undistorted()"
        )
    tensors = {
        "means": means, "scales": scales, "colors": colors, "quaternions": quaternions, "opacities": opacities
    }  # fmt: skip
    tensors = {name: tensor for name, tensor in tensors.items() if tensor is not None or name in ("scales", "colors")}
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"splats: {name}: expected a tensor of floats, got {kind}; colours are in 0..1")
        if tensor.device != means.device:
            raise ValueError(f"splats: {name} are on {tensor.device}, means on {means.device}; move them together")
    _check_shapes(means, scales, colors, quaternions, opacities, sh_degree)
    if len(means):
        _check_values(scales, colors, opacities, sh_degree)


def _check_shapes(
    means: Tensor,
    scales: Tensor,
    colors: Tensor,
    quaternions: Tensor | None,
    opacities: Tensor | None,
    sh_degree: int | None,
) -> None:
    n = len(means) if means.ndim else 0
    flat = colors.ndim == 2 and len(colors) == n and colors.shape[1] >= 1
    of_shape = scales.shape in ((n,), (n, 3, 3)) or (scales.shape == (n, 3) and quaternions is not None)
    if means.shape != (n, 3) or not of_shape or not (flat or sh_degree is not None):
        word = ""
        if scales.shape in ((n, 1), (n, 3)):
            word = "; isotropic Gaussians have one scale each, three go with quaternions [N, 4]"
        elif means.ndim == 2 and means.shape[0] == 3:
            word = "; one row a Gaussian: transpose"
        elif colors.ndim == 3:
            word = "; spherical harmonics go with sh_degree"
        raise ValueError(
            "splats: expected means [N, 3], scales [N] or [N, 3] or covariances [N, 3, 3], colors [N, C], got "
            f"{list(means.shape)}, {list(scales.shape)}, {list(colors.shape)}{word}"
        )
    if quaternions is not None and (quaternions.shape != (n, 4) or scales.shape != (n, 3)):
        raise ValueError(
            "splats: quaternions: expected [N, 4] beside scales [N, 3], got "
            f"{list(quaternions.shape)} beside {list(scales.shape)}"
        )
    if opacities is not None and opacities.shape != (n,):
        raise ValueError(f"splats: opacities: expected [N] = [{n}], got {list(opacities.shape)}")
    if sh_degree is not None:
        if sh_degree not in DEGREES:
            raise ValueError(f"splats: sh_degree: expected 0 to 3, or None for colours, got {sh_degree!r}")
        needed = (sh_degree + 1) ** 2
        if colors.ndim != 3 or len(colors) != n or colors.shape[1] < needed or colors.shape[2] != 3:
            raise ValueError(
                f"splats: colors: expected spherical harmonics [N, {needed} or more, 3] for degree {sh_degree}, got "
                f"{list(colors.shape)}"
            )


def _check_values(scales: Tensor, colors: Tensor, opacities: Tensor | None, sh_degree: int | None) -> None:
    # NaN is none of these: a Gaussian that is not finite is not drawn
    given = scales.detach().diagonal(dim1=1, dim2=2) if scales.ndim == 3 else scales.detach()
    values = [given.amin().double(), colors.detach().amax().double()]
    if opacities is not None:
        values += [opacities.detach().amin().double(), opacities.detach().amax().double()]
    smallest, brightest, *range_of_opacity = torch.stack(values).tolist()
    if -math.inf < smallest < 0:
        if scales.ndim == 3:
            raise ValueError(f"splats: covariances: expected variances in m² on the diagonal, got {smallest:.4g}")
        raise ValueError(
            f"splats: scales: expected standard deviations in metres, got {smallest:.4g}; "
            f"logarithms, as splat files hold them, go through exp()"
        )
    if sh_degree is None and colors.shape[1] == 3 and 16 < brightest < 256:
        raise ValueError(f"splats: colors: expected values in 0..1, got up to {brightest:.4g}; divide by 255")
    if range_of_opacity:
        low, high = range_of_opacity
        bad = low if -math.inf < low < 0 else high if 1 < high < math.inf else None
        if bad is not None:
            raise ValueError(
                f"splats: opacities: expected values in 0..1, got {bad:.4g}; logits, as splat files hold them, go "
                f"through sigmoid()"
            )


def _background(background: Sequence[float] | Tensor, colors: Tensor) -> Tensor:
    """The background as [C] in float64 on the device of the colours; raises ValueError."""
    try:
        values = torch.as_tensor(background, dtype=torch.float64).detach()
    except (TypeError, ValueError):
        raise ValueError(f"splat background: expected numbers in 0..1, got {background!r}") from None
    if colors.shape[1] == 3 and values.numel() and 16 < float(values.max()) < 256:
        raise ValueError(f"splat background: expected values in 0..1, got {values.tolist()}; divide by 255")
    channels = colors.shape[1]
    if values.numel() not in (1, channels):
        raise ValueError(f"splat background: expected 1 or {channels} values, got {values.numel()}")
    return values.to(colors.device).reshape(-1).expand(channels)


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
