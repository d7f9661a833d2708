"""Intervals, paired tests and detectable differences, held to simulation, to scipy and to worked examples."""

from __future__ import annotations

import itertools
import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal, stats

from ihbench.metrics.statistics import (
    BOOTSTRAP_FROM,
    EXACT_UP_TO,
    PATTERNS,
    cluster_bootstrap,
    holm,
    interval_ends,
    mean_interval,
    median_interval,
    paired_test,
    smallest_detectable_difference,
)

FRAMES = 60
EFFECTS = {  # of mean 0 and scatter 1
    "normal": lambda rng, shape: rng.standard_normal(shape),
    "skewness 1": lambda rng, shape: (rng.gamma(4, 1, shape) - 4) / 2,
    "skewness 2": lambda rng, shape: rng.exponential(1, shape) - 1,
}


def clustered(data_sets, n, effects="normal", seed=0):
    """[data_sets, n, FRAMES] scores, NaN past a subject's 10 to 60 frames: mean 0, neighbours correlated by 0.9."""
    rng = np.random.default_rng([seed, n])
    noise = rng.standard_normal((data_sets, n, FRAMES))
    noise[..., 1:] *= math.sqrt(1 - 0.9**2)
    scores = EFFECTS[effects](rng, (data_sets, n, 1)) + 0.6 * signal.lfilter([1], [1, -0.9], noise, axis=-1)
    scores[np.arange(FRAMES) >= rng.integers(10, FRAMES + 1, (data_sets, n, 1))] = np.nan
    return scores


def coverage(low, high):
    """Share of data sets whose interval holds the true mean, 0."""
    return np.mean((low <= 0) & (high >= 0))


def covered(n, effects="normal", find=interval_ends):
    """Coverage in 4000 data sets: standard error 0.35 %."""
    means = np.nanmean(clustered(4000, n, effects), axis=-1)
    parts = np.split(means, 16)  # a bootstrap of all at once would hold 4000 × 9999 replicates
    return coverage(*np.concatenate([find(part) for part in parts], axis=1))


def named(values):
    return {f"s{k:03}": float(value) for k, value in enumerate(values)}


# --------------------------------------------------------------------------------------------------- intervals


@pytest.mark.parametrize("n", [3, 6, BOOTSTRAP_FROM, 20])
def test_a_95_percent_interval_covers_the_truth_in_95_percent_of_data_sets(n):
    assert 0.93 < covered(n) < 0.97


@pytest.mark.parametrize(
    ("effects", "n", "expected"),
    [
        *[("skewness 1", 3, 0.938), ("skewness 1", 6, 0.943), ("skewness 1", 20, 0.945)],
        *[("skewness 2", 3, 0.920), ("skewness 2", 6, 0.918), ("skewness 2", 20, 0.934)],
    ],
)
def test_skewed_subjects_cost_the_coverage_that_the_docstring_states(effects, n, expected):
    assert covered(n, effects) == pytest.approx(expected, abs=0.012)


def test_a_bootstrap_of_three_subjects_cannot_do_it():
    assert covered(3, find=cluster_bootstrap) == pytest.approx(0.75, abs=0.02)


def test_the_interval_is_the_one_whose_coverage_is_measured():
    for n in (3, 6, BOOTSTRAP_FROM, 20):
        scores = clustered(3, n)
        low, high = interval_ends(np.nanmean(scores, axis=-1))
        for k in range(3):
            interval = mean_interval({f"s{i:02}": list(row[~np.isnan(row)]) for i, row in enumerate(scores[k])})
            assert (interval.low, interval.high) == pytest.approx((low[k], high[k]), abs=1e-12)


def test_an_interval_of_few_subjects_is_students():
    values = [21.0, 24.0, 22.5, 20.0]
    interval = mean_interval(named(values))
    low, high = stats.t.interval(0.95, 3, np.mean(values), stats.sem(values))
    assert (interval.low, interval.high) == pytest.approx((low, high), abs=1e-12)
    assert (interval.value, interval.level) == (21.875, 0.95)
    assert (interval.n, interval.method) == (4, "Student's t over 4 subjects")


def test_the_bootstrap_of_many_normal_subjects_nears_students():
    values = np.random.default_rng(3).standard_normal(200)
    expected = stats.t.interval(0.95, 199, values.mean(), stats.sem(values))
    assert cluster_bootstrap(values) == pytest.approx(expected, abs=0.01)
    assert mean_interval(named(values)).method == "cluster bootstrap over 200 subjects"


