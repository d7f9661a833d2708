"""Best and second-best marks, computed from the numbers.

By value, where nothing else is known: equal numbers share a mark, and two best leave no second. By intervals, where
scenes are: a mark is given only to a number that differs from every other one over the scenes that both rows have.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from ihbench.metrics.statistics import Interval, mean_interval

BEST, SECOND = "best", "second"


def ranks(values: Sequence[float], higher_is_better: bool) -> list[int]:
    """1 + how many are strictly better; 0 for NaN, which has no rank."""
    sign = 1 if higher_is_better else -1
    known = sorted(sign * value for value in values if not math.isnan(value))
    return [0 if math.isnan(value) else 1 + len(known) - bisect_right(known, sign * value) for value in values]


def marks_by_value(values: Sequence[float], higher_is_better: bool) -> list[str]:
    """ "best", "second" or "" for every value. Nothing is marked where nothing is better than something else,
    and of two numbers the second-best, which is the last, is not."""
    places = ranks(values, higher_is_better)
    if max(places, default=0) <= 1:
        return [""] * len(values)
    names = {1: BEST, 2: SECOND} if sum(rank > 0 for rank in places) > 2 else {1: BEST}
    return [names.get(rank, "") for rank in places]


@dataclass(frozen=True)
class IntervalMarks:
    marks: list[str]
    withheld: str = ""  # why a mark that the values alone would give is not there, in words


def marks_by_interval(
    labels: Sequence[str],
    shown: Sequence[float],  # means as the table shows them; NaN for absent ones
    scenes: Sequence[Mapping[str, float]],  # of each row: scene -> mean, finite
    higher_is_better: bool,
    level: float = 0.95,
) -> IntervalMarks:
    """The marks by value that the scenes confirm.

    A row keeps its mark if, against every row that shows another number, the interval of the mean difference over
    common scenes lies on the right side of zero. "Better than each" is an intersection of claims: every single test
    at the level keeps the whole at it, so nothing is to be adjusted (Berger 1982, intersection-union tests). Rows
    that show the same number share a mark.
    """
    ranked, marks = ranks(shown, higher_is_better), marks_by_value(shown, higher_is_better)
    kept, reasons = list(marks), []
    for k, mark in enumerate(marks):
        rivals = [j for j in range(len(marks)) if ranked[j] and ranked[j] != ranked[k]] if mark else []
        for j in rivals:
            doubt = _doubt(scenes[k], scenes[j], (ranked[k] < ranked[j]) == higher_is_better, level)
            if doubt is not None:
                kept[k] = ""
                reasons.append(f"no {mark} mark: {labels[k]} against {labels[j]}: {doubt}")
                break
    # of several rows with one number, all have the mark or none
    bare = {ranked[k] for k in range(len(kept)) if not kept[k]}
    kept = ["" if ranked[k] in bare else kept[k] for k in range(len(kept))]
    return IntervalMarks(kept, "; ".join(reasons))


def _doubt(a: Mapping[str, float], b: Mapping[str, float], a_is_larger: bool, level: float) -> str | None:
    """Why the scenes do not confirm that the mean of `a` is the larger (or the smaller) one; None when they do."""
    common = sorted(set(a) & set(b))
    if len(common) < 2:
        return f"{len(common)} scenes in common give no interval"
    difference: Interval = mean_interval({scene: a[scene] - b[scene] for scene in common}, level)
    if (difference.low > 0) if a_is_larger else (difference.high < 0):
        return None
    return f"{difference.value:+.3g} [{difference.low:+.3g}, {difference.high:+.3g}] over {len(common)} scenes"
