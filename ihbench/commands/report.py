"""`ihbench report`: tables of finished runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench import atomic, registry
from ihbench.commands.parse import options
from ihbench.errors import BadInput


@dataclass(frozen=True)
class ReportOptions:
    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run folders; none means every run under --runs."""
    runs: Path = Path("runs")
    """Folder of run folders."""
    format: str = "md"
    """A registered report."""
    out: Path | None = None
    """File to write; without it the report goes to stdout."""


def main(argv: list[str]) -> int:
    chosen = options(ReportOptions, argv, "report", "Tables of finished runs.")
    from ihbench.results import read_result

    folders = chosen.run or tuple(sorted(p.parent for p in chosen.runs.glob("*/run.json")))
    if not folders:
        raise BadInput(
            f"no run folders under {chosen.runs}; make one with: ihbench run --protocol zju_occ --scene standin-1"
        )
    results = []
    for folder in folders:
        try:
            results.append(read_result(folder))
        except BadInput as error:
            if chosen.run:
                raise
            print(f"ihbench: left out: {error}", file=sys.stderr)
    text = registry.load("report", chosen.format)(results)
    if chosen.out is None:
        print(text, end="")
    else:
        atomic.write_text(chosen.out, text)
    return 0
