"""`ihbench report table1` and `ihbench report table2`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ihbench import atomic, outputs
from ihbench.commands.parse import options
from ihbench.errors import BadInput


@dataclass(frozen=True)
class TableOptions:
    runs: Path = Path("runs")
    """Folder of run folders; finished runs under the table's protocols become measured rows."""
    method: str | None = None
    """Only runs of this method."""
    profile: str | None = None
    """Only runs under this profile."""
    region: str = ""
    """Region of measured numbers, such as full; by default every protocol's headline region."""
    format: Literal["md", "tex", "html", "csv", "json"] = "md"
    """How it is written."""
    as_printed: bool = False
    """Give quoted rows the paper's own marks, wrong ones included, in place of computed ones."""
    out: Path | None = None
    """File to write; without it the table goes to stdout."""


@dataclass(frozen=True)
class TableCommand:
    """A table of the paper as a verb of `ihbench report`."""

    name: str
    summary: str

    def main(self, argv: list[str]) -> int:
        chosen = options(TableOptions, argv, f"report {self.name}", self.summary)
        from ihbench.reports.paper_numbers import paper_table
        from ihbench.reports.paper_table import build_frame

        outputs.check_file(chosen.out)
        table = paper_table(self.name)
        frame = build_frame(
            table,
            _results(chosen, [p for group in table.groups for p in group.protocols]),
            chosen.region,
            chosen.as_printed,
        )
        text = _writer(chosen.format)(frame)
        if chosen.out is None:
            print(text, end="")
        else:
            atomic.write_text(chosen.out, text)
        return 0


def _writer(name: str) -> Callable[..., str]:
    """Imported when asked for: a page or a document brings more than a CSV file needs."""
    if name == "md":
        from ihbench.reports.table_markdown import write
    elif name == "tex":
        from ihbench.reports.table_latex import write
    elif name == "html":
        from ihbench.reports.table_html import write
    elif name == "csv":
        from ihbench.reports.table_data import write_csv as write
    else:
        from ihbench.reports.table_data import write_json as write
    return write


def _results(chosen: TableOptions, protocols: list[str]) -> list:
    """Runs under these protocols. No folder of runs is no error: the paper's rows are there without one."""
    from ihbench.index import UNREADABLE, Index
    from ihbench.results import read_result

    if not chosen.runs.is_dir():
        if chosen.runs != TableOptions.runs:
            raise BadInput(f"--runs {chosen.runs}: no such folder; give a folder of runs or leave it out")
        return []
    wanted = {name: getattr(chosen, name) for name in ("method", "profile")}
    wanted = {name: value for name, value in wanted.items() if value is not None}
    index = Index(chosen.runs)
    for row in index.query(status=UNREADABLE):
        print(f"ihbench: left out: {chosen.runs / row['path']}: {row['reason']}", file=sys.stderr)
    found = []
    for protocol in dict.fromkeys(protocols):
        for row in index.query(protocol=protocol, **wanted):
            try:
                found.append(read_result(chosen.runs / row["path"]))
            except BadInput as error:
                print(f"ihbench: left out: {error}", file=sys.stderr)
    return found


TABLE1 = TableCommand("table1", "The paper's Table 1: quoted rows, and what is measured here.")
TABLE2 = TableCommand("table2", "The paper's Table 2, the ablation: quoted rows, and what is measured here.")
