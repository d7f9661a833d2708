"""The splat renderer on CUDA: the tile rasteriser of the `gsplat` package (>= 1.4) under our own projection.

Only its compositing is used, with the centres, the variances and the order of depth of `ihbench.render.splat`, so
that the footprint is the one of the other back ends.

One difference remains and cannot be switched off: its kernel ends a pixel *before* the splat that would bring the
transmittance to 1e-4 or less. Such a pixel shows up to 1e-4 / (1 - ALPHA_MAX) = 0.1 of the background. On a body-like
scene of 5000 Gaussians, with that rule put into the twin, the largest error was 0.035 and the mean 6e-5. With gsplat
1.5.3 on an H200 (`ihbench kernels splat`, 5000 to 200,000 Gaussians) the largest error in a window of 64² pixels was
0.03 to 0.08, that of the gradient's norm 3 to 4 %; 200,000 Gaussians on 512² pixels took 2.4 ms forward and 1.3 ms
backward, numba on one thread of that machine 71 and 103 ms.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ihbench.render.splat import ALPHA_MIN, Splats

TILE = 16  # px
_LARGEST_RADIUS = 2**30  # px; gsplat takes int32 radii


def composite(
    splats: Splats,
    height: int,
    width: int,
    background: Tensor,  # [C]
) -> tuple[Tensor, Tensor]:
    """Splats -> rgb [H, W, C], alpha [H, W], float32. `Splats` and the conventions: `ihbench.render.splat`."""
    gsplat = _gsplat(splats.xy.device)
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
        torch.ones_like(variance),
        width,
        height,
        TILE,
        offsets,
        splat_ids,
        backgrounds=background[None].contiguous(),
    )
    return rgb[0], alpha[0, ..., 0]


def _radii(xy: Tensor, variance: Tensor, height: int, width: int) -> Tensor:
    """[1, M] int32 px: where alpha falls under ALPHA_MIN, 0 for splats that do not reach the image."""
    reach = torch.sqrt(variance * (2 * math.log(1 / ALPHA_MIN)))
    far = torch.tensor([width, height], dtype=xy.dtype, device=xy.device)
    outside = (xy - xy.clamp(torch.zeros_like(far), far)).abs().amax(-1)
    return torch.where(outside <= reach, reach.ceil().clamp(max=_LARGEST_RADIUS), 0.0).int()


def _takes_two_radii(version: str) -> bool:
    """gsplat 1.5 takes one radius per axis, 1.4 one per splat."""
    major, minor = (int(part) for part in version.split(".")[:2])
    return (major, minor) >= (1, 5)


def _gsplat(device: torch.device):
    """The package, or one clear line."""
    if device.type != "cuda":
        raise RuntimeError(
            f"splat back end 'gsplat': expected CUDA tensors, got {device}; move them or use backend='numba'"
        )
    try:
        import gsplat
    except ImportError as error:
        raise ImportError("splat back end 'gsplat': the package is missing: pip install 'ihbench[cuda]'") from error
    return gsplat
