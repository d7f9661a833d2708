"""The splat renderer on CUDA: the tile rasteriser of the `gsplat` package (1.4 and 1.5) under our own projection.

Only its compositing is used, with the centres, the covariances and the order of depth of `ihbench.render.splat`, so
that the footprint is the one of the other back ends. What its kernel brings along are the largest and the smallest
alpha. The largest was 0.999 up to 1.5.3 and is 0.99 in 1.6 (`MAX_ALPHA` in its `Common.h`, changed months before the
version was): ten times as much shows through an opaque splat. A picture must not depend on which of them is
installed, so for the "opaque" preset a version of another largest alpha is refused; for "3dgs", whose largest is
0.99, opacities are cut there before an older version sees them. Both alphas are measured before the first picture,
whatever the version says.

One difference from the "opaque" preset remains and cannot be switched off: its kernel ends a pixel *before* the splat
that would bring the transmittance to 1e-4 or less. Such a pixel shows up to 1e-4 / (1 - ALPHA_MAX) = 0.1 of the
background. On a body-like scene of 5000 Gaussians, with that rule put into the twin, the largest error was 0.035 and
the mean 6e-5. With gsplat 1.5.3 on an H200 (`ihbench kernels splat`, 5000 to 200,000 Gaussians) the largest error in
a window of 64² pixels was 0.03 to 0.08, that of the gradient's norm 3 to 4 %; 200,000 Gaussians on 512² pixels took
2.4 ms forward and 1.3 ms backward.
"""

from __future__ import annotations

import re
from typing import Any

import torch
from torch import Tensor

from ihbench.errors import MissingPrerequisite
from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, PRESETS, Ellipses, Preset, Splats, as_ellipses

TILE = 16  # px
_LARGEST_RADIUS = 2**30  # px; gsplat takes int32 radii
LARGEST_ALPHA = {(1, 4): 0.999, (1, 6): 0.99}  # from this version of gsplat on
OLDEST = (1, 4)
ALPHA_ERROR = 1e-5  # of a measured alpha, in float32
PROBE_STEP = 48  # px between the probe's splats, farther than any footprint and tile


