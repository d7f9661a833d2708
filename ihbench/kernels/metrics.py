"""The metrics: their times on a 512² frame beside other people's libraries, and their errors against the oracles.

Errors are those of the mean over a smaller pair of images of the same kind, where the oracle takes seconds; that of
LPIPS is the package it calls, in float64. Libraries that are not installed have no row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.threads import one_torch_thread, single_threaded_libraries
from ihbench.errors import BadInput
from ihbench.kernels.measuring import Row, Sample, interleave, peak_mib, row_of, timed
from ihbench.metrics.oracles.cases import Case, hashed, person_case
from ihbench.metrics.oracles.libraries import as_torch, official_flip

if TYPE_CHECKING:
    from ihbench.metrics.evaluate import Preset
    from ihbench.metrics.lpips import Network

SIZE = 512  # px; side of the timed frames
ERROR_SIZE = 48, 40  # px; of the frames that an oracle looks at
LPIPS_ERROR_SIZE = 320  # px; of the pair that the package sees in float64: three tiles a side
LPIPS_TILE = 128  # px; a multiple of every trunk's stride
TILED = "tiled"
DTYPES = (np.uint8, np.float16, np.float32, np.float64)
WHITE = (1.0, 1.0, 1.0)
FIGURES = {"1/20": (0.55, 0.27), "1/10": (0.75, 0.4), "1/3": (1.0, 1.0)}  # share of the frame -> of height, width
METRIC_SETS = {"psnr+ssim": ("psnr", "ssim"), "psnr+ssim+flip": ("psnr", "ssim", "flip")}
FRAME_REGIONS = ("full", "box", "body", "visible", "hidden", "never_seen")

Metric = Callable[..., float]  # of two images


def ssim_rows(repeats: int, size: int = SIZE) -> list[Row]:
    """SSIM of a frame on one core: ours for every dtype, scikit-image, torchmetrics, kornia, our loss in torch."""
    from ihbench.metrics.oracles.oracle import ssim_oracle
    from ihbench.metrics.ssim import ssim

    others: dict[str, tuple[type, Metric, str]] = {
        "torch loss f32": (np.float32, _ssim_torch, "mirror"),
        "scikit-image f64": (np.float64, _scikit_image, "cropped"),
    }
    if find_spec("torchmetrics") is not None:
        others["torchmetrics f32"] = (np.float32, _torchmetrics, "reflect")
    others["kornia f32"] = (np.float32, _kornia, "reflect")

    def oracle(small: Case, border: str) -> float:
        crop, border = (5, "mirror") if border == "cropped" else (0, border)
        return ssim_oracle(small.pred, small.truth, crop=crop, border=border)

    rows = []
    for case, make in (("every pixel", _noise_case), ("a person", person_case)):
        steps: dict[str, tuple[type, Metric, str]] = {_short(t): (t, ssim, "mirror") for t in DTYPES}
        rows += _compared("ssim", case, size, make, steps | others, oracle, repeats)
    return rows


def flip_rows(repeats: int, size: int = SIZE) -> list[Row]:
    """FLIP of a frame on one core: ours for every dtype, and NVIDIA's evaluator."""
    from ihbench.metrics.flip import flip
    from ihbench.metrics.oracles.flip_oracle import flip_oracle

    steps: dict[str, tuple[type, Metric, str]] = {_short(t): (t, flip, "") for t in DTYPES}
    if find_spec("flip_evaluator") is not None:
        steps["flip-evaluator f32"] = (np.float32, official_flip, "")
    oracle = lambda small, _: flip_oracle(small.pred, small.truth)  # noqa: E731
    return _compared("flip", "a person", size, person_case, steps, oracle, repeats)


