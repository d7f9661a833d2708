"""The metrics against float64 oracles, other people's libraries and stored values. Behind `ihbench metrics check`.

A comparison is one number of ours beside one of somebody else's, with the difference that is allowed and why. What
cannot be compared here (a library that is not installed, weights that are missing) is said, and is no failure.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics import lpips
from ihbench.metrics.evaluate import Preset, evaluate, find_preset
from ihbench.metrics.flip import flip
from ihbench.metrics.oracles.cases import Case, person_case
from ihbench.metrics.oracles.libraries import as_torch, official_flip
from ihbench.metrics.oracles.oracle import psnr_channels_oracle
from ihbench.metrics.oracles.presets_oracle import ORACLES, preset_oracle
from ihbench.metrics.oracles.reference_values import STORED
from ihbench.metrics.psnr import mean_of_channels, psnr
from ihbench.metrics.ssim import Window, ssim, ssim_map

BACKGROUNDS = {"": (1.0, 1.0, 1.0), ", tinted": (0.2, 0.4, 0.6)}
WHITE = BACKGROUNDS[""]
LIBRARY_SIZE = 96, 80  # px; large enough for every library's window and for LPIPS
EXAMPLES = {"ex_p0.png": 0.722, "ex_p1.png": 0.138}  # against ex_ref.png, alex v0.1: richzhang/PerceptualSimilarity

# the largest difference allowed, and why it is that
EXACT = 1e-10, "both sum in float64; only the order of sums differs"
FLOAT64 = 1e-7, "the library works in float64 on the same definition; rounding only"
FLOAT32_KERNEL = 1e-6, "the library makes its Gaussian weights in float32"
FLOAT32 = 2e-5, "the reference works in float32"
NETWORK = 1e-5, "float32 sums over the channels of a network; relative to the value"
THREE_DIGITS = 5e-4, "published with three decimals"


@dataclass(frozen=True)
class Comparison:
    """One number of ours beside one of somebody else's."""

    metric: str  # identity string, or the function and what it was asked
    case: str
    reference: str  # "oracle", "scikit-image 0.26.0", "stored", ...
    ours: float
    theirs: float
    tolerance: float
    why: str  # that tolerance; or why there is nothing to compare
    absent: bool = False

    @property
    def difference(self) -> float:
        """0 for equal numbers, infinities and NaN included; inf where only one of the two is finite."""
        if self.ours == self.theirs or (math.isnan(self.ours) and math.isnan(self.theirs)):
            return 0.0
        if not (math.isfinite(self.ours) and math.isfinite(self.theirs)):
            return math.inf
        return abs(self.ours - self.theirs)

    @property
    def ok(self) -> bool:
        return self.absent or self.difference <= self.tolerance


def check(presets: Sequence[Preset] | None = None, examples: Path | None = None) -> list[Comparison]:
    """Every comparison that can be made here. `presets` are the bench's own by default.

    `examples` is a folder with the example images of the LPIPS authors, whose values they publish; they are compared
    when the weights are there too.
    """
    chosen = [find_preset(name) for name in ORACLES] if presets is None else list(presets)
    with ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")  # of other people's libraries
        published = list(_published_lpips(examples))
        networks = stack.enter_context(lpips.random_networks())
        return [
            *_against_oracles(chosen, networks),
            *_against_stored(chosen),
            *_against_libraries(),
            *_lpips_against_package(networks),
            *published,
        ]


def mismatches(comparisons: Sequence[Comparison]) -> list[Comparison]:
    return [comparison for comparison in comparisons if not comparison.ok]


# ----------------------------------------------------------------------------------------------------
# Oracles and stored values


def _cases() -> list[Case]:
    return [person_case(dtype=dtype) for dtype in (np.float32, np.float64, np.uint8)]


