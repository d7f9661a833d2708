"""The splat renderer on CUDA: the tile rasteriser of the `gsplat` package (1.4 and 1.5) under our own projection.

Only its compositing is used, with the centres, the variances and the order of depth of `ihbench.render.splat`, so
that the footprint is the one of the other back ends. What its kernel brings along are the largest and the smallest
alpha. The largest was 0.999 up to 1.5.3 and is 0.99 in 1.6 (`MAX_ALPHA` in its `Common.h`, changed months before the
version was): ten times as much shows through an opaque splat. A picture must not depend on which of them is
installed, so a version of another largest alpha is refused, and both alphas are measured before the first picture,
whatever the version says.

One difference remains and cannot be switched off: its kernel ends a pixel *before* the splat that would bring the
transmittance to 1e-4 or less. Such a pixel shows up to 1e-4 / (1 - ALPHA_MAX) = 0.1 of the background. On a body-like
scene of 5000 Gaussians, with that rule put into the twin, the largest error was 0.035 and the mean 6e-5. With gsplat
1.5.3 on an H200 (`ihbench kernels splat`, 5000 to 200,000 Gaussians) the largest error in a window of 64² pixels was
0.03 to 0.08, that of the gradient's norm 3 to 4 %; 200,000 Gaussians on 512² pixels took 2.4 ms forward and 1.3 ms
backward, numba on one thread of that machine 71 and 103 ms.
"""

from __future__ import annotations

import math
import re
from typing import Any

import torch
from torch import Tensor

from ihbench.errors import MissingPrerequisite
from ihbench.render.splats import ALPHA_MAX, ALPHA_MIN, Splats

TILE = 16  # px
_LARGEST_RADIUS = 2**30  # px; gsplat takes int32 radii
LARGEST_ALPHA = {(1, 4): 0.999, (1, 6): 0.99}  # from this version of gsplat on
OLDEST = (1, 4)
ALPHA_ERROR = 1e-5  # of a measured alpha, in float32
PROBE_STEP = 48  # px between the probe's splats, farther than any footprint and tile


def composite(
    splats: Splats,
    height: int,
    width: int,
    background: Tensor,  # [C]
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float32. `Splats` and the conventions: `ihbench.render.splat`.

    Raises `MissingPrerequisite` without CUDA or without a gsplat that draws as this bench does.
    """
    gsplat = _gsplat(splats.xy.device)
    check_alphas(gsplat, splats.xy.device)
    return _composite(gsplat, splats, height, width, background)


def _composite(
    gsplat: Any, splats: Splats, height: int, width: int, background: Tensor, opacities: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    # gsplat batches over cameras: a leading dimension of one
    xy, variance = splats.xy.float()[None], splats.variance.float()[None]
    colors, depth = splats.colors.float()[None], splats.depth[None]
    background = background.float()
    if xy.shape[1] == 0:
        return background.expand(height, width, -1), xy.new_zeros(height, width)

    inverse = 1 / variance
    conics = torch.stack([inverse, torch.zeros_like(inverse), inverse], -1)  # xx, xy, yy of the inverse covariance
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    radii = _radii(xy.detach(), variance.detach(), height, width)
    if _takes_two_radii(gsplat.__version__):
        radii = radii[..., None].expand(-1, -1, 2).contiguous()
    _, pair_ids, splat_ids = gsplat.isect_tiles(xy.detach(), radii, depth, TILE, tiles_x, tiles_y)
    offsets = gsplat.isect_offset_encode(pair_ids, 1, tiles_x, tiles_y)
    rgb, alpha = gsplat.rasterize_to_pixels(
        xy,
        conics,
        colors,
        torch.ones_like(variance) if opacities is None else opacities[None],
        width,
        height,
        TILE,
        offsets,
        splat_ids,
        backgrounds=background[None].contiguous(),
    )
    return rgb[0], alpha[0, ..., 0]


_measured: set[tuple[Any, str]] = set()  # packages and devices whose alphas are those of this bench


def check_alphas(gsplat: Any, device: torch.device) -> None:
    """Raise `MissingPrerequisite` unless this gsplat draws with `ALPHA_MAX` and `ALPHA_MIN`: by its version, and by
    three splats that it draws once a process."""
    version = str(gsplat.__version__)
    expected = largest_alpha(version)
    if expected is not None and expected != ALPHA_MAX:
        raise MissingPrerequisite(_other_alpha(version, f"a largest alpha of {expected:g}"))
    if (gsplat, str(device)) in _measured:
        return
    # pixel centres: alpha there is the opacity, between the two bounds
    opacities = torch.tensor([1.0, 1.05 * ALPHA_MIN, 0.95 * ALPHA_MIN], device=device)
    at = torch.arange(3, device=device, dtype=torch.float64) * PROBE_STEP + 0.5
    splats = Splats(
        torch.stack([at, torch.full_like(at, 0.5)], 1),
        torch.full_like(at, 0.3),
        torch.ones(3, device=device),
        torch.ones(3, 1, device=device),
    )
    with torch.no_grad():
        width = 2 * PROBE_STEP + 1
        _, alpha = _composite(gsplat, splats, 1, width, torch.zeros(1, device=device), opacities)
    measured = alpha[0, ::PROBE_STEP].tolist()
    for value, right in zip(measured, (ALPHA_MAX, 1.05 * ALPHA_MIN, 0.0), strict=True):
        if abs(value - right) > ALPHA_ERROR:
            raise MissingPrerequisite(_other_alpha(version, f"an alpha of {value:.4g} where {right:.4g} belongs"))
    _measured.add((gsplat, str(device)))


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


def _radii(xy: Tensor, variance: Tensor, height: int, width: int) -> Tensor:
    """[1, M] int32 px: where alpha falls under ALPHA_MIN, 0 for splats that do not reach the image."""
    reach = torch.sqrt(variance * (2 * math.log(1 / ALPHA_MIN)))
    far = torch.tensor([width, height], dtype=xy.dtype, device=xy.device)
    outside = (xy - xy.clamp(torch.zeros_like(far), far)).abs().amax(-1)
    return torch.where(outside <= reach, reach.ceil().clamp(max=_LARGEST_RADIUS), 0.0).int()


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
