"""Every metric of a preset, over every region of one frame."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.metrics.identity import Identity, Score, background_part
from ihbench.metrics.psnr import check_images, peak_of, pooled_psnr, squared_error
from ihbench.metrics.ssim import differing_pixels, mean_ssim

Color = tuple[float, float, float]
Region = NDArray[np.bool_] | str | None  # a mask [H, W], the reason why there is none, or the whole frame


@dataclass(frozen=True)
class Frame:
    """Two images as a preset prepared them, with the work its regions and metrics share."""

    pred: NDArray  # [H, W, C]
    truth: NDArray  # [H, W, C]
    background: Color

    @cached_property
    def squared_error(self) -> NDArray:
        return squared_error(self.pred, self.truth)  # [H, W]

    @cached_property
    def differs(self) -> NDArray[np.bool_]:
        return differing_pixels(self.pred, self.truth)  # [H, W]


@dataclass(frozen=True)
class Measure:
    """One metric of a preset: how it is named over a region, and how it is computed.

    `compute` gets a mask with at least one pixel, or None for the whole frame. It returns the number, or a string
    that says why there is none.
    """

    identity: Callable[[str, Color], Identity]
    compute: Callable[[Frame, NDArray[np.bool_] | None], float | str]


@dataclass(frozen=True)
class Preset:
    """A named set of metrics and what is done to both images before them."""

    name: str
    about: str
    prepare: Callable[[NDArray, NDArray], tuple[NDArray, NDArray]]
    measures: tuple[Measure, ...]


def evaluate(
    pred: NDArray,  # [H, W, 3] float in [0, 1] or uint8, on the protocol's background
    truth: NDArray,  # as pred
    regions: Mapping[str, Region] | None = None,
    preset: str = "ihbench",
    background: Color = (1.0, 1.0, 1.0),
) -> dict[str, Score]:
    """Score one frame: identity string -> score, for every region and every metric of the preset.

    A region is a bool mask [H, W], None for the whole frame, or a string: the reason why it does not exist here,
    which becomes the reason of its scores. No regions means the whole frame, `full`. `background` is what the images
    were composited on and what is painted outside a region. Raises `ValueError` for shapes and dtypes that do not
    match, `BadInput` for an unknown preset.
    """
    chosen = find_preset(preset)
    frame = Frame(*chosen.prepare(pred, truth), background)
    check_images(frame.pred, frame.truth)
    scores = {}
    for name, region in ({"full": None} if regions is None else regions).items():
        if isinstance(region, np.ndarray):
            check_images(frame.pred, frame.truth, region)
            covered = int(np.count_nonzero(region))
            region = "empty region in this view" if covered == 0 else None if covered == region.size else region
        for measure in chosen.measures:
            identity = str(measure.identity(name, frame.background))
            outcome = region if isinstance(region, str) else measure.compute(frame, region)
            scores[identity] = _score(outcome, identity)
    return scores


def find_preset(name: str) -> Preset:
    """The preset of that name. Raises `BadInput` with the nearest names."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, cutoff=0.4) or sorted(PRESETS)
        raise BadInput(f"metric preset {name!r}: not known; nearest: {', '.join(near)}")
    return PRESETS[name]


def round_both_to_8bit(pred: NDArray, truth: NDArray) -> tuple[NDArray, NDArray]:
    """Both images as they would be read back from PNG files; values outside [0, 1] are clipped.

    A pixel that is not finite has no 8-bit value: then both images stay float and the pixel becomes NaN.
    """
    rounded = []
    for image in (pred, truth):
        if isinstance(image, np.ndarray) and np.issubdtype(image.dtype, np.floating):
            image = np.rint(np.clip(np.where(np.isfinite(image), image, np.nan), 0, 1) * 255)
        rounded.append(image)
    if any(image.dtype != np.uint8 and np.isnan(image).any() for image in rounded):
        return rounded[0].astype(np.float64) / 255, rounded[1].astype(np.float64) / 255
    return rounded[0].astype(np.uint8), rounded[1].astype(np.uint8)


def _score(outcome: float | str, identity: str) -> Score:
    if isinstance(outcome, str):
        return Score.missing(identity, outcome)
    if math.isnan(outcome):
        return Score.missing(identity, "NaN or infinite pixel in the region")
    return Score(outcome, identity)


def _psnr(frame: Frame, mask: NDArray[np.bool_] | None) -> float:
    return pooled_psnr(frame.squared_error, mask, frame.pred.shape, peak_of(frame.pred.dtype))


def _ssim(frame: Frame, mask: NDArray[np.bool_] | None) -> float:
    return mean_ssim(frame.pred, frame.truth, frame.differs, mask, background=frame.background)


def _psnr_identity(region: str, background: Color) -> Identity:
    return Identity("psnr", "pooled", "range1", region, version=1)


def _ssim_identity(region: str, background: Color) -> Identity:
    painted = "" if region == "full" else background_part(background)
    return Identity("ssim", "gauss11-1.5", "range1", region, version=1, background=painted)


PRESETS = {
    preset.name: preset
    for preset in [
        Preset(
            name="ihbench",
            about="8-bit images; PSNR pooled over pixels and channels; Gaussian SSIM, regions painted first",
            prepare=round_both_to_8bit,
            measures=(Measure(_psnr_identity, _psnr), Measure(_ssim_identity, _ssim)),
        ),
    ]
}
