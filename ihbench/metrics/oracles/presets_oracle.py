"""Each preset spelled out once more, in float64, from what its released evaluator does step by step.

Nothing here uses the fast metrics or `presets.py`: every step is a line on whole arrays, and the sums are those of
the oracles. LPIPS is asked of a function, because it needs a network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.oracles.flip_oracle import flip_oracle
from ihbench.metrics.oracles.oracle import psnr_channels_oracle, psnr_oracle, ssim_map_oracle, ssim_oracle, unit

Image = NDArray[np.float64]  # [H, W, 3]
Masks = Mapping[str, NDArray[np.bool_]]
Scores = dict[str, float]  # identity string -> value
Distance = Callable[[str, str, Image, Image], float]  # net, feed, pred and truth in [0, 1] -> LPIPS

UNIFORM = {"window": 7, "sigma": None, "sample": True, "data_range": 2.0}  # scikit-image on float images, then


def preset_oracle(
    name: str,
    pred: NDArray,  # [H, W, 3] float in [0, 1] or uint8
    truth: NDArray,  # as pred
    masks: Masks,  # name -> [H, W]
    background: tuple[float, float, float],
    lpips: Distance,
) -> dict[str, float]:
    """Identity string -> value, for the named preset over regions whose masks are given (`full` always is)."""
    return ORACLES[name](pred, truth, masks, np.asarray(background, np.float64), lpips)


def _ihbench(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x, y = (np.floor(np.clip(unit(image), 0, 1) * 255 + 0.5) / 255 for image in (pred, truth))
    white = bool((background == 1).all())
    out = {}
    for region, mask in masks.items():
        if region.startswith("box+"):
            continue
        inside, paint, a, b = None, "", x, y
        if region != "full":
            inside = mask
            paint = "" if white else "bg" + ",".join(f"{value:g}" for value in background) + "/"
            a, b = _cut(_painted(x, mask, background), _painted(y, mask, background), masks["box"])
        out[f"psnr/pooled/range1/{region}/v1"] = psnr_oracle(x, y, inside)
        out[f"ssim/gauss11-1.5/range1/{region}/{paint}v1"] = ssim_oracle(x, y, inside, background=tuple(background))
        out[f"flip/ldr-67ppd/srgb/{region}/{paint}v1"] = flip_oracle(x, y, inside, tuple(background))
        out[f"lpips/vgg-0.1/[-1,1]/{region}/{paint}v1"] = lpips("vgg", "[-1,1]", a, b)
    return out


def _neuralbody(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    box = masks["box+0.05"]
    x, y = unit(pred), unit(truth)
    a, b = _cut(_painted(x, box, background), _painted(y, box, background), box)
    return {
        "psnr/neuralbody-pooled/range1/box+0.05/v1": psnr_oracle(x, y, box),
        "ssim/neuralbody-uniform7/range2/box+0.05/v1": ssim_oracle(a, b, crop=3, **UNIFORM),
    }


def _humannerf(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x, y = (_cast_to_8bit(_painted(image, masks["box+0.3"], background)) for image in (pred, truth))
    return {
        "psnr/humannerf-pooled/range1/full/v1": psnr_oracle(x, y),
        "ssim/humannerf-uniform7/range2/full/v1": ssim_oracle(x, y, crop=3, **UNIFORM),
        "lpips/humannerf-vgg/[-1,1]/full/v1": lpips("vgg", "[-1,1]", x, y),
    }


def _occnerf(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x, y = (_cast_to_8bit(_painted(image, masks["box+0.3"], background)) for image in (pred, truth))
    values = ssim_map_oracle(x, y, **UNIFORM)
    out = {
        "psnr/occnerf-pooled/range1/full/v1": psnr_oracle(x, y),
        "ssim/occnerf-uniform7-map/range2/full/v1": math.fsum(values[3:-3, 3:-3].flat) / values[3:-3, 3:-3].size,
    }
    for region in ("body", "visible", "box+0.3"):
        inside = values[masks[region]].ravel()
        out[f"psnr/occnerf-pooled/range1/{region}/v1"] = psnr_oracle(x, y, masks[region])
        out[f"ssim/occnerf-uniform7-map/range2/{region}/v1"] = math.fsum(inside) / len(inside)
    return out


def _gauhuman(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x = np.clip(unit(_painted(pred, masks["box+0.05"], background)), 0, 1)
    y = np.clip(unit(truth), 0, 1)
    return {
        "psnr/gauhuman-channels/range1/full/v1": psnr_channels_oracle(x, y),
        "ssim/gauhuman-gauss11-zero/range1/full/v1": ssim_oracle(x, y, border="zero"),
        "lpips/gauhuman-vgg/[0,1]/full/v1": lpips("vgg", "[0,1]", x, y),
    }


def _3dgs_avatar_zju(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x, y = unit(pred), unit(truth)
    return {
        "psnr/3dgs-avatar-zju-pooled/range1/full/v1": psnr_oracle(x, y),
        "ssim/3dgs-avatar-zju-uniform7/range2/full/v1": ssim_oracle(x, y, crop=3, **UNIFORM),
        "lpips/3dgs-avatar-zju-vgg/[-1,1]/full/v1": lpips("vgg", "[-1,1]", x, y),
    }


def _instantavatar(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    x, y = (np.floor(np.clip(unit(image), 0, 1) * 255 + 0.5) / 255 for image in (pred, truth))
    return {
        "psnr/instantavatar-pooled/range1/full/v1": psnr_oracle(x, y),
        "ssim/instantavatar-gauss11-crop5/range1/full/v1": ssim_oracle(x, y, crop=5, border="reflect"),
        "ssim/instantavatar-gauss11/range1/full/v1": ssim_oracle(x, y, border="reflect"),
        "lpips/instantavatar-alex/[0,1]/full/v1": lpips("alex", "[0,1]", x, y),
    }


def _gtu_mask(pred: NDArray, truth: NDArray, masks: Masks, background: NDArray, lpips: Distance) -> Scores:
    mask = masks["body"]
    x, y = (unit(image) * mask[..., None] for image in (pred, truth))
    values = ssim_map_oracle(x, y, border="reflect")[5:-5, 5:-5]
    inside = values[mask[5:-5, 5:-5]].ravel()
    area = 10 * math.log10(mask.sum() / mask.size)
    grey = [np.where(mask[..., None], image, 0.5) for image in (x, y)]
    return {
        "psnr/gtu-mask-pooled/range1/body/v1": psnr_oracle(x, y) + area,
        "ssim/gtu-mask-gauss11-crop5/range1/body/v1": math.fsum(inside) / len(inside),
        "lpips/gtu-mask-alex/[-1,1]/body/v1": lpips("alex", "[-1,1]", *grey),
    }


def _painted(image: NDArray, mask: NDArray[np.bool_], background: NDArray) -> NDArray:
    paint = background * 255 if image.dtype == np.uint8 else background
    return np.where(mask[..., None], image, paint.astype(image.dtype))


def _cast_to_8bit(image: NDArray) -> Image:
    """(255 clip(image)).astype(uint8) / 255, the product in the image's own precision."""
    if image.dtype == np.uint8:
        return image / 255.0
    return (image.dtype.type(255) * np.clip(image, 0, 1)).astype(np.uint8) / 255.0


def _cut(pred: Image, truth: Image, mask: NDArray[np.bool_]) -> tuple[Image, Image]:
    """Both images cut to the mask's bounding rectangle."""
    rows, columns = np.nonzero(mask)
    cut = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    return pred[cut], truth[cut]


ORACLES = {
    "ihbench": _ihbench,
    "neuralbody": _neuralbody,
    "humannerf": _humannerf,
    "occnerf": _occnerf,
    "gauhuman": _gauhuman,
    "3dgs-avatar-zju": _3dgs_avatar_zju,
    "instantavatar": _instantavatar,
    "gtu-mask": _gtu_mask,
}