def composite(
    splats: Splats | Ellipses,
    height: int,
    width: int,
    background: Tensor,  # [C]
    preset: Preset | None = None,
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float32. Conventions: `ihbench.render.splat`.

    Raises `MissingPrerequisite` without CUDA or without a gsplat that draws as this bench does.
    """
    rules = preset or PRESETS["opaque"]
    gsplat = _gsplat(splats.xy.device)
    check_alphas(gsplat, splats.xy.device, rules)
    return _composite(gsplat, as_ellipses(splats), height, width, background, rules)


def _composite(
    gsplat: Any,
    splats: Ellipses,
    height: int,
    width: int,
    background: Tensor,
    rules: Preset,
    opacities: Tensor | None = None,  # other ones than those that the lists of splats per tile are for
) -> tuple[Tensor, Tensor]:
    # gsplat batches over cameras: a leading dimension of one
    xy, colors, depth = splats.xy.float()[None], splats.colors.float()[None], splats.depth[None]
    background = background.float()
    if xy.shape[1] == 0:
        return background.expand(height, width, -1), xy.new_zeros(height, width)

    xx, both, yy = splats.covariance.unbind(1)
    determinant = xx * yy - both * both
    conics = torch.stack([yy, -both, xx], -1) / determinant[:, None]  # the inverse covariance
    # a gsplat of a larger alpha never gets to use it: only the flat top of opacities above ours differs
    opacities = splats.opacity if opacities is None else opacities
    opacities = opacities.clamp(max=rules.alpha_max) if rules.alpha_max < ALPHA_MAX else opacities
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    radii = _radii(splats, height, width, rules)
    if not _takes_two_radii(gsplat.__version__):
        radii = radii.amax(-1)
    _, pair_ids, splat_ids = gsplat.isect_tiles(xy.detach(), radii, depth, TILE, tiles_x, tiles_y)
    offsets = gsplat.isect_offset_encode(pair_ids, 1, tiles_x, tiles_y)
    rgb, alpha = gsplat.rasterize_to_pixels(
        xy,
        conics.float()[None],
        colors,
        opacities.float()[None],
        width,
        height,
        TILE,
        offsets,
        splat_ids,
        backgrounds=background[None].contiguous(),
    )
    return rgb[0], alpha[0, ..., 0]


_measured: set[tuple[Any, str, float]] = set()  # packages, devices and largest alphas that were seen to fit


def check_alphas(gsplat: Any, device: torch.device, preset: Preset | None = None) -> None:
    """Raise `MissingPrerequisite` unless this gsplat can draw with a preset's alphas: by its version, and by three
    splats that it draws once a process.

    Its largest alpha must be the preset's. Where the preset's is smaller than that of an older gsplat, opacities are
    cut at the preset's before drawing.
    """
    rules = preset or PRESETS["opaque"]
    version = str(gsplat.__version__)
    expected = largest_alpha(version)
    if expected is not None and expected < rules.alpha_max:
        raise MissingPrerequisite(_other_alpha(version, f"a largest alpha of {expected:g}"))
    if (gsplat, str(device), rules.alpha_max) in _measured:
        return
    # pixel centres: alpha there is the opacity, between the two bounds
    opacities = torch.tensor([1.0, 1.05 * ALPHA_MIN, 0.95 * ALPHA_MIN], device=device)
    at = torch.arange(3, device=device, dtype=torch.float64) * PROBE_STEP + 0.5
    variance = torch.full_like(at, 0.3)
    splats = Ellipses(
        torch.stack([at, torch.full_like(at, 0.5)], 1),
        torch.stack([variance, torch.zeros_like(at), variance], 1),
        torch.ones_like(opacities),
        torch.ones(3, device=device),
        torch.ones(3, 1, device=device),
    )
    with torch.no_grad():
        width = 2 * PROBE_STEP + 1
        # as opaque, whatever the preset: the package's own largest alpha is what shows
        black = torch.zeros(1, device=device)
        _, alpha = _composite(gsplat, splats, 1, width, black, PRESETS["opaque"], opacities)
    measured = alpha[0, ::PROBE_STEP].tolist()
    largest = expected or min((rules.alpha_max, ALPHA_MAX), key=lambda a: abs(a - measured[0]))
    for value, right in zip(measured, (largest, 1.05 * ALPHA_MIN, 0.0), strict=True):
        if abs(value - right) > ALPHA_ERROR:
            word = f"an alpha of {value:.4g} where {right:.4g} belongs"
            raise MissingPrerequisite(_other_alpha(version, word))
    _measured.add((gsplat, str(device), rules.alpha_max))


def largest_alpha(version: str) -> float | None:
    """The largest alpha of a gsplat of this version, pre-releases and local builds included; None for one that says
    nothing. Raises `MissingPrerequisite` for one older than `OLDEST`."""
    parts = _major_minor(version)
    if parts is None:
        return None
    if parts < OLDEST:
        raise MissingPrerequisite(
            f"splat back end 'gsplat': version {version} is too old: pip install 'gsplat>=1.4,<1.6'"
        )
    return next(alpha for since, alpha in sorted(LARGEST_ALPHA.items(), reverse=True) if parts >= since)


def _other_alpha(version: str, what: str) -> str:
    return (
        f"splat back end 'gsplat': version {version} draws with {what}, this bench with {ALPHA_MAX:g}: pictures "
        f"would be others than on a CPU; pip install 'gsplat>=1.4,<1.6'"
    )


def _major_minor(version: str) -> tuple[int, int] | None:
    parts = re.match(r"v?(\d+)\.(\d+)", version)
    return None if parts is None else (int(parts[1]), int(parts[2]))


def _radii(splats: Ellipses, height: int, width: int, rules: Preset) -> Tensor:
    """[1, M, 2] int32 px: where alpha falls under `alpha_min`, 0 for splats that do not reach the image."""
    with torch.no_grad():
        xy = splats.xy.float()
        cut = 2 * (splats.opacity.double() / rules.alpha_min).clamp(min=1).log()
        reach = (splats.covariance[:, ::2] * cut[:, None]).sqrt().float()
        far = torch.tensor([width, height], dtype=xy.dtype, device=xy.device)
        outside = (xy - xy.clamp(torch.zeros_like(far), far)).abs()
        drawn = (outside <= reach).all(1) & (splats.opacity >= rules.alpha_min)
        return torch.where(drawn[:, None], reach.ceil().clamp(max=_LARGEST_RADIUS), 0.0).int()[None].contiguous()


def _takes_two_radii(version: str) -> bool:
    """gsplat 1.5 takes one radius per axis, 1.4 one per splat."""
    return (_major_minor(version) or (1, 5)) >= (1, 5)


def _gsplat(device: torch.device) -> Any:
    """The package, or one clear line."""
    if device.type != "cuda":
        raise MissingPrerequisite(
            f"splat back end 'gsplat': expected CUDA tensors, got {device}; move them or use backend='numba'"
        )
    try:
        import gsplat
    except ImportError as error:
        raise MissingPrerequisite(
            "splat back end 'gsplat': the package is missing: pip install 'ihbench[cuda]'"
        ) from error
    return gsplat