def lpips_rows(repeats: int, size: int = SIZE, nets: Sequence[str] | None = None) -> list[Row]:
    """LPIPS of a frame through every trunk: ours whole and in tiles, and a person's crop, beside the package.

    Where a trunk's weights are not here it gets seeded random ones, which cost the same, and its rows say so. Errors
    are those on a smaller pair against the package in float64.
    """
    from contextlib import nullcontext

    from ihbench.metrics import lpips

    rows = []
    frame, small = person_case(size, size), person_case(LPIPS_ERROR_SIZE, LPIPS_ERROR_SIZE)
    for net in nets or lpips.NETS:
        lacking = lpips.lacking(net)
        with lpips.random_networks() if lacking else nullcontext():
            network = lpips.load(net)
            if isinstance(network, str):
                raise BadInput(network)
            steps = _lpips_steps(network, net, tile=max(LPIPS_TILE, size // 2 // LPIPS_TILE * LPIPS_TILE))
            checks = _lpips_steps(network, net, tile=LPIPS_TILE)
            timings = interleave({k: partial(_timed, f, frame) for k, f in steps.items()}, min(repeats, 3), warm_up=1)
            truths = _lpips_in_double(network, small)
            named = f"{net}, random trunk" if lacking else net
            for name in steps:
                region = "a person's crop" if "crop" in name else "whole frame"
                error = abs(checks[name](small.pred, small.truth) - truths["crop" in name])
                memory = peak_mib(lambda f=steps[name]: f(frame.pred, frame.truth))
                rows.append(row_of("lpips", f"{named}, {region}@{size}", name, timings[name], memory, error))
    return rows


def _lpips_steps(network: Network, net: str, tile: int) -> dict[str, Metric]:
    """Ways to the same number, and to that of a crop; `body` is the figure's region in a frame of any size."""
    from ihbench.metrics import lpips
    from ihbench.metrics.oracles.check import package_distance

    return {
        "ours f32": partial(lpips.lpips, net=net),
        f"ours f32, {TILED}": lambda x, y: network.distance(x, y, "[-1,1]", tile),
        "lpips package f32": partial(package_distance, network.package, "[-1,1]"),
        "ours f32, crop": lambda x, y: lpips.lpips(x, y, _body(x), net=net),
        "lpips package f32, crop": lambda x, y: package_distance(network.package, "[-1,1]", *_painted(x, y)),
    }


def _lpips_in_double(network: Network, small: Case) -> tuple[float, float]:
    """What the package says in float64 of the whole frame and of the crop."""
    import torch

    from ihbench.metrics.lpips import padded

    values = []
    package = network.package.double()
    try:
        for pair in ((small.pred, small.truth), _painted(small.pred, small.truth)):
            x, y = (2 * as_torch(padded(image)).double() - 1 for image in pair)
            with torch.no_grad():
                values.append(float(package(x, y)))
    finally:
        network.package.float()
    return values[0], values[1]


def _body(image: NDArray) -> NDArray[np.bool_]:
    return person_case(*image.shape[:2]).regions["body"]


def _painted(x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Both images cut to the figure and white around it, as LPIPS of a region is defined."""
    from ihbench.metrics.images import bounds

    mask = _body(x)
    rectangle = bounds(mask)
    assert rectangle is not None
    inside = mask[rectangle][..., None]
    return np.where(inside, x[rectangle], np.float32(1)), np.where(inside, y[rectangle], np.float32(1))


def frame_rows(repeats: int, size: int = SIZE) -> list[Row]:
    """PSNR and SSIM of a frame over six regions in one pass, on one core; and with FLIP.

    The figure takes a twentieth of the frame, as a stand-in's person does, or more.
    """
    from ihbench.metrics.evaluate import evaluate
    from ihbench.metrics.oracles.presets_oracle import preset_oracle

    rows = []
    for share, extent in FIGURES.items():
        frame, small = _framed_person(extent, size, size), _framed_person(extent, *ERROR_SIZE)
        steps, presets = {}, {name: headline_with(metrics) for name, metrics in METRIC_SETS.items()}
        for name, preset in presets.items():
            score = lambda x, y, p=preset: evaluate(x, y, _six(frame), p)  # noqa: E731, B023
            steps[name] = partial(_timed, score, frame)
        with single_threaded_libraries():
            timings = interleave(steps, repeats)
        truth = preset_oracle("ihbench", small.pred, small.truth, _six(small), WHITE, lambda *_: 0.0)
        for name, preset in presets.items():
            scores = evaluate(small.pred, small.truth, _six(small), preset)
            error = max(abs(score.value - truth[i]) for i, score in scores.items() if not np.isnan(score.value))
            memory = peak_mib(lambda p=preset, f=frame: evaluate(f.pred, f.truth, _six(f), p))
            rows.append(row_of("frame", f"6 regions, {share}@{size}", name, timings[name], memory, error))
    return rows


def _framed_person(extent: tuple[float, float], height: int, width: int, dtype: type = np.float32) -> Case:
    """The figure of `person_case` in the middle of a frame of which it takes this share of the height and width."""
    inner = person_case(int(height * extent[0]), int(width * extent[1]), dtype)
    rows, columns = inner.truth.shape[:2]
    top, left = (height - rows) // 2, (width - columns) // 2
    around = (top, height - rows - top), (left, width - columns - left)
    white = 255 if dtype == np.uint8 else 1
    pred, truth = (np.pad(x, (*around, (0, 0)), constant_values=white) for x in (inner.pred, inner.truth))
    regions = {name: np.pad(mask, around, constant_values=name == "full") for name, mask in inner.regions.items()}
    return Case(f"framed {inner.name}", pred, truth, regions)


def _compared(
    kernel: str,
    case: str,
    size: int,
    make: Callable[..., Case],
    steps: dict[str, tuple[type, Metric, str]],  # name -> dtype, metric, which oracle
    oracle: Callable[[Case, str], float],
    repeats: int,
) -> list[Row]:
    frames = {dtype: make(size, size, dtype) for dtype in {dtype for dtype, _, _ in steps.values()}}
    with single_threaded_libraries(), one_torch_thread():
        timings = interleave({k: partial(_timed, f, frames[t]) for k, (t, f, _) in steps.items()}, repeats)
        rows = []
        for name, (dtype, metric, which) in steps.items():
            frame, small = frames[dtype], make(*ERROR_SIZE, dtype)
            error = abs(metric(small.pred, small.truth) - oracle(small, which))
            memory = peak_mib(lambda f=metric, x=frame: f(x.pred, x.truth))
            rows.append(row_of(kernel, f"{case}@{size}", name, timings[name], memory, error))
    return rows


def _timed(metric: Callable[[NDArray, NDArray], Any], frame: Case) -> Sample:
    return timed(partial(metric, frame.pred, frame.truth))


def _short(dtype: type) -> str:
    return np.dtype(dtype).name.replace("float", "f").replace("uint", "u")


def _noise_case(height: int, width: int, dtype: type) -> Case:
    """Two unrelated textures: no window is equal in both."""
    images: Iterator[NDArray] = (hashed(seed, height, width) for seed in (1, 2))
    pred, truth = (image if dtype == np.uint8 else (image / 255).astype(dtype) for image in images)
    return Case(f"noise {np.dtype(dtype).name}", pred, truth, {})


def headline_with(metrics: tuple[str, ...]) -> Preset:
    """The bench's own preset with some of its metrics."""
    from ihbench.metrics.evaluate import find_preset

    whole = find_preset("ihbench")
    kept = [m for m in whole.measures if str(m.identity("full", WHITE)).split("/")[0] in metrics]
    return replace(whole, measures=tuple(kept))


def _six(frame: Case) -> dict[str, NDArray[np.bool_]]:
    return {name: frame.regions[name] for name in FRAME_REGIONS}


# ----------------------------------------------------------------------------------------------------
# Other libraries


def _ssim_torch(pred: NDArray, truth: NDArray) -> float:
    from ihbench.metrics.ssim_torch import ssim_map_torch

    return float(ssim_map_torch(as_torch(pred), as_torch(truth)).mean())


def _scikit_image(pred: NDArray, truth: NDArray) -> float:
    from skimage.metrics import structural_similarity

    value: Any = structural_similarity(
        truth, pred, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return float(value)


def _torchmetrics(pred: NDArray, truth: NDArray) -> float:
    from torchmetrics.functional.image import structural_similarity_index_measure

    value: Any = structural_similarity_index_measure(as_torch(pred), as_torch(truth), data_range=1.0)
    return float(value)


def _kornia(pred: NDArray, truth: NDArray) -> float:
    import kornia

    return float(kornia.metrics.ssim(as_torch(pred), as_torch(truth), 11, 1.0).mean())