def _scores(preset: Preset, case: Case, background: tuple[float, float, float]) -> dict[str, float]:
    asked = [name for name in case.regions if "+" not in name]
    scores = evaluate(case.pred, case.truth, case.regions, preset, background, over=asked)
    return {identity: score.value for identity, score in scores.items()}


def _against_oracles(presets: Sequence[Preset], networks: dict[str, lpips.Network]) -> Iterator[Comparison]:
    """Every measure of every preset, over every region it has, against its float64 twin."""
    for preset in presets:
        for case in _cases():
            for note, background in BACKGROUNDS.items():
                if note and case.pred.dtype != np.float32:
                    continue
                name = case.name + note
                ours = _scores(preset, case, background)
                twin = preset_oracle(
                    preset.name, case.pred, case.truth, case.regions, background,
                    lambda net, feed, x, y: package_distance(networks[net].package, feed, x, y),
                )  # fmt: skip
                for identity in dict.fromkeys([*ours, *twin]):
                    theirs = twin.get(identity, math.nan)
                    allowed = _of_network(theirs) if identity.startswith("lpips") else EXACT
                    yield Comparison(identity, name, "oracle", ours.get(identity, math.nan), theirs, *allowed)


def _of_network(value: float) -> tuple[float, str]:
    return NETWORK[0] * abs(value), NETWORK[1]


def _against_stored(presets: Sequence[Preset]) -> Iterator[Comparison]:
    """Numbers written down once, so that oracle and metric cannot drift together."""
    case = person_case(*LIBRARY_SIZE, dtype=np.uint8)
    for preset in presets:
        ours = _scores(preset, case, WHITE)
        for identity, value in STORED.get(preset.name, {}).items():
            allowed = FLOAT32 if identity.startswith("flip") else FLOAT64
            yield Comparison(identity, case.name, "stored", ours.get(identity, math.nan), value, *allowed)


# ----------------------------------------------------------------------------------------------------
# Libraries


def _against_libraries() -> Iterator[Comparison]:
    for dtype in (np.float64, np.float32):
        case = person_case(*LIBRARY_SIZE, dtype=dtype)
        x, y = (image.astype(np.float64) for image in (case.pred, case.truth))
        for reference, package, compare in (
            ("scikit-image", "skimage", _scikit_image),
            ("torchmetrics", "torchmetrics", _torchmetrics),
            ("kornia", "kornia", _kornia),
            ("flip-evaluator", "flip_evaluator", _flip_evaluator),
        ):
            if find_spec(package) is None:
                why = f"{reference} is not installed: pip install 'ihbench[reference]'"
                yield Comparison("all", case.name, reference, math.nan, math.nan, 0.0, why, absent=True)
                continue
            named = f"{reference} {metadata.version(reference)}"
            for metric, ours, theirs, (tolerance, why) in compare(case, x, y):
                yield Comparison(metric, case.name, named, ours, theirs, tolerance, why)
    case = person_case(*LIBRARY_SIZE)
    theirs = psnr_channels_oracle(case.pred, case.truth)
    yield Comparison("mean_of_channels", case.name, "oracle", mean_of_channels(case.pred, case.truth), theirs, *EXACT)


Outcome = tuple[str, float, float, tuple[float, str]]  # metric, ours, theirs, tolerance and why
INNER = np.s_[5:-5, 5:-5]  # where no window of 11 px reaches the edge


def _scikit_image(case: Case, x: NDArray, y: NDArray) -> Iterator[Outcome]:
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    yield "psnr", psnr(case.pred, case.truth), peak_signal_noise_ratio(y, x, data_range=1.0), FLOAT64
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    for label, options, window, region in (
        ("ssim gauss11, away from the edges", gaussian, Window(), INNER),
        ("ssim uniform7 map", {}, Window(7, None, sample=True), np.s_[:]),
    ):
        reference: Any = structural_similarity(x, y, data_range=1.0, channel_axis=2, full=True, **options)[1]
        ours = ssim_map(case.pred, case.truth, window=window)
        yield label, float(ours[region].mean()), float(reference[region].mean()), FLOAT64
    scalar: Any = structural_similarity(x, y, data_range=2.0, channel_axis=2)
    ours = ssim(case.pred, case.truth, window=7, sigma=None, data_range=2.0, crop=3, sample=True)
    yield "ssim uniform7 range2", ours, float(scalar), FLOAT64


