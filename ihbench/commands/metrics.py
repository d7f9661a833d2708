"""`ihbench metrics check`: every metric against its oracle, other libraries, and stored values."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ihbench.clock import streams
from ihbench.commands.options.parse import options

if TYPE_CHECKING:
    from ihbench.metrics.oracles.check import Comparison


TABLE_WIDTH = 165  # characters; a narrower terminal would cut the numbers


@dataclass(frozen=True)
class Check:
    verb: Annotated[Literal["check"], tyro.conf.Positional]
    """check: compare every metric with its oracle, other libraries and stored values; status 1 if one is off."""
    lpips_examples: Path | None = None
    """Folder with ex_ref.png, ex_p0.png and ex_p1.png of the LPIPS authors, whose values they publish."""
    all: bool = False
    """Every comparison; without it those of one metric and reference share a line, the worst of them shown."""
    json: bool = False
    """Print one JSON object on stdout."""


def main(argv: list[str]) -> int:
    chosen = options(Check, argv, "metrics", "Check the metrics against oracles, libraries and stored values.")
    from ihbench.metrics.oracles.check import check, mismatches

    found = check(examples=chosen.lpips_examples)
    wrong = mismatches(found)
    if chosen.json:
        from ihbench.files.atomic import encode

        rows = [asdict(c) | {"difference": c.difference, "ok": c.ok} for c in found]
        print(json.dumps(encode({"ok": not wrong, "comparisons": rows}), allow_nan=False))
    else:
        _print(found if chosen.all else _worst(found))
        compared = sum(not c.absent for c in found)
        print(f"{compared} comparisons, {len(wrong)} mismatches, {len(found) - compared} not possible here")
    return 1 if wrong else 0


def _worst(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Of each metric and reference the comparison nearest to its tolerance, or beyond; what is absent stays."""
    found: dict[tuple[str, str], Comparison] = {}
    for c in comparisons:
        key = c.metric, c.reference
        if key not in found or _share(c) > _share(found[key]):
            found[key] = c
    return list(found.values())


def _share(c: Comparison) -> float:
    return -1.0 if c.absent else c.difference / c.tolerance if c.tolerance else c.difference


def _print(comparisons: Sequence[Comparison]) -> None:
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE, pad_edge=False)
    for head in ("metric", "case", "against", "ours", "theirs", "differ", "allowed", ""):
        table.add_column(head, no_wrap=True)
    for c in comparisons:
        if c.absent:
            table.add_row(c.metric, c.case, c.reference, "–", "–", "–", "–", "not possible here")
        else:
            verdict = "ok" if c.ok else "MISMATCH"
            table.add_row(
                c.metric, c.case, c.reference, f"{c.ours:.10g}", f"{c.theirs:.10g}", f"{c.difference:.0e}",
                f"{c.tolerance:.0e}", verdict,
            )  # fmt: skip
    with streams.styled():
        Console(width=max(Console().width, TABLE_WIDTH)).print(table)
    for why in dict.fromkeys(c.why for c in comparisons if not c.absent):
        allowed = max(c.tolerance for c in comparisons if c.why == why)
        print(f"allowed {allowed:.0e}: {why}")
    for c in comparisons:
        if c.absent:
            print(f"not possible here: {c.metric} against {c.reference}: {c.why}")
