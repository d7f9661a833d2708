"""What a ranking owes to choices that nobody ranks by: a mask's edge, half a pixel, 8 bits, a background, a preset.

The contestants are the truth, spoiled in one way each, and the bench's calibration rows, over test views of a drawn
person. They are ranked by every weight-free metric of the headline preset over the body, then ranked again with one
choice changed. Contestants that are spoiled in the same way, ever more, must keep their order whatever is changed.
Those that are spoiled in different ways need not: where the order flips, the case is known to fail and its note says
who changed places with whom.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics import mean_over_frames
from ihbench.metrics.eight_bit import as_float
from ihbench.metrics.evaluate import Preset, evaluate, find_preset
from ihbench.metrics.identity import metric_of
from ihbench.scoring.calibration import Calibration
from ihbench.stress.case import Answer, Case
from ihbench.stress.drawn_capture import SIZE, small_protocol, turning_capture

Image = NDArray[np.float32]  # [H, W, 3] in [0, 1]
Color = tuple[float, float, float]

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
LADDERS = (("blur 0.6 px", "blur 1.2 px", "blur 2.4 px"), ("noise 2 %", "noise 4 %", "noise 8 %"))
ROWS = ("nearest-frame", "mean-colour-body", "pasted-texture")
METRICS = ("psnr", "ssim", "flip")
PRESETS = ("neuralbody", "humannerf", "occnerf", "gauhuman", "3dgs-avatar-zju", "instantavatar", "gtu-mask")


@dataclass(frozen=True)
class Frame:
    """One test view and what every contestant shows of it."""

    truth: Image
    regions: dict[str, NDArray[np.bool_] | str]
    images: dict[str, Image]


@dataclass(frozen=True)
class Flip:
    """Two contestants that change places: means by name, before and after."""

    metric: str
    before: tuple[tuple[str, float], tuple[str, float]]  # the better one first
    after: tuple[float, float]  # in the same order

    def __str__(self) -> str:
        (a, x), (b, y) = self.before
        return f"{self.metric}: {a} ({x:.4g} → {self.after[0]:.4g}) and {b} ({y:.4g} → {self.after[1]:.4g})"


def flips(before: Mapping[str, float], after: Mapping[str, float], metric: str) -> list[Flip]:
    """The pairs that one ranking has one way round and the other the other way; ties are no flips."""
    sign = 1 if metric_of(metric.partition("/")[0]).higher_is_better else -1
    flips = []
    for a, b in combinations(before, 2):
        if sign * before[a] < sign * before[b]:
            a, b = b, a
        if before[a] != before[b] and sign * after[a] < sign * after[b]:
            flips.append(Flip(metric, ((a, before[a]), (b, before[b])), (after[a], after[b])))
    return flips


def means(frames: Sequence[Frame], preset: Preset, region: str, metric: str, background: Color) -> dict[str, float]:
    """Every contestant's mean over the frames of one metric, over a region or the preset's own first one."""
    means = {}
    for name in frames[0].images:
        scores = []
        for frame in frames:
            scored = evaluate(frame.images[name], frame.truth, frame.regions, preset, background, False, [region])
            scores.append(next(s for identity, s in scored.items() if identity.startswith(f"{metric}/")))
        means[name] = mean_over_frames(scores).value
    return means


# ----------------------------------------------------------------------------------------------------
# The contestants


@cache
def field(background: Color = WHITE) -> tuple[Frame, ...]:
    """Four test views of a person half hidden in training, on a background, and all contestants."""
    from ihbench.scene.views import open_scene
    from ihbench.scoring.scoring import Scorer

    capture = turning_capture(6)
    protocol = small_protocol(n_frames=6, size=SIZE)
    protocol = replace(protocol, image=replace(protocol.image, background=background))
    scorer = Scorer.build(open_scene(capture, protocol))
    calibration = Calibration.build(scorer.scene.training)
    paint = np.asarray(background, np.float32)
    frames = []
    for index in (0, 2, 3, 5):
        view = scorer.load(index).view
        names = ("full", "box", "body", "visible", "hidden", "never_seen", "box+0.05", "box+0.3")
        regions = scorer.surface.regions(view, names, protocol.metrics.box_padding)
        images = spoiled(view.image, view.silhouette, paint, index)
        images |= {row: calibration.predict(row, view) for row in ROWS}
        frames.append(Frame(view.image, regions, images))
    return tuple(frames)


def spoiled(truth: Image, person: NDArray[np.bool_], paint: NDArray[np.float32], seed: int) -> dict[str, Image]:
    """The truth, spoiled in one way each."""
    from scipy.ndimage import binary_erosion, gaussian_filter

    rng = np.random.default_rng(seed)
    noise = rng.normal(size=truth.shape).astype(np.float32)
    images = {
        name: np.where(person[..., None], truth + share * noise, truth)
        for name, share in zip(LADDERS[1], (0.02, 0.04, 0.08), strict=True)
    }
    for name, sigma in zip(LADDERS[0], (0.6, 1.2, 2.4), strict=True):
        images[name] = gaussian_filter(truth, (sigma, sigma, 0), mode="nearest")
    images["1 px aside"] = np.roll(truth, 1, axis=1)
    images["redder"] = np.where(person[..., None], truth * np.array([1.1, 0.97, 0.97], np.float32), truth)
    images["darker"] = np.where(person[..., None], truth * np.float32(0.93), truth)
    images["thinner"] = np.where(binary_erosion(person)[..., None], truth, paint)
    return {name: np.clip(image, 0, 1).astype(np.float32) for name, image in images.items()}


# ----------------------------------------------------------------------------------------------------
# The choices


def _dilated(frame: Frame) -> Frame:
    from scipy.ndimage import binary_dilation

    body = binary_dilation(np.asarray(frame.regions["body"]), np.ones((3, 3)))
    return replace(frame, regions={**frame.regions, "body": body})


def _shifted(frame: Frame) -> Frame:
    """All predictions half a pixel to the right and down: pixel centres at 0 taken for centres at 0.5."""
    images = {}
    for name, image in frame.images.items():
        padded = np.pad(image, ((1, 0), (1, 0), (0, 0)), "edge")
        total = padded[1:, 1:] + padded[:-1, 1:] + padded[1:, :-1] + padded[:-1, :-1]
        images[name] = np.asarray(total / 4, np.float32)
    return replace(frame, images=images)


@dataclass(frozen=True)
class Ranking:
    """Frames, and how they are scored."""

    frames: tuple[Frame, ...]
    preset: Preset
    region: str = "body"
    background: Color = WHITE


def _under(name: str) -> tuple[Ranking, Ranking]:
    """The ranking that a choice is compared with, and the ranking under it."""
    headline = find_preset("ihbench")
    usual = Ranking(field(), headline)
    if name in PRESETS:
        preset = find_preset(name)
        region = next(iter(preset.regions(["full"])))
        before = replace(usual, region=region if region in ("full", "body") else "box")
        return before, replace(before, preset=preset, region=region)
    in_floats = replace(headline, prepare=lambda pred, truth, *_: (as_float(pred), as_float(truth)))
    changed = {
        "1-px mask dilation": lambda: replace(usual, frames=tuple(map(_dilated, usual.frames))),
        "0.5-px shift": lambda: replace(usual, frames=tuple(map(_shifted, usual.frames))),
        "no 8-bit rounding": lambda: replace(usual, preset=in_floats),
        "black background": lambda: replace(usual, frames=field(BLACK), background=BLACK),
    }
    return usual, changed[name]()


@cache
def compared(name: str) -> tuple[list[Flip], int]:
    """Every flip under a choice, over all metrics that both rankings have, and the number of pairs looked at."""
    before, after = _under(name)
    metrics = METRICS if before.preset.name == after.preset.name else METRICS[:2]  # released evaluators lack FLIP
    got: list[Flip] = []
    pairs = 0
    for metric in metrics:
        old, new = (means(r.frames, r.preset, r.region, metric, r.background) for r in (before, after))
        got += flips(old, new, metric)
        pairs += len(old) * (len(old) - 1) // 2
    return got, pairs


def _ladder(name: str) -> Answer:
    """Flips within a ladder of the same error."""
    same = [f for f in compared(name)[0] if any({a for a, _ in f.before} <= set(ladder) for ladder in LADDERS)]
    return Answer(len(same), 0, note="; ".join(map(str, same)))


def _open_field(name: str) -> Answer:
    """Flips between errors of different kinds."""
    got, pairs = compared(name)
    if not got:
        return Answer(0, 0, note=f"no pair of {pairs} changes places")
    shown = "; ".join(map(str, got[:3])) + (f"; and {len(got) - 3} more" if len(got) > 3 else "")
    return Answer(len(got), 0, note=f"the order flips under {name} for {len(got)} of {pairs} pairs: {shown}")


LAW = "more of the same error is worse, whatever else is chosen"
OPEN = "pairs that change places; a ranking that is worth its name would have none"
CHOICE = "rankings of unlike errors depend on this choice: it belongs to a protocol, and to every number's identity"
CHOICES = ("1-px mask dilation", "0.5-px shift", "no 8-bit rounding", "black background", *PRESETS)
KEPT = ("no 8-bit rounding", "gauhuman", "instantavatar")  # the order of these contestants does not flip under them


def _ranking(kind: str, choice: str, why: str, function: Callable[[str], Answer], known: str = "") -> Case:
    named = choice.replace(" ", "-")
    what = f"under the preset {choice}" if choice in PRESETS else f"under {choice}"
    return Case(f"{kind}-{named}", what, partial(function, choice), "absolute", 0, why, "ranking", known)


CASES = [
    *(_ranking("ladder", choice, LAW, _ladder) for choice in CHOICES),
    *(_ranking("order", choice, OPEN, _open_field, "" if choice in KEPT else CHOICE) for choice in CHOICES),
]