def _torchmetrics(case: Case, x: NDArray, y: NDArray) -> Iterator[Outcome]:
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    a, b = as_torch(x), as_torch(y)
    yield "psnr", psnr(case.pred, case.truth), float(peak_signal_noise_ratio(a, b, data_range=1.0)), FLOAT32
    theirs: Any = structural_similarity_index_measure(a, b, data_range=1.0)
    yield "ssim gauss11 reflect", ssim(case.pred, case.truth, border="reflect"), float(theirs), FLOAT64


def _kornia(case: Case, x: NDArray, y: NDArray) -> Iterator[Outcome]:
    import kornia

    a, b = as_torch(x), as_torch(y)
    yield "psnr", psnr(case.pred, case.truth), float(kornia.metrics.psnr(a, b, 1.0)), FLOAT64
    theirs = kornia.metrics.ssim(a, b, 11, 1.0)[0].permute(1, 2, 0).numpy()
    ours = ssim_map(case.pred, case.truth, window=Window(border="reflect"))
    yield "ssim gauss11 reflect", float(ours.mean()), float(theirs.mean()), FLOAT32_KERNEL


def _flip_evaluator(case: Case, x: NDArray, y: NDArray) -> Iterator[Outcome]:
    yield "flip", flip(case.pred, case.truth), official_flip(x, y), FLOAT32


# ----------------------------------------------------------------------------------------------------
# LPIPS


def package_distance(
    package: Any,
    feed: str,
    pred: NDArray,  # [H, W, 3] float in [0, 1] or uint8
    truth: NDArray,  # as pred
) -> float:
    """What the `lpips` package itself says of two images [H, W, 3] in [0, 1]; small ones padded as ours are."""
    import torch

    images = []
    for image in (pred, truth):
        tensor = as_torch(lpips.padded(image)).float()
        images.append(2 * tensor - 1 if feed == "[-1,1]" else tensor)
    with torch.no_grad():
        return float(package(*images))


def _lpips_against_package(networks: dict[str, lpips.Network]) -> Iterator[Comparison]:
    """Our call path against the package's own on one seeded random trunk. Such a trunk never makes a result."""
    case = person_case(*LIBRARY_SIZE)
    for net, network in networks.items():
        for feed in lpips.FEEDS:
            ours = lpips.lpips(case.pred, case.truth, net=net, feed=feed)
            theirs = package_distance(network.package, feed, case.pred, case.truth)
            named = f"lpips {metadata.version('lpips')}"
            yield Comparison(
                f"lpips {net} {feed}, random trunk", case.name, named, ours, theirs, *_of_network(theirs)
            )


def _published_lpips(examples: Path | None) -> Iterator[Comparison]:
    what, case = "lpips alex [-1,1]", "authors' example pairs"
    absent: Callable[[str], Comparison] = lambda why: Comparison(  # noqa: E731
        what, case, "published", math.nan, math.nan, 0.0, why, absent=True
    )
    reason = lpips.lacking("alex")
    if reason:
        yield absent(reason)
        return
    if examples is None or not (examples / "ex_ref.png").is_file():
        yield absent("the example images (ex_ref.png, ex_p0.png, ex_p1.png) are not given: --lpips-examples DIR")
        return
    from ihbench.files.images import read_image

    truth = read_image(examples / "ex_ref.png", WHITE)
    for name, value in EXAMPLES.items():
        ours = lpips.lpips(read_image(examples / name, WHITE), truth, net="alex")
        yield Comparison(what, name, "published", ours, value, *THREE_DIGITS)
