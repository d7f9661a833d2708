"""Means over frames and subjects: nothing is mixed, nothing disappears."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.metrics import Score, macro_mean, mean_over_frames

IDENTITY = "psnr/pooled/range1/body/v1"


def scores(*values: float | str) -> list[Score]:
    return [Score.missing(IDENTITY, v) if isinstance(v, str) else Score(v, IDENTITY) for v in values]


def test_finite_numbers():
    mean = mean_over_frames(scores(20.0, 30.0, 25.0))
    assert (mean.value, mean.identity, mean.n, mean.infinite, mean.absent_count) == (25.0, IDENTITY, 3, 0, 0)
    assert mean.note == ""


def test_infinite_frames_are_left_out_and_counted():
    mean = mean_over_frames(scores(20.0, math.inf, 30.0))
    assert (mean.value, mean.n, mean.infinite) == (25.0, 2, 1)
    assert mean.note == "1 of 3 without any error (inf) left out"


def test_nothing_but_infinite_frames_is_infinite():
    mean = mean_over_frames(scores(math.inf, math.inf, "empty"))
    assert (mean.value, mean.n, mean.infinite, mean.absent_count) == (math.inf, 0, 2, 1)


def test_absent_frames_are_left_out_and_counted():
    mean = mean_over_frames(scores("empty region", 20.0, "no truth", "no truth"))
    assert (mean.value, mean.n, mean.absent_count) == (20.0, 1, 3)
    assert mean.note == "3 of 4 absent: no truth"


def test_nothing_but_absent_frames_is_absent_with_the_commonest_reason():
    mean = mean_over_frames(scores("a", "b", "b"))
    assert mean.absent
    assert mean.reason == "b"
    assert mean.absent_count == 3


def test_identities_are_never_mixed():
    with pytest.raises(ValueError, match=r"body.*full"):
        mean_over_frames([*scores(20.0), Score(30.0, "psnr/pooled/range1/full/v1")])
    with pytest.raises(ValueError, match="no scores"):
        mean_over_frames([])


def test_the_macro_mean_counts_each_subject_once():
    subjects = {"377": mean_over_frames(scores(*[20.0] * 100)), "386": mean_over_frames(scores(30.0))}
    mean = macro_mean(subjects)
    assert (mean.value, mean.n) == (25.0, 2)


def test_an_absent_subject_is_said():
    mean = macro_mean({"377": scores(20.0)[0], "386": scores("diverged")[0]})
    assert mean.value == 20.0
    assert mean.note == "1 of 2 absent: diverged"


@given(st.lists(st.one_of(st.floats(0, 100), st.just(math.inf), st.sampled_from(["a", "b"])), min_size=1))
@settings(deadline=None, derandomize=True)
def test_every_frame_is_counted_once_whatever_the_order(values):
    mean = mean_over_frames(scores(*values))
    assert mean.n + mean.infinite + mean.absent_count == len(values)
    backwards = mean_over_frames(scores(*reversed(values)))
    assert backwards.value == mean.value or (backwards.absent and mean.absent)
    finite = [v for v in values if isinstance(v, float) and math.isfinite(v)]
    if finite:
        assert min(finite) - 1e-9 <= mean.value <= max(finite) + 1e-9


@pytest.mark.parametrize("bad", [-math.inf, 1e101, -1.7e308])
def test_what_no_metric_gives_is_counted_as_absent_with_its_value(bad):
    mean = mean_over_frames(scores(20.0, bad, 30.0, bad))
    assert (mean.value, mean.n, mean.infinite, mean.absent_count) == (25.0, 2, 0, 2)
    assert f"{bad:g} is no metric's value" in mean.note
    alone = mean_over_frames(scores(bad, bad))
    assert alone.absent
    assert f"{bad:g}" in alone.reason
    both = mean_over_frames(scores(math.inf, -math.inf))
    assert (both.value, both.infinite, both.absent_count) == (math.inf, 1, 1)
