"""Quality against run time: curves over the fit clock, time to a stated quality, area under the curve, Pareto sets.

A curve is what `curve.jsonl` of a run holds: a method's quality at geometric times of the fit clock, which stands
still while the avatar is scored. Between two points quality is taken as linear in the logarithm of time, the spacing
at which it was sampled; after the last point it stays as it is (a finished fit keeps its avatar), before the first
there is none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.metrics.aggregate import LARGEST
from ihbench.metrics.identity import METRICS, Identity
from ihbench.record.schema import CurvePoint
from ihbench.scene.spread import spread

NEVER = math.inf  # seconds to a quality that the run did not reach


@dataclass(frozen=True)
class QualityCurve:
    """One metric of one run over the fit clock."""

    seconds: NDArray[np.float64]  # [n] s, positive and increasing
    values: NDArray[np.float64]  # [n], may be infinite (PSNR without any error), never NaN
    higher_is_better: bool

    @property
    def best(self) -> float:
        """The best value that was seen; NaN without a point."""
        if not len(self.values):
            return math.nan
        return float(self.values.max() if self.higher_is_better else self.values.min())

    def at(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values at some times; NaN before the first point, the last one's afterwards."""
        if not len(self.seconds):
            return np.full(np.shape(seconds), np.nan)
        times = np.asarray(seconds, np.float64)
        value = np.interp(np.log(times), np.log(self.seconds), self.values)
        return np.where(times < self.seconds[0], np.nan, value)


@dataclass(frozen=True)
class Target:
    """A quality whose time is asked for."""

    metric: str  # "psnr", "flip"
    value: float  # in the metric's stored unit
    region: str = ""  # "" for the headline region

    @classmethod
    def parse(cls, text: str) -> Target:
        """From "psnr=25" or "psnr/hidden=20". Raises `BadInput` for anything else than a metric, maybe with a region,
        and a finite number."""
        name, _, value = text.partition("=")
        metric, _, region = name.partition("/")
        try:
            number = float(value)
        except ValueError:
            number = math.nan
        if metric not in METRICS or not math.isfinite(number):
            raise BadInput(
                f"--target {text}: expected METRIC=NUMBER or METRIC/REGION=NUMBER with one of {', '.join(METRICS)}, "
                "as psnr=25 or psnr/hidden=20"
            )
        return cls(metric, number, region)


def curve_of(points: Iterable[CurvePoint], identity: Identity) -> QualityCurve:
    """The curve of one identity from the rows of a `curve.jsonl`, in any order.

    Points without a number (absent, NaN, finite beyond `aggregate.LARGEST`) and without a positive time are left out;
    of several at one time the last counts. A run that has no such number gives a curve without points.
    """
    found: dict[float, float] = {}
    for point in points:
        seconds, value = point.seconds, point.scores.get(identity, math.nan)
        if math.isfinite(seconds) and seconds > 0 and (abs(value) <= LARGEST or value == math.inf):
            found[seconds] = value
    times = sorted(found)
    return QualityCurve(np.array(times), np.array([found[t] for t in times]), identity.display.higher_is_better)


def time_to_quality(curve: QualityCurve, target: float) -> float:
    """Seconds of the fit clock after which the quality was first at least `target` (at most, where lower is better).

    `NEVER` when no point reaches it, even if one came close; NaN without any point. That the quality falls below the
    target again later does not count. A first point that is good enough already gives its own time, an upper bound.
    """
    if not len(curve.values):
        return math.nan
    sign = 1.0 if curve.higher_is_better else -1.0
    with np.errstate(over="ignore"):  # of values that no metric has
        gains = sign * (curve.values - target)
    reached = np.flatnonzero(gains >= 0)
    if not len(reached):
        return NEVER
    k = int(reached[0])
    if k == 0 or not math.isfinite(gains[k]) or not math.isfinite(gains[k - 1]):
        return float(curve.seconds[k])
    before, after = float(gains[k - 1]), float(gains[k])
    share = before / (before - after)
    earlier, later = float(curve.seconds[k - 1]), float(curve.seconds[k])
    between = earlier * (later / earlier) ** share
    return min(max(between, earlier), later)


