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
    chosen = options(LintOptions, argv, "report lint", SUMMARY)
    from ihbench.reports.lint.table_files import read_tables
    from ihbench.reports.lint.table_lint import lint, unknown_heads

    if not chosen.file:
        raise BadInput("report lint: which file? give one or more .tex or .md files")
    readings = {file: read_tables(file) for file in chosen.file}  # all of them, before anything is said
    tables = sum(len(reading.tables) for reading in readings.values())
    found = {file: lint(reading.tables) for file, reading in readings.items()}
    for file, reading in readings.items():
        told: set[str] = set()
        notes = list(reading.notes)
        for table in reading.tables:
            notes += [
                (
                    head.cell.line,
                    f"column {head.title or 'without a head'} has marks, but neither a known metric nor an arrow",
                )
                for head in unknown_heads(table)
            ]
        for line, text in sorted(notes):
            if text not in told:
                print(f"ihbench: {file}:{line}: note: {text}", file=sys.stderr)
            told.add(text)
    if chosen.json:
        rows = [{"file": str(file), **asdict(finding)} for file, findings in found.items() for finding in findings]
        print(json.dumps({"status": "found" if rows else "clean", "tables": tables, "findings": rows}))
    else:
        for file, findings in found.items():
            for finding in findings:
                print(f"{file}:{finding}")
        if not any(found.values()):
            print(f"nothing found in {tables} table{'' if tables == 1 else 's'}")
    return 1 if any(found.values()) else 0
