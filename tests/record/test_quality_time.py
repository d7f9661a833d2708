"""Curves over the fit clock: time to a quality, area, windows, Pareto sets, against brute force and by hand."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.clock.ledger import Ledger
from ihbench.errors import BadInput
from ihbench.metrics import Identity
from ihbench.record.quality_time import (
    NEVER,
    QualityCurve,
    Target,
    area_under_curve,
    common_window,
    curve_of,
    error_of,
    pareto_set,
    round_targets,
    time_to_quality,
)
from ihbench.record.schema import CurvePoint

PSNR = Identity.parse("psnr/pooled/range1/body/v1")


def curve(seconds, values, higher=True):
    return QualityCurve(np.array(seconds, float), np.array(values, float), higher)


def logarithmic(a=10.0, b=2.0, seconds=(2, 4, 8, 16, 32)):
    """q = a + b log2(t), exactly what is assumed between two points."""
    return curve(seconds, [a + b * math.log2(t) for t in seconds])


# ------------------------------------------------------------------------------------------------ time to quality


@pytest.mark.parametrize("target", [12.0, 13.0, 14.6, 17.9, 20.0])
def test_the_time_of_an_analytic_curve_is_its_inverse(target):
    assert time_to_quality(logarithmic(), target) == pytest.approx(2 ** ((target - 10) / 2), rel=1e-12)


def test_what_is_not_reached_is_never_and_no_curve_is_no_answer():
    assert time_to_quality(logarithmic(), 20.0001) == NEVER
    assert time_to_quality(curve([3], [9]), 10) == NEVER
    assert math.isnan(time_to_quality(curve([], []), 10))


def test_the_first_crossing_counts_however_the_curve_goes_on():
    up_and_down = curve([1, 2, 4, 8, 16], [10, 20, 5, 30, 10])
    assert time_to_quality(up_and_down, 15) == pytest.approx(math.sqrt(2))
    assert time_to_quality(up_and_down, 25) == pytest.approx(4 * 2 ** (20 / 25))
    assert up_and_down.best == 30


def test_lower_is_better_is_the_mirror_image():
    higher = curve([1, 3, 9], [10, 14, 25])
    lower = curve([1, 3, 9], [-10, -14, -25], higher=False)
    for target in (9, 10, 12, 20, 25, 26):
        assert time_to_quality(lower, -target) == time_to_quality(higher, target)
    assert lower.best == -25


def test_a_first_point_that_is_good_enough_and_an_infinite_one_give_their_own_times():
    assert time_to_quality(logarithmic(), 1) == 2
    assert time_to_quality(curve([1, 2, 4], [10, 20, math.inf]), 30) == 4


@given(
    st.lists(st.tuples(st.floats(0.1, 1e4), st.floats(0, 50)), min_size=1, max_size=8, unique_by=lambda p: p[0]),
    st.floats(0, 50),
    st.floats(0.01, 10),
)
@settings(deadline=None, derandomize=True)
def test_a_harder_target_never_comes_earlier_and_the_answer_lies_on_the_curve(points, target, more):
    points.sort()
    found = curve(*zip(*points, strict=True))
    first = time_to_quality(found, target)
    assert time_to_quality(found, target + more) >= first
    if first == NEVER:
        assert found.best < target
    else:
        assert found.seconds[0] <= first <= found.seconds[-1]
        assert found.at(np.array([first]))[0] >= target - 1e-6


# ------------------------------------------------------------------------------------------------------- the area


def test_the_area_of_an_analytic_curve_is_its_value_in_the_middle_of_log_time():
    assert area_under_curve(logarithmic(), 2, 32) == pytest.approx(10 + 2 * math.log2(8))
    assert area_under_curve(logarithmic(), 3, 12) == pytest.approx(10 + 2 * math.log2(6))


def test_a_finished_fit_keeps_its_value():
    short = curve([1, 10], [20, 30])
    assert area_under_curve(short, 1, 10) == pytest.approx(25)
    assert area_under_curve(short, 1, 100) == pytest.approx((25 + 30) / 2)
    assert area_under_curve(curve([1], [7]), 1, 50) == pytest.approx(7)


def test_there_is_no_area_before_the_first_point_nor_under_an_infinite_one():
    assert math.isnan(area_under_curve(logarithmic(), 1, 32))
    assert math.isnan(area_under_curve(curve([1, 2], [20, math.inf]), 1, 2))
    assert math.isnan(area_under_curve(curve([], []), 1, 2))
    with pytest.raises(ValueError, match="0 < start < end"):
        area_under_curve(logarithmic(), 5, 5)


def test_the_common_window_is_where_every_curve_has_an_area():
    early, late = curve([1, 8], [1, 2]), curve([4, 64], [1, 2])
    assert common_window([early, late, curve([], [])]) == (4, 64)
    assert all(math.isfinite(area_under_curve(c, 4, 64)) for c in (early, late))
    assert all(map(math.isnan, common_window([curve([3], [1])])))
    assert all(map(math.isnan, common_window([])))


# ------------------------------------------------------------------------------------------------------ the points


def test_a_curve_is_read_in_the_order_of_time_and_without_what_is_no_number():
    rows = [
        CurvePoint(0, 8.0, {PSNR: 20.0}),
        CurvePoint(0, 2.0, {PSNR: 10.0}),
        CurvePoint(0, 4.0, {PSNR: math.nan}),
        CurvePoint(0, 5.0, {}),
        CurvePoint(0, 0.0, {PSNR: 3.0}),
        CurvePoint(0, 8.0, {PSNR: 21.0}),
    ]
    found = curve_of(rows, PSNR)
    assert found.seconds.tolist() == [2, 8]
    assert found.values.tolist() == [10, 21]
    assert not len(curve_of(rows, Identity.parse("ssim/x/range1/body/v1")).values)


@pytest.mark.parametrize("slow", [0.0, 1.0, 500.0])
def test_how_long_scoring_takes_does_not_move_the_curve(slow):
    """Evaluation is excluded from the clock: only its own stage and the total notice it."""
    now = [100.0]
    points = []

    def score(step, seconds, avatar):
        now[0] += slow
        points.append(CurvePoint(step, seconds, {PSNR: 10.0 + step}))

    ledger = Ledger(clock=lambda: now[0], on_checkpoint=score)
    with ledger.stage("fit"):
        for step in range(1, 21):
            now[0] += 1.0
            ledger.offer(step, "avatar")
        ledger.offer(20, "avatar", force=True)
    found = curve_of(points, PSNR)
    assert found.seconds.tolist() == [2, 4, 8, 16, 20]
    assert time_to_quality(found, 18) == pytest.approx(8)
    assert ledger.fit_seconds == 20
    assert ledger.seconds == pytest.approx(20 + 5 * slow)


# ------------------------------------------------------------------------------------------------------ Pareto set


@given(st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12), st.data())
@settings(deadline=None, derandomize=True, max_examples=300)
def test_the_pareto_set_is_what_brute_force_finds(points, data):
    costs = [(float(x), float(y)) for x, y in points]
    for k in data.draw(st.sets(st.integers(0, max(len(costs) - 1, 0)), max_size=2)) if costs else ():
        costs[k] = (math.nan, costs[k][1]) if k % 2 else (costs[k][0], math.nan)

    def beaten(k):
        x, y = costs[k]
        return any(a <= x and b <= y and (a, b) != (x, y) for a, b in costs)

    expected = {k for k in range(len(costs)) if not any(map(math.isnan, costs[k])) and not beaten(k)}
    found = pareto_set([x for x, _ in costs], [y for _, y in costs])
    assert set(found) == expected
    assert len(found) == len(set(found))
    assert [costs[k][0] for k in found] == sorted(costs[k][0] for k in found)


def test_lists_of_different_length_are_refused():
    with pytest.raises(ValueError, match="as many errors"):
        pareto_set([1.0], [])


# ---------------------------------------------------------------------------------------------- errors and targets


def test_errors_are_less_for_better_and_keep_the_order_of_unknown_metrics():
    assert error_of("psnr", 20.0) == pytest.approx(0.1)
    assert error_of("psnr", math.inf) == 0
    assert error_of("ssim", 0.75) == 0.25
    assert error_of("flip", 0.2) == 0.2
    assert error_of("theirs", 3.0) < error_of("theirs", 2.0)
    assert math.isnan(error_of("psnr", math.nan))


def test_targets_are_round_reached_by_somebody_and_worst_first():
    curves = [curve([1, 2, 4], [12.3, 19, 24.7]), curve([1, 2], [10.1, 21.2])]
    assert round_targets(curves) == [14, 18, 24]
    mirrored = [curve(c.seconds, 1 / c.values, higher=False) for c in curves]
    found = round_targets(mirrored)
    assert found == sorted(found, reverse=True)
    assert min(c.best for c in mirrored) <= found[-1] < found[0]
    assert round_targets([curve([1, 2], [7, 7])]) == round_targets([curve([], [])]) == []


def test_a_target_is_a_metric_maybe_a_region_and_a_number():
    assert Target.parse("psnr=25") == Target("psnr", 25.0)
    assert Target.parse("flip/hidden=0.2") == Target("flip", 0.2, "hidden")
    for text in ("25", "psnr", "psnr=", "psnr=nan", "psnr=inf", "speed=3", "=3"):
        with pytest.raises(BadInput, match="expected METRIC=NUMBER"):
            Target.parse(text)


@pytest.mark.parametrize("seed", range(40))
def test_values_that_no_metric_has_give_finite_or_absent_numbers_quietly(seed):
    rng = np.random.default_rng(seed)
    seconds = np.sort(rng.choice([5e-324, 1e-300, 1.0, 2.0, 8.0, 1e300, 1.7e308], 4, replace=False))
    values = rng.choice([math.inf, -1.7e308, -1e4, 0.0, 20.0, 30.0, 1.7e308], 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one = QualityCurve(seconds, values, bool(seed % 2))
        time = time_to_quality(one, float(rng.choice([0.0, 25.0, 1.7e308, -1.7e308])))
        assert time == math.inf or seconds[0] <= time <= seconds[-1]
        assert not math.isinf(area_under_curve(one, float(seconds[0]), float(seconds[-1])))
        for target in round_targets([one]):
            assert math.isfinite(target)
        for value in values:
            assert error_of("psnr", float(value)) >= 0
        points = [CurvePoint(0, float(s), {PSNR: float(v)}) for s, v in zip(seconds, values, strict=True)]
        assert all(abs(v) <= 1e100 or v == math.inf for v in curve_of(points, PSNR).values)
