"""`ihbench metrics check`: every metric against its oracle, other libraries, and stored values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Printing
from ihbench.document.document import Block, Paragraph, Table

if TYPE_CHECKING:
    from ihbench.metrics.oracles.check import Comparison


@dataclass(frozen=True)
class Check(Printing):
    verb: Annotated[Literal["check"], tyro.conf.Positional]
    """check: compare every metric with its oracle, other libraries and stored values; status 1 if one is off."""
    lpips_examples: Path | None = None
    """Folder with ex_ref.png, ex_p0.png and ex_p1.png of the LPIPS authors, whose values they publish."""
    all: bool = False
    """Every comparison; without it those of one metric and reference share a line, the worst of them shown."""


def main(argv: list[str]) -> int:
    chosen = options(Check, argv, "metrics", "Check the metrics against oracles, libraries and stored values.")
    from ihbench.metrics.oracles.check import check, mismatches

    comparisons = check(examples=chosen.lpips_examples)
    wrong = mismatches(comparisons)
    rows = [asdict(c) | {"difference": c.difference, "ok": c.ok} for c in comparisons]
    compared = sum(not c.absent for c in comparisons)
    counted = f"{compared} comparisons, {len(wrong)} mismatches, {len(comparisons) - compared} not possible here"
    blocks = [*_blocks(comparisons if chosen.all else _worst(comparisons)), Paragraph(counted)]
    chosen.show({"ok": not wrong, "comparisons": rows}, blocks)
    return 1 if wrong else 0


def _worst(comparisons: Sequence[Comparison]) -> list[Comparison]:
    """Of each metric and reference the comparison nearest to its tolerance, or beyond; what is absent stays."""
    worst_of: dict[tuple[str, str], Comparison] = {}
    for c in comparisons:
        key = c.metric, c.reference
        if key not in worst_of or _share(c) > _share(worst_of[key]):
            worst_of[key] = c
    return list(worst_of.values())


def _share(c: Comparison) -> float:
    return -1.0 if c.absent else c.difference / c.tolerance if c.tolerance else c.difference


def _blocks(comparisons: Sequence[Comparison]) -> list[Block]:
    rows: list[tuple[str, ...]] = []
    for c in comparisons:
        numbers = (f"{c.ours:.10g}", f"{c.theirs:.10g}", f"{c.difference:.0e}", f"{c.tolerance:.0e}")
        verdict = ("–",) * 4 + ("not possible here",) if c.absent else (*numbers, "ok" if c.ok else "MISMATCH")
        rows.append((c.metric, c.case, c.reference, *verdict))
    blocks: list[Block] = [
        Table(("metric", "case", "against", "ours", "theirs", "differ", "allowed", "verdict"), tuple(rows), left=3)
    ]
    for why in dict.fromkeys(c.why for c in comparisons if not c.absent):
        allowed = max(c.tolerance for c in comparisons if c.why == why)
        blocks.append(Paragraph(f"allowed {allowed:.0e}: {why}"))
    absent = [f"not possible here: {c.metric} against {c.reference}: {c.why}" for c in comparisons if c.absent]
    return [*blocks, *map(Paragraph, absent)]
