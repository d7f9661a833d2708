"""What is claimed of inpainting, measured: does it keep the person's looks, does it hold still, is it right?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.uv import texel_table
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.methods.inpainthuman.inpainting.surface_colours import counted_colours, off_the_rim
from ihbench.methods.inpainthuman.studies.patch_texture import lab, patch_count, patch_texture
from ihbench.metrics.flip import flip
from ihbench.metrics.psnr import decibels, psnr
from ihbench.metrics.ssim import ssim
from ihbench.scene.visibility import PosedSurface

TEXELS = 128  # of the texture's side on which appearances are compared
Image = NDArray[np.uint8]  # [S, W, 3]
Sighting = tuple[NDArray[np.integer], NDArray[np.floating]]  # numbers [n] ascending, values [n, C]
Distance = Callable[[NDArray, NDArray], NDArray]  # [n, C], [n, C] -> [n]


@dataclass(frozen=True)
class Drift:
    """How far painted surface is from the mean of what other views show of it; mean over all paintings of a texel.

    The floors are the same for seen surface against the mean of its other sightings: lighting, pose and resampling
    alone. Absent numbers are NaN, and `reason` says why.
    """

    texels: int  # painted in some view and seen in another
    rgb: float  # mean |ΔRGB|, of 1
    delta_e: float  # CIE76
    rgb_floor: float
    delta_e_floor: float
    patches: int  # painted in some view and seen in another
    texture: float  # Euclidean distance of `patch_texture`, units of L*a*b*
    texture_floor: float
    reason: str


@dataclass(frozen=True)
class Flicker:
    """How much painted surface changes between views, RGB of 1; and seen surface, whose lighting changes alone.

    Absent numbers are NaN, and `reason` says why.
    """

    texels: int  # painted in two views or more
    deviation: float  # mean over texels of the standard deviation over the views that paint them
    change: float  # mean |ΔRGB| of texels painted in two views that follow each other
    seen_texels: int
    deviation_floor: float
    change_floor: float
    reason: str


def identity_drift(
    views: Sequence[CropView],
    completed: Sequence[Image],
    body: Body,
    texels: int = TEXELS,
) -> Drift:
    """Compare what is painted on the body with what the views show of the same surface.

    Only pixels none of whose neighbours is background count: at the rim colours are mixed. Raises `ValueError` unless
    there is one image per view.
    """
    table = texel_table(body, texels)
    seen, painted = _sightings(views, completed, body, texels)
    (rgb, delta_e), n = _against_seen(painted, seen, len(table.index), (_rgb_distance, _delta_e))
    rgb_floor, delta_e_floor = _among_seen(seen, len(table.index), (_rgb_distance, _delta_e))
    patches_seen = [patch_texture(*sighting, table) for sighting in seen]
    patches_painted = [patch_texture(*sighting, table) for sighting in painted]
    (texture,), n_patches = _against_seen(patches_painted, patches_seen, patch_count(texels), (_euclidean,))
    (texture_floor,) = _among_seen(patches_seen, patch_count(texels), (_euclidean,))
    reasons = [
        ("no texel is painted in one view and seen in another", n == 0),
        ("no patch is painted in one view and seen in another", n_patches == 0),
        ("no texel is seen in two views", math.isnan(rgb_floor)),
        ("no patch is seen in two views", math.isnan(texture_floor)),
    ]
    return Drift(
        texels=n,
        rgb=rgb,
        delta_e=delta_e,
        rgb_floor=rgb_floor,
        delta_e_floor=delta_e_floor,
        patches=n_patches,
        texture=texture,
        texture_floor=texture_floor,
        reason="; ".join(reason for reason, absent in reasons if absent),
    )


def flicker(
    views: Sequence[CropView],
    completed: Sequence[Image],
    body: Body,
    texels: int = TEXELS,
) -> Flicker:
    """Follow the painted texels from view to view, in order of index. Pixels count as in `identity_drift`."""
    n_texels = len(texel_table(body, texels).index)
    seen, painted = _sightings(views, completed, body, texels)
    order = np.argsort([view.index for view in views], kind="stable")
    n, deviation = _deviation(painted, n_texels)
    n_seen, deviation_floor = _deviation(seen, n_texels)
    change = _change([painted[k] for k in order])
    change_floor = _change([seen[k] for k in order])
    reasons = [
        ("no texel is painted in two views", n == 0),
        ("no texel is painted in two views that follow each other", n > 0 and math.isnan(change)),
        ("no texel is seen in two views", n_seen == 0),
        ("no texel is seen in two views that follow each other", n_seen > 0 and math.isnan(change_floor)),
    ]
    reason = "; ".join(reason for reason, absent in reasons if absent)
    return Flicker(n, deviation, change, n_seen, deviation_floor, change_floor, reason)


class HiddenScores(TypedDict):
    """Of one region: means over all of its pixels, over the views that hide something, and view by view."""

    pixels: int
    pooled: dict[str, float]  # psnr, ssim, flip
    mean: dict[str, float]
    views: list[dict[str, float]]  # view, pixels, psnr, ssim, flip
    reason: str  # why numbers are absent


def hidden_scores(
    completed: Sequence[Image],
    truths: Sequence[Image],  # the un-occluded crops
    views: Sequence[CropView],
    truth_silhouettes: Sequence[NDArray[np.bool_]],  # [S, W] complete
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),  # RGB in [0, 1], of the metrics' painting
) -> dict[str, HiddenScores]:
    """Scores of the hidden person: unknown pixels inside the true silhouette, and of those on the posed body model
    alone (`on_body`), where a painter that takes the model for the silhouette is judged by its colours.

    Per region `psnr`, `ssim` and `flip` (without learned weights) pooled over all pixels of all views, their means
    over the views that hide something (PSNRs of inf left out unless all are), and one row per view. Absent numbers
    are NaN with a `reason`. Raises `ValueError` for images that cannot be compared.
    """
    hidden = [view.unknown & inside for view, inside in zip(views, truth_silhouettes, strict=True)]
    on_body = [mask & view.body for mask, view in zip(hidden, views, strict=True)]
    numbers = [view.index for view in views]
    return {
        "hidden": _scores(completed, truths, hidden, numbers, background),
        "on_body": _scores(completed, truths, on_body, numbers, background),
    }


# ------------------------------------------------------------------------------------- surface, view by view


def _sightings(
    views: Sequence[CropView], completed: Sequence[Image], body: Body, resolution: int
) -> tuple[list[Sighting], list[Sighting]]:
    """Per view, texels and RGB in [0, 1] of what it shows of the person, and of what is painted on the body."""
    table = texel_table(body, resolution)
    seen, painted = [], []
    for view, image in zip(views, completed, strict=True):
        faced, inner = PosedSurface(body, view.camera, view.body_pose).faced(table), off_the_rim(view)
        for out, counted in ((seen, view.person & inner), (painted, view.unknown & inner)):
            texel, rgb = counted_colours(faced, image, counted)
            out.append((texel, rgb / 255))
    return seen, painted


def _rgb_distance(a: NDArray, b: NDArray) -> NDArray:
    return np.abs(a - b).mean(1)


def _delta_e(a: NDArray, b: NDArray) -> NDArray:
    return np.linalg.norm(lab(a) - lab(b), axis=1)


def _euclidean(a: NDArray, b: NDArray) -> NDArray:
    return np.linalg.norm(a - b, axis=1)


def _sum_and_count(sightings: Sequence[Sighting], size: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """[size, C] and [size]."""
    channels = sightings[0][1].shape[1] if sightings else 3
    total, count = np.zeros((size, channels)), np.zeros(size, np.int64)
    for number, values in sightings:
        total[number] += values
        count[number] += 1
    return total, count


def _against_seen(
    painted: Sequence[Sighting], seen: Sequence[Sighting], size: int, distances: Sequence[Distance]
) -> tuple[list[float], int]:
    """Mean distances of paintings to the mean of all sightings, NaN for none; and how many numbers have both."""
    total, count = _sum_and_count(seen, size)
    used, found = np.zeros(size, bool), [[np.zeros(0)] for _ in distances]
    for number, values in painted:
        known = count[number] > 0
        number, values = number[known], values[known]
        used[number] = True
        for out, distance in zip(found, distances, strict=True):
            out.append(distance(values, total[number] / count[number, None]))
    return [_mean(np.concatenate(values)) for values in found], int(used.sum())


def _among_seen(seen: Sequence[Sighting], size: int, distances: Sequence[Distance]) -> list[float]:
    """Mean distances of sightings to the mean of the others, NaN for none."""
    total, count = _sum_and_count(seen, size)
    found = [[np.zeros(0)] for _ in distances]
    for number, values in seen:
        known = count[number] > 1
        number, values = number[known], values[known]
        for out, distance in zip(found, distances, strict=True):
            out.append(distance(values, (total[number] - values) / (count[number, None] - 1)))
    return [_mean(np.concatenate(values)) for values in found]


def _deviation(sightings: Sequence[Sighting], size: int) -> tuple[int, float]:
    """Numbers with two sightings or more, and the mean of their standard deviations."""
    count, mean, squares = np.zeros(size, np.int64), np.zeros((size, 3)), np.zeros((size, 3))
    for number, values in sightings:  # Welford's recurrence: what does not change deviates by exactly 0
        count[number] += 1
        before = values - mean[number]
        mean[number] += before / count[number, None]
        squares[number] += before * (values - mean[number])
    twice = count > 1
    return int(twice.sum()), _mean(np.sqrt(squares[twice] / count[twice, None]))


def _change(sightings: Sequence[Sighting]) -> float:
    """Mean absolute difference between sightings that follow each other, NaN for none."""
    found = [np.zeros((0, 3))]
    for (a, x), (b, y) in pairwise(sightings):
        _, i, j = np.intersect1d(a, b, assume_unique=True, return_indices=True)
        found.append(np.abs(x[i] - y[j]))
    return _mean(np.concatenate(found))


def _mean(values: NDArray) -> float:
    return float(values.mean(dtype=np.float64)) if values.size else math.nan


# ------------------------------------------------------------------------------------------------ scores


def _scores(
    completed: Sequence[Image],
    truths: Sequence[Image],
    masks: Sequence[NDArray[np.bool_]],
    numbers: Sequence[int],
    background: tuple[float, float, float],
) -> HiddenScores:
    rows, error, pixels = [], 0.0, 0
    for painted, truth, mask, number in zip(completed, truths, masks, numbers, strict=True):
        n = int(mask.sum())
        scores = {
            "psnr": psnr(painted, truth, mask),
            "ssim": ssim(painted, truth, mask, background=background),
            "flip": flip(painted, truth, mask, background=background),
        }
        rows.append({"view": number, "pixels": n, **scores})
        if n:
            error += n * 10 ** (-scores["psnr"] / 10)
            pixels += n
    hiding = [row for row in rows if row["pixels"]]
    pooled = {
        name: math.fsum(row["pixels"] * row[name] for row in hiding) / pixels if pixels else math.nan
        for name in ("ssim", "flip")
    }
    pooled_psnr = decibels(error / pixels) if pixels else math.nan
    mean = {name: _mean_finite([row[name] for row in hiding]) for name in ("psnr", "ssim", "flip")}
    return {
        "pixels": pixels,
        "pooled": {"psnr": pooled_psnr, **pooled},
        "mean": mean,
        "views": rows,
        "reason": "" if pixels else "no hidden pixel shows the person",
    }


def _mean_finite(values: Sequence[float]) -> float:
    """The mean of the finite values; inf if there are only infinite ones, NaN for none."""
    finite = [value for value in values if math.isfinite(value)]
    if finite:
        return math.fsum(finite) / len(finite)
    return math.inf if any(math.isinf(value) for value in values) else math.nan