def test_replicates_stay_within_the_subjects_and_repeat_by_seed():
    values = np.random.default_rng(4).exponential(1, 12)
    one, again, other = (mean_interval(named(values), seed=seed) for seed in (1, 1, 2))
    assert one == again
    assert one != other
    assert (other.low, other.high) == pytest.approx((one.low, one.high), abs=0.05)
    low, high = cluster_bootstrap(values, level=0.9999)
    assert values.min() <= low < high <= values.max()


def test_every_subject_counts_once_however_many_frames_it_has():
    frames = {"a": [10.0] * 100, "b": [20.0], "c": [27.0, 33.0]}
    assert mean_interval(frames) == mean_interval({"a": 10.0, "b": 20.0, "c": 30.0})


def test_one_subject_has_no_interval():
    one = mean_interval({"a": [20.0, 22.0]})
    assert (one.value, one.n, one.method) == (21.0, 1, "one subject has no interval")
    assert math.isnan(one.low)
    assert math.isnan(one.high)


@pytest.mark.parametrize("n", [2, 3, 12])
def test_equal_subjects_have_a_point(n):
    same = mean_interval(named([0.1] * n))
    assert (same.low, same.value, same.high) == pytest.approx((0.1, 0.1, 0.1), abs=1e-15)
    assert same.low <= same.value <= same.high


