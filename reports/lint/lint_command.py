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
    from ihbench.reports.lint.table_files import read_tables
    from ihbench.reports.lint.table_lint import lint, unknown_heads

    if not given.file:
        raise BadInput("report lint: which file? give one or more .tex or .md files")
    readings = {file: read_tables(file) for file in given.file}  # all of them, before anything is said
    tables = sum(len(reading.tables) for reading in readings.values())
    findings = {file: lint(reading.tables) for file, reading in readings.items()}
    for file, reading in readings.items():
        first = {text: line for line, text in sorted(reading.notes, reverse=True)}  # said once, where it is met first
        for head in (head for table in reading.tables for head in unknown_heads(table)):
            what = f"column {head.title or 'without a head'} has marks, but neither a known metric nor an arrow"
            first.setdefault(what, head.cell.line)
        for text, line in sorted(first.items(), key=lambda note: note[::-1]):
            print(f"ihbench: {file}:{line}: note: {text}", file=sys.stderr)
    if given.json:
        rows = [{"file": str(file), **asdict(finding)} for file, of_file in findings.items() for finding in of_file]
        print(json.dumps({"status": "found" if rows else "clean", "tables": tables, "findings": rows}))
    else:
        for file, of_file in findings.items():
            for finding in of_file:
                print(f"{file}:{finding}")
        if not any(findings.values()):
            print(f"nothing found in {tables} table{'' if tables == 1 else 's'}")
    return 1 if any(findings.values()) else 0
