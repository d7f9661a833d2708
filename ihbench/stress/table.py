"""Printing what became of the cases."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from typing import Any

from ihbench.clock import streams
from ihbench.stress.case import Outcome

TABLE_WIDTH = 150  # characters; a narrower terminal would cut the numbers
UNITS = {"ulp": "ulp", "relative": "rel", "absolute": "abs", "at most": "over", "words": "words"}


def as_json(outcomes: Sequence[Outcome], seconds: float, processor_seconds: float) -> str:
    """One strict JSON object {"ok", "seconds", …, "machine", "cases": […]}; NaN and infinities as in `atomic`."""
    from ihbench.clock import machine
    from ihbench.files.atomic import encode

    found = {
        "ok": not failures(outcomes),
        "seconds": seconds,
        "processor_seconds": processor_seconds,
        "machine": machine.identity(),
        "cases": [outcome.row() for outcome in outcomes],
    }
    return json.dumps(encode(found), allow_nan=False)


def failures(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Those that failed and are not listed as known."""
    return [outcome for outcome in outcomes if outcome.verdict == "failed"]


def print_table(outcomes: Sequence[Outcome], seconds: float, processor_seconds: float) -> None:
    """A table of every case; then, in words, what failed and why, what else was seen, and why errors are allowed."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE, pad_edge=False)
    for head in ("case", "what", "got", "expected", "error", "allowed", "condition", "s", ""):
        table.add_column(head, no_wrap=head != "what", justify="right" if head == "s" else "left")
    for _, group in groupby(outcomes, key=lambda outcome: outcome.case.group):
        for outcome in group:
            table.add_row(*_cells(outcome))
        table.add_section()
    with streams.styled():
        Console(width=max(Console().width, TABLE_WIDTH)).print(table)
    for outcome in outcomes:
        if outcome.verdict != "passed":
            print(f"{outcome.verdict}: {outcome.case.name}: {outcome.reason}")
    for outcome in outcomes:
        if outcome.note:
            print(f"seen: {outcome.case.name}: {outcome.note}")
    for why in dict.fromkeys(outcome.case.why for outcome in outcomes):
        allowed = [(o.case.tolerance, UNITS[o.case.unit]) for o in outcomes if o.case.why == why]
        tolerance, unit = max(allowed)
        print(f"allowed up to {tolerance:g} {unit}: {why}")
    print(f"{summary(outcomes)}, in {seconds:.1f} s ({processor_seconds:.1f} s of processor time)")


def summary(outcomes: Sequence[Outcome]) -> str:
    """How many cases there were, by group, and what became of them."""
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    groups = Counter(outcome.case.group for outcome in outcomes)
    counts = ", ".join(f"{group} {count}" for group, count in groups.items())
    told = f"{verdicts['passed']} passed, {verdicts['known']} known to fail, {verdicts['failed']} failed"
    return f"{len(outcomes)} cases ({counts}): {told}"


def _cells(outcome: Outcome) -> list[str]:
    case = outcome.case
    words = case.unit == "words"
    unit = UNITS[case.unit]
    return [
        case.name,
        case.what,
        "in words" if words else _number(outcome.value),
        "in words" if words else _number(outcome.expected),
        ("as expected" if outcome.error == 0 else "others") if words else f"{outcome.error:.2g} {unit}",
        "–" if words else f"{case.tolerance:g}",
        "–" if outcome.condition is None else f"{outcome.condition:.1g}",
        f"{outcome.seconds:.1f}",
        "" if outcome.verdict == "passed" else outcome.verdict.upper(),
    ]


def _number(value: Any) -> str:
    if isinstance(value, str):
        return value
    return f"{value:g}" if math.isnan(value) or math.isinf(value) else f"{value:.6g}"
