"""`ihbench report table1` and `ihbench report table2`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ihbench.commands.options.parse import options
from ihbench.commands.options.run_filters import RowOptions
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.record import outputs

if TYPE_CHECKING:
    from ihbench.record.results import RunResult
    from ihbench.reports.paper.paper_table import Frame


@dataclass(frozen=True)
class TableOptions(RowOptions):
    runs: Path = Path("runs")
    """Folder of run folders; finished runs under the table's protocols become measured rows."""
    method: str | None = None
    """Only runs of this method."""
    profile: str | None = None
    """Only runs under this profile."""
    region: str = ""
    """Region of measured numbers, such as full; by default every protocol's headline region."""
    format: Literal["terminal", "md", "tex", "html", "csv", "json"] = "md"
    """How it is written."""
    regions: tuple[str, ...] = ()
    """Several regions of measured numbers, a block for each."""
    metrics: tuple[str, ...] = ()
    """Only these metrics, as psnr or lpips."""
    fragment: bool = False
    """Only the table, without a document around it; in LaTeX the tabular alone, for \\input."""
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
        from ihbench.record.row_choice import Choice
        from ihbench.reports.paper.paper_numbers import paper_table
        from ihbench.reports.paper.paper_table import build_frame

        if chosen.region and chosen.regions:
            raise BadInput("--region and --regions: give one of them")
        outputs.check_file(chosen.out)
        table = paper_table(self.name)
        results, left_out = _results(chosen, [p for group in table.groups for p in group.protocols])
        choice = Choice(chosen.rows, chosen.metrics, chosen.regions, chosen.names)
        frame = build_frame(table, results, chosen.region, chosen.as_printed, choice, left_out)
        text = written(frame, chosen.format, chosen.fragment)
        if chosen.out is None:
            print(text, end="")
        else:
            atomic.write_text(chosen.out, text)
        return 0


def written(frame: Frame, form: str, fragment: bool = False) -> str:
    """The table in a format. Raises `BadInput` for a fragment of what is none."""
    from ihbench.document import csv, document

    if fragment and form not in ("md", "tex", "html"):
        raise BadInput(f"--fragment: {form} has no document around it; leave it out, or take tex, md or html")
    if fragment:
        return document.write_fragment([*frame.tables, *frame.below], form)
    if form not in ("csv", "json"):
        return document.write(frame.blocks, form)
    if form == "csv":
        return csv.write_cells(frame.name, frame.tables, frame.footnotes)
    content = {
        "table": frame.name,
        "title": frame.title,
        "source": frame.source,
        "blocks": [csv.table_data(table, frame.footnotes) for table in frame.tables],
        "footnotes": dict(frame.footnotes),
        "notes": list(frame.notes),
    }
    return json.dumps(atomic.encode(content), indent=1) + "\n"


def _results(chosen: TableOptions, protocols: list[str]) -> tuple[list[RunResult], list[str]]:
    """Runs under these protocols, and the folders left out. No folder of runs is no error: the paper's rows
    are there without one."""
    from ihbench.commands.report import say_left_out
    from ihbench.record.index import Index
    from ihbench.record.shareable import shareable, without_places

    if not chosen.runs.is_dir():
        if chosen.runs != TableOptions.runs:
            raise BadInput(f"--runs {chosen.runs}: no such folder; give a folder of runs or leave it out")
        return [], []
    filters = {name: value for name in ("method", "profile") if (value := getattr(chosen, name)) is not None}
    results: list[RunResult] = []
    left_out: list[str] = []
    for protocol in dict.fromkeys(protocols):
        having, without = Index(chosen.runs).results(protocol=protocol, **filters)
        results += having
        left_out += without
    left_out = list(dict.fromkeys(left_out))
    say_left_out(left_out)
    return shareable(results), [without_places(line) for line in left_out]


TABLE1 = TableCommand("table1", "The paper's Table 1: quoted rows, and what is measured here.")
TABLE2 = TableCommand("table2", "The paper's Table 2, the ablation: quoted rows, and what is measured here.")