@given(
    st.lists(st.floats(-50, 50), min_size=2, max_size=12),
    st.floats(-9, 9),
    st.floats(0.1, 9) | st.floats(-9, -0.1),
    st.randoms(),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_intervals_shift_scale_and_ignore_order(values, shift, scale, random):
    plain = mean_interval(named(values))
    moved = mean_interval(named([scale * value + shift for value in values]))
    ends = sorted(scale * end + shift for end in (plain.low, plain.high))
    assert (moved.low, moved.high) == pytest.approx(ends, abs=1e-6)
    assert moved.value == pytest.approx(scale * plain.value + shift, abs=1e-6)
    pairs = list(named(values).items())
    random.shuffle(pairs)
    assert mean_interval(dict(pairs)) == plain
    assert plain.low <= plain.value <= plain.high


@pytest.mark.parametrize("bad", [math.nan, math.inf, [1.0, math.nan], [math.inf, -math.inf], []])
def test_subjects_without_finite_scores_are_named(bad):
    for n in (1, 4, 12):
        with pytest.raises(ValueError, match="finite scores of other"):
            mean_interval({**named(range(n)), "other": bad})


def test_what_has_no_interval_is_refused():
    with pytest.raises(ValueError, match="at least one subject"):
        mean_interval({})
    for find in (interval_ends, cluster_bootstrap):
        with pytest.raises(ValueError, match="at least 2 subjects, got 1"):
            find(np.ones((5, 1)))
    for n, level in itertools.product((3, 12), (0.0, 1.0, 95, math.nan)):
        with pytest.raises(ValueError, match="level between 0 and 1"):
            mean_interval(named(range(n)), level)


# ------------------------------------------------------------------------------------------------ paired tests


def two_methods(n, seed, gain=0.5):
    rng = np.random.default_rng([seed, n])
    return rng.standard_normal(n) + gain, rng.standard_normal(n)


@pytest.mark.parametrize("n", [2, 3, 6, 9])
def test_sign_flips_equal_scipys_exact_permutation_test(n):
    a, b = two_methods(n, seed=1)
    theirs = stats.permutation_test(
        (a - b,), lambda x: x.mean(), permutation_type="samples", n_resamples=np.inf, alternative="two-sided"
    )
    assert paired_test(named(a), named(b)).p == pytest.approx(theirs.pvalue, abs=1e-12)


def test_equal_sums_of_decimal_scores_are_ties():
    rng = np.random.default_rng(0)
    for whole in rng.integers(-9, 10, (200, 6)):
        sums = [abs(np.dot(signs, whole)) for signs in itertools.product((-1, 1), repeat=6)]
        exact = np.mean(np.array(sums) >= abs(whole.sum()))
        assert paired_test(named(whole / 10), named([0] * 6)).p == exact


def test_sampled_sign_flips_near_the_exact_ones(monkeypatch):
    a, b = (named(x) for x in two_methods(12, seed=2))
    exact = paired_test(a, b).p
    monkeypatch.setattr("ihbench.metrics.statistics.EXACT_UP_TO", 0)
    assert paired_test(a, b).p == pytest.approx(exact, abs=0.012)
    assert paired_test(a, b, seed=1) == paired_test(a, b, seed=1)
    assert paired_test(a, b, seed=1).p != paired_test(a, b, seed=2).p


def test_wilcoxon_is_scipys():
    a, b = two_methods(10, seed=5)
    assert paired_test(named(a), named(b), "wilcoxon").p == pytest.approx(stats.wilcoxon(a - b).pvalue)
    assert paired_test(named(a), named(a), "wilcoxon").p == 1.0


def test_wilcoxon_drops_subjects_without_a_difference():
    # ranks 1 to 5, the negative ones sum to 3: so do {}, {1}, {2}, {3} and {1, 2} at most, of 32 sets
    p = paired_test(named([0, 0, -1, -2, 3, 4, 5]), named([0] * 7), "wilcoxon").p
    assert p == pytest.approx(2 * 5 / 32)


@pytest.mark.parametrize("sizes", [[1, 2, 3, 4, 5, 6, 7], [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 9], [5, 5, 5, 5, 5, 5, 5]])
def test_without_a_difference_the_permutation_test_is_exact(sizes):
    """Whatever the sizes of the differences, all their signs are equally likely; so all 128 are tried."""
    zero = named([0] * 7)
    p = [paired_test(named(signs), zero).p for signs in np.array(sizes) * list(itertools.product((-1, 1), repeat=7))]
    for alpha in (0.05, 0.2):
        assert np.mean(np.array(p) <= alpha) <= alpha
    assert min(p) == 2 / 128


@pytest.mark.parametrize("test", ["permutation", "wilcoxon"])
@pytest.mark.parametrize("n", [2, 3, 6, 10])
def test_one_better_everywhere_gives_the_smallest_p(n, test):
    found = paired_test(named(np.arange(n) + 1.5 * np.arange(1, n + 1)), named(np.arange(n)), test)
    assert found.p == pytest.approx(found.smallest_p)
    assert found.smallest_p == 2 / 2**n
    assert found.test == test


def test_three_subjects_can_prove_nothing_and_many_no_more_than_the_patterns_tried():
    assert paired_test(named([30, 31, 32]), named([1, 2, 3.5])).p == 0.25
    many = paired_test(named(np.arange(40) + 50.0), named(np.arange(40)))
    assert len(named(range(40))) > EXACT_UP_TO
    assert many.p == many.smallest_p == 1 / (1 + PATTERNS)


@pytest.mark.parametrize("n", [6, 12, 20])
def test_a_test_is_symmetric_in_the_two_methods_and_ignores_order(n):
    a, b = (named(x) for x in two_methods(n, seed=8))
    one, other = paired_test(a, b), paired_test(b, a)
    assert one.p == other.p
    ends = (-other.interval.value, -other.interval.high, -other.interval.low)
    assert (one.interval.value, one.interval.low, one.interval.high) == pytest.approx(ends)
    assert paired_test(dict(reversed(a.items())), b) == one


def test_the_interval_is_that_of_the_differences():
    found = paired_test({"a": [3.0, 5.0], "b": 2.0, "c": 7.0}, {"a": 1.0, "b": 2.5, "c": [5.0, 6.0]}, level=0.9)
    assert found.interval == mean_interval({"a": 3.0, "b": -0.5, "c": 1.5}, level=0.9)


def test_what_cannot_be_paired_is_refused():
    with pytest.raises(ValueError, match="only one of the two has b, c"):
        paired_test({"a": 1.0, "b": 1.0}, {"a": 1.0, "c": 1.0})
    with pytest.raises(ValueError, match="at least 2 subjects, got 1"):
        paired_test({"a": 1.0}, {"a": 2.0})
    with pytest.raises(ValueError, match="at least 2 subjects, got 0"):
        paired_test({}, {})
    with pytest.raises(ValueError, match="finite scores of s001"):
        paired_test(named([1, 2]), named([1, math.inf]))
    with pytest.raises(ValueError, match="permutation or wilcoxon"):
        paired_test(named([1, 2]), named([1, 3]), "t")  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------- several comparisons


def test_holm_by_hand():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.04, math.nan, 0.03, math.nan]) == pytest.approx([0.06, math.nan, 0.06, math.nan], nan_ok=True)
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=3, max_size=3))
@settings(deadline=None, derandomize=True)
def test_holm_is_the_closed_bonferroni_procedure(p):
    for k, adjusted in enumerate(holm(p)):
        families = [s for r in (1, 2, 3) for s in itertools.combinations(range(3), r) if k in s]
        closed = max(min(1.0, len(s) * min(p[i] for i in s)) for s in families)
        assert adjusted == pytest.approx(closed)


@pytest.mark.parametrize("bad", [-0.1, 1.1, math.inf])
def test_holm_refuses_what_is_no_p_value(bad):
    with pytest.raises(ValueError, match=r"p values in 0\.\.1"):
        holm([0.5, bad])


