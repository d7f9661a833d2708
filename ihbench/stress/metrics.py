"""Extreme images for the metrics, against closed forms and the float64 oracles."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics import mean_over_frames, psnr, ssim
from ihbench.metrics.aggregate import Mean, Score
from ihbench.metrics.flip import flip
from ihbench.metrics.oracles.cases import hashed
from ihbench.metrics.oracles.flip_oracle import flip_oracle
from ihbench.metrics.oracles.oracle import psnr_oracle, ssim_oracle
from ihbench.metrics.psnr import mean_of_channels
from ihbench.metrics.statistics import mean_interval, paired_test, smallest_detectable_difference
from ihbench.stress.case import Answer, Case

EXACT = "the definition gives this number and no other"
CLOSED = "a closed form; the sum over the pixels rounds each term once, the logarithm once more"
FLAT = "a closed form; a variance of 0 comes out as 1e-16, against C2 = 9e-4"
ORACLE = "both sum in float64; only the order of the sums differs"
ORACLE_FLIP = "both work in float64; powers of 0.5 and 0.7 lift rounding errors where FLIP is near 0"
FLOAT32 = "the training loss works in float32: 6e-8 a step, some 20 steps, on sums centred on half the range"

PSNR_FULL = "psnr/pooled/range1/full/v1"
METRICS = {"psnr": psnr, "ssim": ssim, "flip": flip}
ORACLES = {"psnr": psnr_oracle, "ssim": ssim_oracle, "flip": flip_oracle}
PERFECT = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}


def texture(seed: int, height: int = 20, width: int = 18, dtype: type = np.float64) -> NDArray:
    """[H, W, 3] noise of whole 8-bit levels."""
    image = hashed(seed, height, width)
    return image if dtype == np.uint8 else (image / 255).astype(dtype)


def flat(level: float, height: int = 20, width: int = 18, dtype: type = np.float64) -> NDArray:
    return np.full((height, width, 3), level, dtype)


def rectangle(rows: slice, columns: slice, height: int = 20, width: int = 18) -> NDArray[np.bool_]:
    mask = np.zeros((height, width), np.bool_)
    mask[rows, columns] = True
    return mask


CORNER = rectangle(slice(19, 20), slice(0, 1))  # a pixel


# ----------------------------------------------------------------------------------------------------
# Condition numbers


def condition_of_psnr(x: NDArray, y: NDArray) -> float:
    """Relative change of the decibels per relative change of the pixels: d = x - y cancels, the logarithm divides."""
    x, y = (image.astype(np.float64) for image in (x, y))
    d = x - y
    of_mse = 2 * float((np.abs(d) * (np.abs(x) + np.abs(y))).sum() / np.square(d).sum())
    decibels = -10 * math.log10(float(np.square(d).mean()))
    return of_mse * 10 / math.log(10) / abs(decibels)


def condition_of_ssim(x: NDArray, y: NDArray) -> float:
    """What is lost where a variance is the difference of two means: E[s²] over the variance and C2."""
    s = x.astype(np.float64) + y.astype(np.float64)
    return float(np.square(s).mean() / (s.var() + 2 * 0.03**2))


# ----------------------------------------------------------------------------------------------------
# Answers


def _one_step(dtype: type) -> Answer:
    truth = flat(0.5, dtype=dtype) if dtype != np.uint8 else flat(128, dtype=dtype)
    pred = truth.copy()
    pred[3, 4, 1] = 129 if dtype == np.uint8 else np.nextafter(truth[3, 4, 1], dtype(1))
    peak = 255 if dtype == np.uint8 else 1
    step = (float(pred[3, 4, 1]) - float(truth[3, 4, 1])) / peak
    expected = -10 * math.log10(step**2 / truth.size)
    return Answer(psnr(pred, truth), expected, condition_of_psnr(pred, truth))


def _against_oracle(metric: str, x: NDArray, y: NDArray, mask: NDArray[np.bool_] | None = None) -> Answer:
    condition = None
    if np.isfinite(x).all() and (x != y).any():
        condition = {"psnr": condition_of_psnr, "ssim": condition_of_ssim}.get(metric, lambda x, y: None)(x, y)
    return Answer(METRICS[metric](x, y, mask, hdr=True), ORACLES[metric](x, y, mask), condition)


def _one_lsb_oracle(metric: str) -> Answer:
    pred, truth = texture(1, dtype=np.uint8), texture(1, dtype=np.uint8)
    pred[9, 9, 0] ^= 1
    return _against_oracle(metric, pred, truth)


def _constant_psnr(dtype: type) -> Answer:
    x, y = (flat(v, dtype=dtype) for v in ((60, 180) if dtype == np.uint8 else (0.25, 0.7)))
    peak = 255 if dtype == np.uint8 else 1
    d = (float(x[0, 0, 0]) - float(y[0, 0, 0])) / peak
    return Answer(psnr(x, y), -20 * math.log10(abs(d)), condition_of_psnr(x, y))


def _constant_ssim(dtype: type) -> Answer:
    """No variance: the contrast term is C2 / C2."""
    x, y = (flat(v, dtype=dtype) for v in ((60, 180) if dtype == np.uint8 else (0.25, 0.7)))
    peak = 255 if dtype == np.uint8 else 1
    a, b = float(x[0, 0, 0]) / peak, float(y[0, 0, 0]) / peak
    return Answer(ssim(x, y), (2 * a * b + 1e-4) / (a * a + b * b + 1e-4))


def _green_and_blue() -> Answer:
    """FLIP is scaled so that these two are 1 apart; a constant image has no features."""
    green, blue = np.zeros((2, 20, 18, 3))
    green[..., 1], blue[..., 2] = 1, 1
    return Answer(flip(green, blue), 1.0)


def _bad_inside(metric: str, bad: float) -> Answer:
    x = texture(1)
    x[5, 6, 1] = bad
    return Answer(METRICS[metric](x, texture(2), rectangle(slice(0, 10), slice(0, 10))), math.nan)


def _bad_outside(metric: str, bad: float) -> Answer:
    x, y, mask = texture(1), texture(2), rectangle(slice(8, 20), slice(6, 18))
    clean = METRICS[metric](x, y, mask)
    x[7, 7, 1] = bad
    return Answer(METRICS[metric](x, y, mask), clean)


def _flat_on_black(level: float, expected: float, dtype: type = np.float64) -> Answer:
    return Answer(psnr(flat(level, dtype=dtype), flat(0, dtype=dtype), hdr=True), expected)


def _tiny_on_large(amplitude: float) -> tuple[NDArray, NDArray]:
    """Two patterns of this amplitude on a mean of 1."""
    return 1 - amplitude * (texture(1) > 0.5), 1 - amplitude * (texture(2) > 0.5)


def _training_ssim() -> Answer:
    """The loss in float32, where a variance of 2e-6 is left of 4."""
    import torch

    from ihbench.metrics.ssim_torch import ssim_map_torch

    x, y = (image.astype(np.float32) for image in _tiny_on_large(1 / 255))
    planes = (torch.from_numpy(image.transpose(2, 0, 1).copy()) for image in (x, y))
    return Answer(float(ssim_map_torch(*planes).double().mean()), ssim_oracle(x, y), condition_of_ssim(x, y))


def _training_ssim_gradient() -> Answer:
    import torch

    from ihbench.metrics.ssim_torch import ssim_map_torch

    x = torch.full((3, 12, 12), 0.7, requires_grad=True)
    ssim_map_torch(x, x.detach().clone()).mean().backward()
    assert x.grad is not None
    return Answer(x.grad.numpy(), 0.0)


def _half_precision(metric: str, name: str) -> Answer:
    import torch

    images: list[Any] = [torch.from_numpy(texture(seed).copy()).to(getattr(torch, name)) for seed in (1, 2)]
    exact = [image.double().numpy() for image in images]
    return Answer(METRICS[metric](*images), ORACLES[metric](*exact))


def _negative_ssim() -> Answer:
    board = (np.indices((20, 18)).sum(0) % 2)[..., None].repeat(3, 2).astype(np.float64)
    answer = _against_oracle("ssim", board, 1 - board)
    assert answer.expected < -0.9
    return answer


def _one_perfect_channel() -> Answer:
    x, y = texture(1), texture(2)
    x[..., 2] = y[..., 2]
    return Answer(mean_of_channels(x, y), math.inf)


def _order_of_sums() -> Answer:
    """A million 8-bit pixels: the sum of squares is a whole number, however it is added up."""
    x, y = hashed(1, 1024, 1024), hashed(2, 1024, 1024)
    total = int(np.square(x.astype(np.int64) - y).sum())
    return Answer(psnr(x, y), -10 * math.log10(total / x.size / 255**2))


def _mean_psnr(*values: float) -> Mean:
    return mean_over_frames(Score(v, PSNR_FULL) for v in values)


def _intervals() -> Answer:
    """One subject has no interval; equal subjects have one without width; two allow no p below a half."""
    alone = mean_interval({"a": 3.0})
    equal = mean_interval({"a": 3.0, "b": 3.0, "c": 3.0})
    pair = paired_test({"a": 1.0, "b": 2.0}, {"a": 0.0, "b": 0.5})
    got = [alone.low, equal.low, equal.high, pair.p, smallest_detectable_difference([0.5, 0.5, 0.5])]
    return Answer(got, [math.nan, 3.0, 3.0, 0.5, 0.0])


_metric = partial(Case, group="metrics")
_exact = partial(_metric, unit="absolute", tolerance=0, why=EXACT)
_closed = partial(_metric, unit="ulp", tolerance=64, why=CLOSED)
_oracle = partial(_metric, unit="absolute", tolerance=1e-12, why=ORACLE)


CASES = [
    *(
        _exact(f"{m}-identical-{t.__name__}", "an image and its copy",
               lambda m=m, t=t: Answer(METRICS[m](texture(1, dtype=t), texture(1, dtype=t)), PERFECT[m]))
        for m in METRICS
        for t in (np.uint8, np.float16)
    ),
    *(
        _metric(f"psnr-one-step-{t.__name__}", "one value moves to the next number of its type",
                partial(_one_step, t), "ulp", 4, CLOSED)
        for t in (np.uint8, np.float16, np.float32, np.float64)
    ),
    _oracle("ssim-one-lsb", "one value changes by 1/255", partial(_one_lsb_oracle, "ssim")),
    _metric("flip-one-lsb", "one value changes by 1/255", partial(_one_lsb_oracle, "flip"), "absolute", 1e-9,
            ORACLE_FLIP),
    *(
        _closed(f"psnr-constant-{t.__name__}", "two flat images", partial(_constant_psnr, t))
        for t in (np.uint8, np.float32)
    ),
    *(
        _metric(f"ssim-constant-{t.__name__}", "two flat images", partial(_constant_ssim, t), "absolute", 1e-12, FLAT)
        for t in (np.uint8, np.float16)
    ),
    _metric("flip-green-blue", "the two colours that FLIP is scaled by", _green_and_blue, "absolute", 1e-12, CLOSED),
    _oracle("flip-black-white", "black against white", lambda: _against_oracle("flip", flat(0, 8, 8), flat(1, 8, 8))),
    *(_exact(f"{m}-empty-mask", "a region without a pixel",
             lambda m=m: Answer(METRICS[m](texture(1), texture(2), np.zeros((20, 18), np.bool_)), math.nan))
      for m in METRICS),
    _metric("psnr-one-pixel-mask", "a region of one pixel in a corner",
            lambda: Answer(psnr(texture(1), texture(2), CORNER), -10 * math.log10(
                math.fsum(np.square(texture(1) - texture(2))[19, 0].tolist()) / 3)), "ulp", 4, CLOSED),
    *(
        _metric(f"{m}-one-pixel-mask", "a region of one pixel in a corner",
                lambda m=m: _against_oracle(m, texture(1), texture(2), CORNER),
                "absolute", tolerance, why)
        for m, tolerance, why in (("ssim", 1e-12, ORACLE), ("flip", 1e-9, ORACLE_FLIP))
    ),
    _oracle("ssim-mask-below-window", "a region of 3×3 px under a window of 11×11",
            lambda: _against_oracle("ssim", texture(1), texture(2), rectangle(slice(7, 10), slice(7, 10)))),
    *(_exact(f"{m}-nan-inside", "a NaN in the region", partial(_bad_inside, m, math.nan)) for m in METRICS),
    _exact("psnr-inf-inside", "an infinite pixel in the region", partial(_bad_inside, "psnr", math.inf)),
    *(
        _metric(f"{m}-nan-outside", "a NaN beside the region", partial(_bad_outside, m, math.nan), "absolute", 0,
                "not a bit may change")
        for m in METRICS
    ),
    _metric("ssim-inf-outside", "an infinite pixel beside the region", partial(_bad_outside, "ssim", -math.inf),
            "absolute", 0, "not a bit may change"),
    _metric("psnr-hdr", "values up to 10000", lambda: _against_oracle("psnr", texture(1) * 1e4, texture(2)),
            "relative", 1e-14, ORACLE),
    _closed("psnr-float16-overflow", "60000 in float16, whose square float16 lacks",
            partial(_flat_on_black, 6e4, -20 * math.log10(6e4), np.float16)),
    _closed("psnr-float64-overflow", "1e200, whose square float64 lacks", partial(_flat_on_black, 1e200, -4000.0),
            known="squares of errors above 1e154 overflow; the score is then absent (NaN), "
                  "which no real image reaches"),
    _closed("psnr-float64-underflow", "an error of 1e-170, whose square float64 lacks",
            partial(_flat_on_black, 1e-170, 3400.0),
            known="squares of errors below 1e-162 are 0, and the images count as identical (inf)"),
    _metric("psnr-cancellation", "every pixel off by 2^-40 on a mean of 1",
            lambda: Answer(psnr(flat(1 - 2.0**-40), flat(1)), 800 * math.log10(2),
                           condition_of_psnr(flat(1 - 2.0**-40), flat(1))), "ulp", 64,
            "both differences are exact, whatever the condition number says"),
    *(
        _metric(f"ssim-tiny-variance-{a:g}", f"patterns of amplitude {a:g} on a mean of 1",
                lambda a=a: _against_oracle("ssim", *_tiny_on_large(a)), "absolute", 1e-11,
                "E[s²] - E[s]² leaves 1e-16 × E[s²] against 2 C2 = 2e-3")
        for a in (1 / 255, 1e-6, 1e-12)
    ),
    _metric("ssim-loss-tiny-variance", "the training loss in float32, amplitude 1/255 on a mean of 1", _training_ssim,
            "absolute", 1e-5, FLOAT32 + "; of squares near 1 it keeps 6e-8, against 2 C2 = 2e-3"),
    _metric("ssim-loss-flat-gradient", "the gradient where both images are equal and flat", _training_ssim_gradient,
            "absolute", 1e-6, FLOAT32),
    *(
        _metric(f"{m}-{t}", "images rounded to half precision", partial(_half_precision, m, t), "relative", 1e-12,
                ORACLE)
        for m in ("psnr", "ssim")
        for t in ("float16", "bfloat16")
    ),
    *(
        _metric(f"{m}-{h}x{w}", f"images of {h}×{w} px",
                lambda m=m, h=h, w=w: _against_oracle(m, texture(1, h, w), texture(2, h, w)),
                "absolute", tolerance, why)
        for m, tolerance, why in (("psnr", 1e-12, ORACLE), ("ssim", 1e-12, ORACLE), ("flip", 1e-9, ORACLE_FLIP))
        for h, w in ((1, 1), (1, 7))
    ),
    _oracle("ssim-negative", "a checkerboard against its negative", _negative_ssim),
    _exact("psnr-one-perfect-channel", "channel PSNRs, one channel without error", _one_perfect_channel),
    _metric("psnr-order-of-sums", "a million 8-bit pixels", _order_of_sums, "ulp", 1,
            "integers add up exactly; one division and one logarithm round"),
    _exact("mean-infinite-frames", "one of three frames has no error",
           lambda: Answer([(mean := _mean_psnr(math.inf, 20.0, 30.0)).value, mean.infinite, mean.n], [25.0, 1, 2])),
    _exact("mean-all-infinite", "no frame has an error",
           lambda: Answer(_mean_psnr(math.inf, math.inf, math.inf).value, math.inf)),
    _metric("intervals-few-subjects", "one subject, equal subjects, two subjects", _intervals, "absolute", 1e-15,
            EXACT),
]  # fmt: skip