def area_under_curve(curve: QualityCurve, start: float, end: float) -> float:
    """The mean value over the logarithm of time from `start` to `end` seconds, in the metric's own unit.

    Curves are only comparable over the same window. NaN where the curve begins after `start`, has an infinite value,
    or has no point. Raises `ValueError` unless 0 < start < end.
    """
    if not 0 < start < end:
        raise ValueError(f"area under the curve: expected 0 < start < end, got {start} and {end}")
    if not len(curve.values) or start < curve.seconds[0] or not np.isfinite(curve.values).all():
        return math.nan
    inner = curve.seconds[(curve.seconds > start) & (curve.seconds < end)]
    times = np.array([start, *inner, end])
    with np.errstate(over="ignore", invalid="ignore"):  # of values that no metric has
        values, logs = curve.at(times), np.log(times)
        area = float(np.sum((values[1:] + values[:-1]) / 2 * np.diff(logs)) / (logs[-1] - logs[0]))
    return area if math.isfinite(area) else math.nan


def common_window(curves: Iterable[QualityCurve]) -> tuple[float, float]:
    """Seconds (start, end) over which the areas of all these curves exist: from the latest first point to the last
    point of any. NaN without a curve, or where the window is empty."""
    having = [curve for curve in curves if len(curve.seconds)]
    if not having:
        return math.nan, math.nan
    start, end = max(float(c.seconds[0]) for c in having), max(float(c.seconds[-1]) for c in having)
    return (start, end) if start < end else (math.nan, math.nan)


def pareto_set(seconds: Sequence[float], errors: Sequence[float]) -> list[int]:
    """Indices, fastest first, of the points that no other beats: none is as fast and as right and better in one.

    Both are costs (less is better); equal points are both in. Points with a NaN are never in and beat nobody. Raises
    `ValueError` for lists of different length.
    """
    if len(seconds) != len(errors):
        raise ValueError(f"Pareto set: expected as many errors as seconds, got {len(errors)} and {len(seconds)}")
    known = [k for k in range(len(seconds)) if not (math.isnan(seconds[k]) or math.isnan(errors[k]))]
    chosen: list[int] = []
    least = math.inf
    for k in sorted(known, key=lambda k: (seconds[k], errors[k])):
        tie = chosen and (seconds[chosen[-1]], errors[chosen[-1]]) == (seconds[k], errors[k])
        if errors[k] < least or tie or not chosen:
            chosen.append(k)
            least = errors[k]
    return chosen


def error_of(metric: str, value: float) -> float:
    """A metric's value as an error, for logarithmic axes: 0 is perfect, less is better.

    PSNR becomes the root mean squared error for a peak of 1, 10^(-PSNR/20); SSIM its distance to 1; what is an error
    already stays. A metric that nobody told us about is only ordered: its value with the sign turned. NaN stays NaN.
    """
    if metric == "psnr":
        return math.inf if value < -6000 else 10 ** (-value / 20)  # beyond 10^300, which no image has
    if metric == "ssim":
        return 1 - value
    return value if metric in METRICS else -value


def round_targets(curves: Sequence[QualityCurve], count: int = 3) -> list[float]:
    """Up to `count` round qualities, worst first, spread over what these curves reach, for a table of times.

    From the middle one of the first values to the best value of any: the ladder of the coarsest step out of 1, 2, 5 ×
    10^k that has at least `count` rungs inside; of more rungs, evenly spread ones. None without finite values.
    """
    first = sorted(float(c.values[0]) for c in curves if len(c.values) and math.isfinite(c.values[0]))
    best = [c.best for c in curves if math.isfinite(c.best)]
    if not first or not best:
        return []
    ends = first[len(first) // 2], max(best) if curves[0].higher_is_better else min(best)
    low, high = min(ends), max(ends)
    if not math.isfinite(high - low) or high - low < 1e-9 * max(1.0, abs(high)):
        return []
    exponent = math.floor(math.log10(high - low))
    for k in range(4):
        for mantissa in (5, 2, 1):
            step = mantissa * 10.0 ** (exponent - k)
            values = [round(n * step, 12) for n in range(math.ceil(low / step + 1e-9), math.floor(high / step) + 1)]
            if len(values) >= count:
                chosen = [values[i] for i in spread(len(values), count)]
                return chosen if curves[0].higher_is_better else chosen[::-1]
    return []
