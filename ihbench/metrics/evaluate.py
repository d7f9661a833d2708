"""Every metric of a preset, over every region of one frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.metrics.identity import Identity, Score
from ihbench.metrics.images import (
    Color,
    Mask,
    as_background,
    as_image,
    as_mask,
    bounds,
    check_brightness,
    check_images,
    differing_pixels,
    grown,
    in_colour,
    peak_of,
)
from ihbench.metrics.psnr import SquaredError

Region = Mask | str | None  # a mask [H, W], the reason why there is none, or the whole frame


@dataclass(frozen=True)
class Frame:
    """Two images as a preset prepared them, with the work its regions and metrics share."""

    pred: NDArray  # [H, W, C]
    truth: NDArray  # [H, W, C]
    background: Color
    regions: Mapping[str, Region] = field(default_factory=dict)  # of the frame, for metrics that crop to one
    whole: dict[str, float] = field(default_factory=dict)  # values over the whole frame that a metric may use again

    @cached_property
    def differs(self) -> Mask:
        return differing_pixels(self.pred, self.truth)  # [H, W]

    @cached_property
    def foreground(self) -> Mask:
        """[H, W] True where either image is anything but background."""
        paint = np.asarray(self.background) * peak_of(self.pred.dtype)
        plain = paint.astype(self.pred.dtype)
        if (plain != paint).any():  # no pixel of this type has exactly the painted colour
            return np.ones(self.differs.shape, np.bool_)
        out = self.differs.copy()  # where they do not differ, one of them tells
        for channel, value in enumerate(plain):
            out |= self.truth[..., channel] != value
        return out

    def all_within(
        self,
        mask: Mask,  # [H, W]
        radius: int,
    ) -> bool:
        """Whether a window metric's sum over the frame is its sum over the mask, painted or not: outside the mask
        both images are background already, and no window of this radius there reaches a pixel that differs. The
        projected box of a body is such a mask as a rule."""
        if (self.foreground & ~mask).any():
            return False
        area = bounds(self.differs)
        if area is None:
            return True
        rows, columns = grown(area, radius, mask.shape)
        if mask[rows, columns].all():
            return True
        import cv2

        reached = cv2.dilate(self.differs[rows, columns].astype(np.uint8), np.ones((2 * radius + 1, 2 * radius + 1)))
        return not (reached.astype(np.bool_) & ~mask[rows, columns]).any()

    @cached_property
    def squared_error(self) -> SquaredError:
        return SquaredError.of(self.pred, self.truth, self.differs)


@dataclass(frozen=True)
class Measure:
    """One metric of a preset: how it is named over a region, and how it is computed.

    `compute` gets a mask with at least one pixel, or None for the whole frame. It returns the number, or a string
    that says why there is none.
    """

    identity: Callable[[str, Color], Identity]
    compute: Callable[[Frame, Mask | None], float | str]
    about: str  # the definition in a line, for `ihbench list metrics`
    regions: tuple[str, ...] | None = None  # the regions it is taken over; None for all that are asked for
    slow: bool = False  # left out where only a glimpse is wanted, as on the quality-time curve
    lacking: Callable[[], str] = str  # why it cannot be computed here; "" when it can


@dataclass(frozen=True)
class Preset:
    """A named set of metrics and what is done to both images before them.

    `prepare(pred, truth, regions, background)` returns both images, or a string that says why it cannot. `needs` are
    regions that it or the measures read; a scorer provides them beside those that are asked for.
    """

    name: str
    about: str
    source: str  # whose definition, to the line
    prepare: Callable[[NDArray, NDArray, Mapping[str, Region], Color], tuple[NDArray, NDArray] | str]
    measures: tuple[Measure, ...]
    needs: tuple[str, ...] = ()

    def identities(self, asked: Sequence[str], background: Color = (1.0, 1.0, 1.0)) -> tuple[str, ...]:
        """The identity strings of its scores, in order."""
        return tuple(
            str(measure.identity(name, background))
            for name in self.regions(asked)
            for measure in self.measures
            if measure.regions is None or name in measure.regions
        )

    def lacking(self) -> tuple[str, ...]:
        """Why metrics of it cannot be computed on this machine; scores that were made then are worth making again."""
        return tuple(reason for measure in self.measures if (reason := measure.lacking()))

    def absent(self, asked: Sequence[str], background: Color, reason: str) -> dict[str, Score]:
        """The scores of a frame that was not there."""
        return {i: Score.missing(i, reason) for i in self.identities(asked, background)}

    def regions(self, asked: Sequence[str]) -> tuple[str, ...]:
        """The regions that the preset takes numbers over when a protocol asks for some."""
        return tuple(dict.fromkeys(name for measure in self.measures for name in measure.regions or asked))


def evaluate(
    pred: Any,  # [H, W, 3] or [H, W], float in [0, 1] or uint8, on the protocol's background
    truth: Any,  # as pred
    regions: Mapping[str, Region] | None = None,
    preset: str | Preset = "ihbench",
    background: Color = (1.0, 1.0, 1.0),
    slow: bool = True,
    over: Sequence[str] | None = None,
    withheld: Mapping[str, str] | None = None,
    hdr: bool = False,
) -> dict[str, Score]:
    """Score one frame: identity string -> score, for every region and every metric of the preset.

    A region is a bool mask [H, W], None for the whole frame, or a string: the reason why it does not exist here,
    which becomes the reason of its scores. No regions means the whole frame, `full`. Numbers are taken over all of
    them, or over those named in `over`, the others serving as crops; none is taken over a region in `withheld`, which
    says why, and which may still serve as a crop. A preset that has regions of its own (the
    released evaluators do) takes those, and a region it needs that is not given is a reason too.
    `background` is what the images were composited on and what is painted outside a region. `slow=False` leaves out
    the metrics that take a network; `hdr=True` takes floats of any range, which a preset may clip. Raises
    `ValueError` for shapes that do not match, for what is no image (`images.as_image`; here one of the two may be
    uint8, the other float) and for a background outside [0, 1], `BadInput` for an unknown preset.
    """
    chosen = preset if isinstance(preset, Preset) else find_preset(preset)
    pred, truth = (in_colour(as_image(image, name, hdr=hdr)) for image, name in ((pred, "pred"), (truth, "truth")))
    check_images(pred, truth, mixed=True)
    if not hdr and (pred.dtype == np.uint8) == (truth.dtype == np.uint8):
        check_brightness(pred, truth)
    as_background(background, 3)
    given = {name: _checked_region(region, pred.shape) for name, region in (regions or {"full": None}).items()}
    given.setdefault("full", None)
    asked = tuple(over if over is not None else regions or ("full",))
    prepared = chosen.prepare(pred, truth, given, background)
    frame = None if isinstance(prepared, str) else Frame(*prepared, background, given)
    if frame is not None:
        check_images(frame.pred, frame.truth)
    measures = [measure for measure in chosen.measures if slow or not measure.slow]
    scores: dict[str, Score] = {}
    known: list[tuple[Mask | None, dict[int, float | str]]] = []
    for name in chosen.regions(asked):
        region = (withheld or {}).get(name) or given.get(name, f"region {name!r} was not given")
        outcomes: dict[int, float | str] = {}
        if frame is not None and not isinstance(region, str):
            outcomes = _known_outcomes(region, known)
        for k, measure in enumerate(measures):
            if measure.regions is not None and name not in measure.regions:
                continue
            identity = str(measure.identity(name, background))
            if frame is None:
                scores[identity] = Score.missing(identity, str(prepared))
            elif isinstance(region, str):
                scores[identity] = Score.missing(identity, region)
            else:
                if k not in outcomes:
                    outcomes[k] = measure.compute(frame, region)
                scores[identity] = _score(outcomes[k], identity)
    return scores


def find_preset(name: str) -> Preset:
    """The registered preset of that name. Raises `BadInput` with the nearest names."""
    registered = registry.load("metric preset", name)
    if not isinstance(registered, Preset):
        raise BadInput(f"metric preset {name!r}: registered object is no ihbench.metrics.evaluate.Preset")
    return registered


def _known_outcomes(region: Mask | None, known: list[tuple[Mask | None, dict[int, float | str]]]) -> dict:
    """What was computed for an equal region of this frame; `visible` is often all of `body`."""
    for mask, outcomes in known:
        if mask is region or (mask is not None and region is not None and np.array_equal(mask, region)):
            return outcomes
    known.append((region, {}))
    return known[-1][1]


def _checked_region(region: Any, shape: tuple[int, ...]) -> Region:
    """The region as a mask with both states, None for a mask of everything, a reason for one of nothing."""
    if isinstance(region, str):
        return region
    if region is None:
        return None if shape[0] * shape[1] else "an image without a pixel"
    mask = as_mask(region, shape)
    covered = int(np.count_nonzero(mask))
    return "empty region in this view" if covered == 0 else None if covered == mask.size else mask


def _score(outcome: float | str, identity: str) -> Score:
    if isinstance(outcome, str):
        return Score.missing(identity, outcome)
    if math.isnan(outcome):
        return Score.missing(identity, "NaN or infinite pixel in the region")
    return Score(outcome, identity)
