"""What a case is, what it found, and what became of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Unit = Literal["ulp", "relative", "absolute", "at most", "words"]
Verdict = Literal["passed", "failed", "known"]


@dataclass(frozen=True)
class Answer:
    """What a case computed and what is right: numbers or arrays of them, NaN and infinity included, or words."""

    value: Any
    expected: Any
    condition: float | None = None  # relative change of the answer per relative change of the input
    scale: float | None = None  # the size that errors are relative to; None: each expected number's own
    precision: type[np.floating] = np.float64  # in which one ulp is meant
    note: str = ""  # what else was seen


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input. Changing what it asks means a new version."""

    name: str
    what: str  # in a line
    function: Callable[[], Answer]
    unit: Unit  # of the error: see `error_of`
    tolerance: float
    why: str  # it is that large
    group: str
    known: str = ""  # why it is known to fail; "" for a case that must pass
    version: int = 1


@dataclass(frozen=True)
class Outcome:
    """A case that was run."""

    case: Case
    value: float | str  # where the error is largest
    expected: float | str
    error: float  # in the case's unit; inf where one side is not finite, or the words are others
    condition: float | None
    verdict: Verdict
    reason: str  # of a failure
    note: str
    seconds: float

    def row(self) -> dict[str, object]:
        """As plain data, without the function."""
        case = self.case
        return {
            "name": case.name, "version": case.version, "group": case.group, "what": case.what,
            "value": self.value, "expected": self.expected, "error": self.error, "unit": case.unit,
            "condition": self.condition, "tolerance": case.tolerance, "why": case.why, "verdict": self.verdict,
            "reason": self.reason, "note": self.note, "seconds": self.seconds,
        }  # fmt: skip


def error_of(answer: Answer, unit: Unit) -> tuple[float, float | str, float | str]:
    """The largest error of an answer, and the value and the expected one where it is.

    "ulp" counts steps between neighbouring numbers of the answer's precision at the expected size, "relative" divides
    by that size, "at most" counts what the value exceeds the expected one by, "words" is 0 where the expected words
    occur in the value. Equal infinities and two NaN agree; a number against either of them is infinitely wrong.
    """
    if unit == "words":
        value, expected = str(answer.value), str(answer.expected)
        return (0.0 if expected in value else math.inf), value, expected
    value, expected = np.asarray(answer.value, np.float64), np.asarray(answer.expected, np.float64)
    try:
        value, expected = np.broadcast_arrays(value, expected)
    except ValueError:
        return math.inf, f"shape {value.shape}", f"shape {expected.shape}"
    if value.size == 0:
        return 0.0, math.nan, math.nan
    finite = np.isfinite(value) & np.isfinite(expected)
    same = (value == expected) | (np.isnan(value) & np.isnan(expected))
    with np.errstate(invalid="ignore", over="ignore"):
        error = np.abs(value - expected)
        size = np.abs(expected) if answer.scale is None else np.full(error.shape, abs(answer.scale))
        if unit == "at most":
            error = np.maximum(value - expected, 0)
        elif unit == "relative":
            error = np.divide(error, size, out=np.full(error.shape, math.inf), where=size > 0)
        elif unit == "ulp":
            error = error / np.spacing(size.astype(answer.precision)).astype(np.float64)
    error = np.where(same, 0.0, np.where(finite, error, math.inf))
    worst = np.unravel_index(int(np.argmax(error)), error.shape)
    return float(error[worst]), float(value[worst]), float(expected[worst])


def words_of(error: type[Exception], function: Callable[[], Any]) -> str:
    """What a function says when it refuses with such an exception; "was not refused" when it does not."""
    try:
        function()
    except error as refusal:
        return str(refusal)
    return "was not refused"
