"""What is claimed of inpainting, measured: does it keep the person's looks, does it hold still, is it right?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.uv import texel_table
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.methods.inpainthuman.inpainting.surface_colours import counted_colours, off_the_rim
from ihbench.methods.inpainthuman.studies.patch_texture import patch_count, patch_texture
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
    delta_e: float  # CIEDE2000
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


def identity_drift(views: Sequence[CropView], completed: Sequence[Image], body: Body, texels: int = TEXELS) -> Drift:
    """Compare what is painted on the body with what the views show of the same surface.

    Only pixels none of whose neighbours is background count: at the rim colours are mixed. Raises `ValueError` unless
    there is one image per view.
    """
    table = texel_table(body, texels)
    seen, painted = _sightings(views, completed, body, texels)
    (rgb, delta_e), n = _from_seen(painted, seen, len(table.index), (_rgb_distance, _delta_e))
    (rgb_floor, delta_e_floor), _ = _from_seen(seen, seen, len(table.index), (_rgb_distance, _delta_e))
    patches_seen, patches_painted = ([patch_texture(*one, table) for one in shown] for shown in (seen, painted))
    (texture,), n_patches = _from_seen(patches_painted, patches_seen, patch_count(texels), (_euclidean,))
    (texture_floor,), _ = _from_seen(patches_seen, patches_seen, patch_count(texels), (_euclidean,))
    reasons = [
        ("no texel is painted in one view and seen in another", n == 0),
        ("no patch is painted in one view and seen in another", n_patches == 0),
        ("no texel is seen in two views", math.isnan(rgb_floor)),
        ("no patch is seen in two views", math.isnan(texture_floor)),
    ]
    reason = "; ".join(reason for reason, absent in reasons if absent)
    return Drift(n, rgb, delta_e, rgb_floor, delta_e_floor, n_patches, texture, texture_floor, reason)


def flicker(views: Sequence[CropView], completed: Sequence[Image], body: Body, texels: int = TEXELS) -> Flicker:
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


def hidden_scores(
    completed: Sequence[Image],
    truths: Sequence[Image],  # the un-occluded crops
    views: Sequence[CropView],
    truth_silhouettes: Sequence[NDArray[np.bool_]],  # [S, W] complete
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),  # RGB in [0, 1], of the metrics' painting
) -> dict[str, dict[str, float]]:
    """Scores of the hidden person: unknown pixels inside the true silhouette (`hidden`), and of those on the posed
    body model alone (`on_body`), where an inpainter that takes the model for the silhouette is judged by its colours.

    Per region `psnr`, `ssim` and `flip` (without learned weights) pooled over all pixels of all views; NaN where
    there is none. Raises `ValueError` for images that cannot be compared.
    """
    hidden = [view.unknown & inside for view, inside in zip(views, truth_silhouettes, strict=True)]
    on_body = [mask & view.body for mask, view in zip(hidden, views, strict=True)]
    return {
        "hidden": _pooled(completed, truths, hidden, background),
        "on_body": _pooled(completed, truths, on_body, background),
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


def _euclidean(a: NDArray, b: NDArray) -> NDArray:
    return np.linalg.norm(a - b, axis=1)


def _delta_e(a: NDArray, b: NDArray) -> NDArray:
    from skimage.color import deltaE_ciede2000, rgb2lab

    return np.asarray(deltaE_ciede2000(rgb2lab(a), rgb2lab(b)))


def _from_seen(
    shown: Sequence[Sighting], seen: Sequence[Sighting], size: int, distances: Sequence[Distance]
) -> tuple[list[float], int]:
    """Mean distances of what is shown to the mean of all sightings, of all others where `shown` are the sightings
    themselves; NaN for none. And how many numbers have both."""
    channels = seen[0][1].shape[1] if seen else 3
    total, count = np.zeros((size, channels)), np.zeros(size, np.int64)
    for number, values in seen:
        total[number] += values
        count[number] += 1
    used, results = np.zeros(size, bool), [[np.zeros(0)] for _ in distances]
    for number, values in shown:
        known = count[number] > (shown is seen)
        number, values = number[known], values[known]
        used[number] = True
        others, n = total[number], count[number, None]
        if shown is seen:
            others, n = others - values, n - 1
        for out, distance in zip(results, distances, strict=True):
            out.append(distance(values, others / n))
    return [_mean(np.concatenate(values)) for values in results], int(used.sum())


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
    changes = [np.zeros((0, 3))]
    for (a, x), (b, y) in pairwise(sightings):
        _, i, j = np.intersect1d(a, b, assume_unique=True, return_indices=True)
        changes.append(np.abs(x[i] - y[j]))
    return _mean(np.concatenate(changes))


def _mean(values: NDArray) -> float:
    return float(values.mean(dtype=np.float64)) if values.size else math.nan


# ------------------------------------------------------------------------------------------------ scores


def _pooled(
    completed: Sequence[Image],
    truths: Sequence[Image],
    masks: Sequence[NDArray[np.bool_]],
    background: tuple[float, float, float],
) -> dict[str, float]:
    """PSNR, SSIM and FLIP over all pixels of the masks; NaN without any."""
    counts, errors, ssims, flips = [], [], [], []
    for painted, truth, mask in zip(completed, truths, masks, strict=True):
        n = int(mask.sum())
        if n:
            counts.append(n)
            errors.append(n * 10 ** (-psnr(painted, truth, mask) / 10))
            ssims.append(n * ssim(painted, truth, mask, background=background))
            flips.append(n * flip(painted, truth, mask, background=background))
    pixels = sum(counts)
    if not pixels:
        return dict.fromkeys(("psnr", "ssim", "flip"), math.nan)
    return {
        "psnr": decibels(sum(errors) / pixels),
        "ssim": math.fsum(ssims) / pixels,
        "flip": math.fsum(flips) / pixels,
    }
