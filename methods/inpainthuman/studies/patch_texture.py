"""How patterned a patch of the body's surface looks: a weight-free feature for comparing what is painted with what is
seen. It knows no mean colour, so a plain fill in the right colour still differs from stripes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.body.uv import Texels

PATCH = 1 / 16  # of the texture's side, about 10 cm of an SMPL body: a patch's side
STEP = 1 / 64  # of the texture's side, over which lightness is compared
COVERED = 0.5  # share of a patch that a view must show
DIRECTIONS = ((0, 1), (1, 1), (1, 0), (1, -1))  # row, column: 0°, 45°, 90°, 135° of the texture
STATISTICS = 3 + len(DIRECTIONS)


def patch_count(resolution: int) -> int:
    """Patches of a texture, those off its charts included."""
    return _patches_across(resolution) ** 2


def patch_side(resolution: int) -> int:
    """Texels along a patch's side."""
    return max(round(PATCH * resolution), 1)


def patch_texture(
    texel: NDArray[np.integer],  # [n] numbers in the texel table
    rgb: NDArray[np.floating],  # [n, 3] in [0, 1]
    texels: Texels,
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Patches [p], squares of the texture of which `COVERED` is given, ascending, and what they look like [p, 7] in
    units of L*a*b*: the standard deviations of L, a and b, and the mean |ΔL| over `STEP` in four directions."""
    from skimage.color import rgb2lab

    size, side = texels.resolution, patch_side(texels.resolution)
    across = _patches_across(size)
    row, column = np.divmod(np.arange(size * size), size)
    patch = (row // side) * across + column // side
    chart = np.bincount(patch[texels.index], minlength=across**2)
    index = texels.index[texel]
    given = np.bincount(patch[index], minlength=across**2)
    values = rgb2lab(rgb)
    out = np.full((across**2, STATISTICS), np.nan)
    for k in range(3):
        mean = _patch_means(patch[index], values[:, k], across**2)
        out[:, k] = np.sqrt(_patch_means(patch[index], (values[:, k] - mean[patch[index]]) ** 2, across**2))
    lightness = np.full((size, size), np.nan)
    lightness.flat[index] = values[:, 0]
    step, place = max(round(STEP * size), 1), patch.reshape(size, size)
    for k, (down, right) in enumerate(DIRECTIONS):
        here, there = _shifted(size, down * step, right * step)
        change = np.abs(lightness[there] - lightness[here])
        known = np.isfinite(change)
        out[:, 3 + k] = _patch_means(place[here][known], change[known], across**2)
    # a patch with little surface says nothing; one without a pair in some direction is not known there
    enough = (given >= COVERED * chart) & (chart >= side**2 / 4) & np.isfinite(out).all(1)
    return np.flatnonzero(enough), out[enough]


def _patches_across(resolution: int) -> int:
    return -(-resolution // patch_side(resolution))


def _patch_means(patch: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """[count] NaN where a patch has no value."""
    n = np.bincount(patch, minlength=count)
    return np.divide(np.bincount(patch, values, count), n, out=np.full(count, np.nan), where=n > 0)


def _shifted(size: int, down: int, right: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Windows of a map such that the second shows what lies `down`, `right` of the first."""
    left = max(-right, 0)
    here = slice(0, max(size - down, 0)), slice(left, max(size - max(right, 0), left))
    return here, (slice(down, size), slice(left + right, here[1].stop + right))