# -------------------------------------------------------------------------------------- detectable differences


@pytest.mark.parametrize(("n", "power"), [(2, 0.8), (3, 0.8), (6, 0.8), (20, 0.8), (3, 0.99), (6, 0.3)])
def test_the_smallest_detectable_difference_is_found_that_often(n, power):
    rng = np.random.default_rng(n)
    values = rng.standard_normal(n)
    values *= 2.0 / values.std(ddof=1)  # scatter 2, as the data sets below have
    true = smallest_detectable_difference(values, power=power)
    samples = true + 2.0 * rng.standard_normal((20_000, n))
    p = stats.ttest_1samp(samples, 0, axis=1).pvalue
    assert np.mean(p < 0.05) == pytest.approx(power, abs=0.012)  # standard error 0.3 %


def test_no_scatter_and_no_scatter_known():
    assert smallest_detectable_difference([0.4, 0.4]) == 0.0
    assert math.isnan(smallest_detectable_difference([0.4]))
    assert math.isnan(smallest_detectable_difference([]))


def test_what_has_no_detectable_difference_is_refused():
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="finite"):
            smallest_detectable_difference([1.0, bad])
    for alpha, power in [(0.0, 0.8), (0.05, 1.0), (0.05, 0.05), (0.9, 0.8), (math.nan, 0.8)]:
        with pytest.raises(ValueError, match="0 < alpha < power < 1"):
            smallest_detectable_difference([1.0, 2.0], alpha, power)


# ------------------------------------------------------------------------------------------------------- the median


@pytest.mark.parametrize("n", [2, 3, 5, 6, 7, 9, 20])
def test_the_interval_of_the_median_covers_what_it_says_and_no_narrower_pair_covers_enough(n):
    rng = np.random.default_rng(n)
    interval = median_interval({str(k): float(k) for k in range(n)})
    low, high = int(interval.low), int(interval.high)
    assert low + high == n - 1
    samples = np.sort(rng.exponential(size=(40_000, n)), axis=1)
    true = math.log(2)
    covers = np.mean((samples[:, low] <= true) & (true <= samples[:, high]))
    assert covers == pytest.approx(interval.level, abs=0.01)
    assert interval.level >= 0.95 or (low, high) == (0, n - 1)
    if low + 1 < high - 1:
        assert np.mean((samples[:, low + 1] <= true) & (true <= samples[:, high - 1])) < 0.95 + 0.01


def test_never_is_a_value_like_any_other():
    some = median_interval({"a": 3.0, "b": math.inf, "c": 5.0})
    assert (some.value, some.low, some.high) == (5.0, 3.0, math.inf)
    assert median_interval({"a": 3.0, "b": math.inf}).value == math.inf
    assert median_interval({"a": 3.0, "b": 5.0}).value == 4.0
    alone = median_interval({"a": 3.0})
    assert alone.value == 3.0
    assert math.isnan(alone.low)
    for bad in ({}, {"a": math.nan}):
        with pytest.raises(ValueError, match="interval"):
            median_interval(bad)
    with pytest.raises(ValueError, match="level"):
        median_interval({"a": 1.0}, level=1.0)


# ------------------------------------------------------------------------------------- the ends of floating point


@pytest.fixture
def no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(
    ("values", "middle"),
    [
        ([-math.inf, math.inf], math.nan),
        ([-math.inf, -math.inf, math.inf, math.inf], math.nan),
        ([-math.inf, math.inf, math.inf], math.inf),
        ([-math.inf, -math.inf], -math.inf),
        ([math.inf] * 4, math.inf),
        ([1.0, math.inf], math.inf),
        ([-math.inf, 1.0, 2.0, math.inf], 1.5),
        ([-math.inf], -math.inf),
    ],
)
def test_medians_of_infinities_of_both_signs(no_warning, values, middle):
    interval = median_interval({str(k): value for k, value in enumerate(values)})
    assert interval.value == pytest.approx(middle, rel=1e-15, nan_ok=True)
    assert (interval.method == "no median between -inf and inf") == math.isnan(middle)


def test_a_test_that_nothing_passes_detects_no_difference(no_warning):
    assert math.isnan(smallest_detectable_difference([1.0, 2.0, 4.0], alpha=1e-300))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("n", [3, 9])
def test_interval_ends_of_what_is_not_finite_are_refused(no_warning, bad, n):
    for function in (interval_ends, cluster_bootstrap):
        with pytest.raises(ValueError, match="leave absent and infinite ones out"):
            function(np.array([[1.0] * n, [bad] * n]))
