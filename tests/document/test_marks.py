"""Best and second-best: laws over random numbers, and when scenes withhold a mark."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.document.marks import marks_by_interval, marks_by_value, ranks

# few different values make ties common
quickly = settings(max_examples=50, deadline=None)
VALUES = st.lists(st.one_of(st.integers(0, 4).map(float), st.just(math.nan), st.just(math.inf)), max_size=8)


@quickly
@given(VALUES, st.booleans())
def test_marks_follow_from_the_numbers_alone(values, higher):
    marks = marks_by_value(values, higher)
    known = [v if higher else -v for v in values if not math.isnan(v)]
    for value, mark in zip(values, marks, strict=True):
        if math.isnan(value):
            assert mark == ""
            continue
        better = sum(other > (value if higher else -value) for other in known)
        differ = len(set(known)) > 1
        assert (mark == "best") == (better == 0 and differ)
        assert (mark == "second") == (better == 1 and len(known) > 2)


@quickly
@given(VALUES, st.booleans(), st.randoms())
def test_marks_go_with_their_numbers_in_any_order(values, higher, random):
    order = list(range(len(values)))
    random.shuffle(order)
    marks = marks_by_value(values, higher)
    assert marks_by_value([values[k] for k in order], higher) == [marks[k] for k in order]


@quickly
@given(VALUES.filter(lambda v: not any(map(math.isinf, v))))
def test_the_other_way_round_is_the_same_for_opposite_numbers(values):
    assert marks_by_value([-v for v in values], False) == marks_by_value(values, True)


def test_ranks_of_equal_numbers_are_equal_and_nan_has_none():
    assert ranks([2.0, math.nan, 3.0, 2.0, 1.0], True) == [2, 0, 1, 2, 4]


def scenes(*values):
    return {f"s{k}": value for k, value in enumerate(values)}


def marked(*rows, higher=True):
    means = [round(math.fsum(row.values()) / len(row), 2) if row else math.nan for row in rows]
    return marks_by_interval([f"m{k}" for k in range(len(rows))], means, rows, higher)


def test_a_mark_needs_scenes_that_agree():
    good, middle, bad = scenes(30, 20, 25), scenes(29, 19.1, 24), scenes(27.9, 18, 23)
    found = marked(good, middle, bad)
    assert found.marks == ["best", "second", ""]
    assert found.withheld == ""
    # the same means, but the leader leads on one scene only
    lucky = scenes(36, 18, 21)
    found = marked(lucky, middle, bad)
    assert found.marks[0] == ""
    assert "no best mark: m0 against m1: +0.967 [" in found.withheld
    assert "over 3 scenes" in found.withheld


def test_marks_for_less_is_better_mirror_those_for_more():
    rows = [scenes(1.0, 2.0, 3.0), scenes(1.6, 2.5, 3.6), scenes(2.6, 3.5, 4.6)]
    assert marked(*rows, higher=False).marks == ["best", "second", ""]
    assert marked(*[{s: -v for s, v in row.items()} for row in rows]).marks == ["best", "second", ""]


def test_one_scene_or_none_in_common_gives_no_mark():
    assert marked(scenes(30), scenes(20)).marks == ["", ""]
    found = marked({"a": 30.0, "b": 30.1}, {"c": 20.0, "d": 20.1})
    assert found.marks == ["", ""]
    assert "0 scenes in common" in found.withheld


def test_rows_that_show_one_number_share_the_mark_or_its_absence():
    twin = scenes(30, 20, 25)
    assert marked(twin, dict(twin), scenes(20, 10.1, 15)).marks == ["best", "best", ""]
    # its own scenes would give the first a mark, the second's would not
    shaky = scenes(33, 17, 25)
    assert marked(twin, shaky, scenes(29, 19.1, 24)).marks == ["", "", ""]


@quickly
@given(
    st.lists(st.lists(st.integers(0, 30), min_size=3, max_size=3), min_size=2, max_size=4),
    st.booleans(),
)
def test_scenes_can_only_take_marks_away(rows, higher):
    per_scene = [scenes(*map(float, row)) for row in rows]
    shown = [math.fsum(row.values()) / 3 for row in per_scene]
    by_value = marks_by_value(shown, higher)
    by_interval = marks_by_interval([str(k) for k in range(len(rows))], shown, per_scene, higher).marks
    for given_mark, kept in zip(by_value, by_interval, strict=True):
        assert kept in ("", given_mark)


@pytest.mark.parametrize("values", [[], [1.0], [math.nan, 1.0], [2.0, 2.0, 2.0]])
def test_nothing_is_marked_where_nothing_is_better(values):
    assert set(marks_by_value(values, True)) <= {""}
