"""Intervals, paired tests and detectable differences, held to simulation, to scipy and to worked examples."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ihbench.metrics.statistics import (
    BOOTSTRAP_FROM,
    cluster_bootstrap,
    holm,
    mean_interval,
    paired_test,
    smallest_detectable_difference,
)


def clustered(data_sets, n, seed, effects="normal"):
    """[data_sets, n] subjects' means: true mean 0, unequal numbers of frames that are correlated within a subject."""
    rng = np.random.default_rng(seed)
    subject = rng.standard_normal((data_sets, n)) if effects == "normal" else (rng.gamma(4, 1, (data_sets, n)) - 4) / 2
    frames = rng.integers(10, 100, (data_sets, n))
    return subject + rng.standard_normal((data_sets, n)) * 0.6 * np.sqrt(0.05 + 0.95 / frames)


def named(values):
    return {f"s{k}": float(value) for k, value in enumerate(values)}


def covered(means):
    """Share of data sets whose interval holds the true mean, 0."""
    n = means.shape[1]
    if n >= BOOTSTRAP_FROM:
        low, high = np.concatenate([cluster_bootstrap(part, replicates=1999) for part in np.split(means, 8)], 1)
    else:
        intervals = [mean_interval(named(row)) for row in means]
        low, high = np.array([(i.low, i.high) for i in intervals]).T
    return np.mean((low <= 0) & (high >= 0))


@pytest.mark.parametrize("n", [3, 6, 20])
def test_a_95_percent_interval_covers_the_truth_in_95_percent_of_data_sets(n):
    assert 0.93 < covered(clustered(4000, n, seed=n)) < 0.97


@pytest.mark.parametrize("n", [3, 6, 20])
def test_skewed_subjects_cost_a_little_coverage(n):
    assert 0.915 < covered(clustered(4000, n, seed=n, effects="skewed")) < 0.96


def test_taking_frames_for_independent_would_be_far_too_narrow():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(500):
        frames = rng.standard_normal((6, 1)) + 0.5 * rng.standard_normal((6, 40))
        half = stats.t.ppf(0.975, 239) * frames.std(ddof=1) / math.sqrt(240)
        hits += abs(frames.mean()) <= half
    assert hits / 500 < 0.5


def test_an_interval_of_few_subjects_is_students():
    values = [21.0, 24.0, 22.5, 20.0]
    interval = mean_interval(named(values))
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert (interval.low, interval.high) == pytest.approx((low, high), abs=1e-12)
    assert interval.value == pytest.approx(21.875)
    assert (interval.n, interval.method) == (4, "Student's t over 4 subjects")


def test_the_bootstrap_of_many_normal_subjects_nears_students():
    values = np.random.default_rng(3).standard_normal(200)
    low, high = cluster_bootstrap(values)
    expected = stats.t.interval(0.95, 199, values.mean(), stats.sem(values))
    assert (low, high) == pytest.approx(expected, abs=0.01)


def test_every_subject_counts_once_however_many_frames_it_has():
    frames = {"a": [10.0] * 100, "b": [20.0], "c": [27.0, 33.0]}
    assert mean_interval(frames) == mean_interval({"a": 10.0, "b": 20.0, "c": 30.0})


def test_one_subject_has_no_interval_and_equal_ones_a_point():
    one = mean_interval({"a": [20.0, 22.0]})
    assert one.value == 21.0
    assert math.isnan(one.low)
    assert math.isnan(one.high)
    for n in (3, 12):
        same = mean_interval(named([5.0] * n))
        assert (same.low, same.value, same.high) == pytest.approx((5.0, 5.0, 5.0))


@given(st.lists(st.floats(-50, 50), min_size=2, max_size=12), st.floats(-9, 9), st.floats(0.1, 9), st.randoms())
@settings(deadline=None, derandomize=True, max_examples=40)
def test_intervals_shift_scale_and_ignore_order(values, shift, scale, random):
    plain = mean_interval(named(values))
    moved = mean_interval(named([scale * value + shift for value in values]))
    for name in ("value", "low", "high"):
        assert getattr(moved, name) == pytest.approx(scale * getattr(plain, name) + shift, abs=1e-6)
    pairs = list(named(values).items())
    random.shuffle(pairs)
    assert mean_interval(dict(pairs)) == plain
    assert plain.low <= plain.value <= plain.high


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_refused(bad):
    for call in (lambda: mean_interval({"a": bad}), lambda: smallest_detectable_difference([1.0, bad])):
        with pytest.raises(ValueError, match="finite"):
            call()


def test_no_subjects_are_refused():
    with pytest.raises(ValueError, match="at least one subject"):
        mean_interval({})


