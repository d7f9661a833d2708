"""`ihbench report lint FILE`: what is wrong with the tables of a .tex or .md file."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ihbench.commands.options.parse import options
from ihbench.errors import BadInput

SUMMARY = "Wrong marks, missing arrows, mixed units and claims within noise in the tables of .tex and .md files."


@dataclass(frozen=True)
class LintOptions:
    file: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Files to look at, .tex or .md."""
    json: bool = False
    """Print one JSON object on stdout."""


def main(argv: list[str]) -> int:
    """Print one line for each finding; status 1 if there are any. What was not understood goes to stderr."""
    given = options(LintOptions, argv, "report lint", SUMMARY)
    from ihbench.reports.lint.metric_names import NO_METRIC
    from ihbench.reports.lint.table_files import read_tables
    from ihbench.reports.lint.table_lint import lint

    if not given.file:
        raise BadInput("report lint: which file? give one or more .tex or .md files")
    readings = {file: read_tables(file) for file in given.file}  # all of them, before anything is said
    found = [(file, finding) for file, (tables, _) in readings.items() for finding in lint(tables)]
    for file, (tables, notes) in readings.items():
        for column in (column for table in tables for column in table.columns):
            if column.metric == NO_METRIC and any(cell.mark for cell in column.cells):
                what = f"column {column.title or 'without a head'} has marks, but neither a known metric nor an arrow"
                notes.append((column.line, what))
        first = {text: line for line, text in sorted(notes, reverse=True)}  # said once, where it is met first
        for text, line in sorted(first.items(), key=lambda note: note[::-1]):
            print(f"ihbench: {file}:{line}: note: {text}", file=sys.stderr)
    count = sum(len(tables) for tables, _ in readings.values())
    if given.json:
        rows = [{"file": str(file), **asdict(finding)} for file, finding in found]
        print(json.dumps({"status": "found" if rows else "clean", "tables": count, "findings": rows}))
    elif found:
        print("\n".join(f"{file}:{finding}" for file, finding in found))
    else:
        print(f"nothing found in {count} table{'' if count == 1 else 's'}")
    return 1 if found else 0
