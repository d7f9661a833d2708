"""What became of the cases, in words and as data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

from ihbench.document.document import Block, Paragraph, RowLabel, Table
from ihbench.stress.case import Outcome

UNITS = {"ulp": "ulp", "relative": "rel", "absolute": "abs", "at most": "over", "words": "words"}


def data_of(outcomes: Sequence[Outcome], seconds: float, processor_seconds: float) -> dict[str, object]:
    """{"ok", "seconds", …, "machine", "cases": […]}."""
    from ihbench.clock import machine

    return {
        "ok": not failures(outcomes),
        "seconds": seconds,
        "processor_seconds": processor_seconds,
        "machine": machine.identity(),
        "cases": [outcome.row() for outcome in outcomes],
    }


def failures(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Those that failed and are not listed as known."""
    return [outcome for outcome in outcomes if outcome.verdict == "failed"]


def blocks_of(outcomes: Sequence[Outcome], seconds: float, processor_seconds: float) -> list[Block]:
    """A table of every case; then, in words, what failed and why, what else was seen, and why errors are allowed."""
    head = ("case", "what", "got", "expected", "error", "allowed", "condition", "s", "verdict")
    labels = tuple(RowLabel(outcome.case.name, outcome.case.group) for outcome in outcomes)
    lines = [f"{o.verdict}: {o.case.name}: {o.reason}" for o in outcomes if o.verdict != "passed"]
    lines += [f"seen: {outcome.case.name}: {outcome.note}" for outcome in outcomes if outcome.note]
    for why in dict.fromkeys(outcome.case.why for outcome in outcomes):
        tolerance, unit = max((o.case.tolerance, UNITS[o.case.unit]) for o in outcomes if o.case.why == why)
        lines.append(f"allowed up to {tolerance:g} {unit}: {why}")
    lines.append(f"{summary(outcomes)}, in {seconds:.1f} s ({processor_seconds:.1f} s of processor time)")
    return [Table(head, tuple(map(_cells, outcomes)), left=4, labels=labels), *map(Paragraph, lines)]


def summary(outcomes: Sequence[Outcome]) -> str:
    """How many cases there were, by group, and what became of them."""
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    groups = Counter(outcome.case.group for outcome in outcomes)
    counts = ", ".join(f"{group} {count}" for group, count in groups.items())
    text = f"{verdicts['passed']} passed, {verdicts['known']} known to fail, {verdicts['failed']} failed"
    return f"{len(outcomes)} cases ({counts}): {text}"


def _cells(outcome: Outcome) -> tuple[str, ...]:
    case = outcome.case
    words = case.unit == "words"
    unit = UNITS[case.unit]
    return (
        case.name,
        case.what,
        "in words" if words else _number(outcome.value),
        "in words" if words else _number(outcome.expected),
        ("as expected" if outcome.error == 0 else "others") if words else f"{outcome.error:.2g} {unit}",
        "–" if words else f"{case.tolerance:g}",
        "–" if outcome.condition is None else f"{outcome.condition:.1g}",
        f"{outcome.seconds:.1f}",
        "" if outcome.verdict == "passed" else outcome.verdict.upper(),
    )


def _number(value: Any) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g}" if math.isnan(value) or math.isinf(value) else f"{value:.6g}"