# ------------------------------------------------------------------------------------------------ paired tests


@pytest.mark.parametrize("n", [3, 6, 9])
def test_sign_flips_equal_scipys_exact_permutation_test(n):
    rng = np.random.default_rng(n)
    a, b = rng.standard_normal((2, n)) + [[0.7], [0.0]]
    theirs = stats.permutation_test(
        (a - b,), lambda x: x.mean(), permutation_type="samples", n_resamples=np.inf, alternative="two-sided"
    )
    assert paired_test(named(a), named(b)).p == pytest.approx(theirs.pvalue, abs=1e-12)


def test_sampled_sign_flips_near_the_exact_ones(monkeypatch):
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 12)) + [[0.5], [0.0]]
    exact = paired_test(named(a), named(b)).p
    monkeypatch.setattr("ihbench.metrics.statistics.EXACT_UP_TO", 0)
    assert paired_test(named(a), named(b)).p == pytest.approx(exact, abs=0.012)
    assert paired_test(named(a), named(b), seed=1) == paired_test(named(a), named(b), seed=1)


def test_wilcoxon_is_scipys():
    rng = np.random.default_rng(5)
    a, b = rng.standard_normal((2, 10)) + [[0.5], [0.0]]
    assert paired_test(named(a), named(b), "wilcoxon").p == pytest.approx(stats.wilcoxon(a - b).pvalue)
    assert paired_test(named(a), named(a), "wilcoxon").p == 1.0


def test_without_a_difference_few_tests_find_one():
    rng = np.random.default_rng(7)
    p = [paired_test(named(x), named(y)).p for x, y in rng.standard_normal((1000, 2, 7))]
    assert 0.03 < np.mean(np.array(p) <= 0.05) <= 0.065  # 0.047 is the nearest that 64 patterns allow


def test_three_subjects_can_prove_nothing():
    found = paired_test({"a": 30.0, "b": 31.0, "c": 32.0}, {"a": 1.0, "b": 2.0, "c": 3.5})
    assert found.p == found.smallest_p == 0.25


def test_a_test_is_symmetric_in_the_two_methods():
    rng = np.random.default_rng(8)
    a, b = (named(x) for x in rng.standard_normal((2, 6)))
    one, other = paired_test(a, b), paired_test(b, a)
    assert one.p == other.p
    assert one.interval.value == pytest.approx(-other.interval.value)
    assert one.interval.low == pytest.approx(-other.interval.high)


def test_subjects_without_a_partner_are_named():
    with pytest.raises(ValueError, match="only one of the two has b, c"):
        paired_test({"a": 1.0, "b": 1.0}, {"a": 1.0, "c": 1.0})
    with pytest.raises(ValueError, match="at least 2"):
        paired_test({"a": 1.0}, {"a": 2.0})


# ------------------------------------------------------------------------------------------- several comparisons


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.5, math.nan, 0.9]) == pytest.approx([1.0, math.nan, 1.0], nan_ok=True)
    assert holm([]) == []


@given(st.lists(st.floats(1e-6, 1), min_size=3, max_size=3))
@settings(deadline=None, derandomize=True)
def test_holm_is_the_closed_bonferroni_procedure(p):
    for k, adjusted in enumerate(holm(p)):
        families = [s for r in (1, 2, 3) for s in itertools.combinations(range(3), r) if k in s]
        closed = max(min(1.0, len(s) * min(p[i] for i in s)) for s in families)
        assert adjusted == pytest.approx(closed)


# -------------------------------------------------------------------------------------- detectable differences


@pytest.mark.parametrize(("n", "power"), [(3, 0.8), (6, 0.8), (20, 0.9)])
def test_the_smallest_detectable_difference_is_found_that_often(n, power):
    rng = np.random.default_rng(n)
    values = rng.standard_normal(n)
    values *= 2.0 / values.std(ddof=1)  # scatter 2, as the data sets below have
    true = smallest_detectable_difference(values, power=power)
    samples = true + 2.0 * rng.standard_normal((20_000, n))
    p = stats.ttest_1samp(samples, 0, axis=1).pvalue
    assert np.mean(p < 0.05) == pytest.approx(power, abs=0.015)


def test_more_subjects_and_less_scatter_find_smaller_differences():
    few, many = [1.0, -1.0, 0.5], [1.0, -1.0, 0.5] * 4
    assert smallest_detectable_difference(many) < smallest_detectable_difference(few)
    assert smallest_detectable_difference([3.0 * d for d in few]) == pytest.approx(
        3 * smallest_detectable_difference(few)
    )
    assert smallest_detectable_difference([0.4, 0.4]) == 0.0
    assert math.isnan(smallest_detectable_difference([0.4]))
