"""The tables of a document for programs: CSV, and plain data for JSON."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ihbench.document.document import Block, Bullets, Heading, Number, Paragraph, Span, Table, plain_text, spans
from ihbench.errors import visible

FORMULA = ("=", "+", "-", "@", "\t", "\r")  # what a spreadsheet runs


def write(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """The rows of every table under its head; where there are several, the first column names the heading or title
    that each stands under, and an empty line is between two. Where there is none, what is said line by line."""
    if not any(isinstance(block, Table) for block in blocks):
        blocks = [Table(("under", "text"), tuple(_sentences(blocks)))]
    out = io.StringIO()
    lines = csv.writer(out, lineterminator="\n")
    several, under = sum(isinstance(block, Table) for block in blocks) > 1, ""
    begun = False
    for block in blocks:
        if isinstance(block, Heading):
            under = block.text
        elif isinstance(block, Table):
            out.write("\n" * begun)
            begun = True
            for first, row in (("table", block.head), *((block.title or under, row) for row in block.rows)):
                cells = [*([first] if several else []), *map(plain_text, row)]
                lines.writerow([harmless(cell) for cell in cells])
    return out.getvalue()


def _sentences(blocks: Sequence[Block]) -> Iterator[tuple[str, str]]:
    under = ""
    for block in blocks:
        if isinstance(block, Heading):
            under = block.text
        elif isinstance(block, Paragraph | Bullets):
            for words in (block.words,) if isinstance(block, Paragraph) else block.items:
                yield under, plain_text(words)


def write_cells(name: str, tables: Sequence[Table], footnotes: Mapping[str, str]) -> str:
    """One line for each number of the tables: its row and column, and what it is worth. Absent numbers are empty;
    footnotes are in words."""
    cells = (
        {
            "table": name,
            "block": table.title,
            "kind": table.kind,
            "row": label.name,
            "section": label.section,
            "calibration": "yes" if label.bound else "no",
            "group": column.group,
            "metric": column.metric.title,
            "unit": column.metric.unit,
            **_number(number, footnotes),
            "row_footnotes": _of_row(table, k, footnotes),
        }
        for table in tables
        for k, label in enumerate(table.labels)
        for column, number in zip(table.columns, table.numbers(k), strict=True)
    )
    return write_rows([*cells], ["table"])


def write_rows(rows: Sequence[Mapping[str, Any]], first: Sequence[str] = ()) -> str:
    """Rows with the columns of all of them, in order, behind the `first` ones; numbers to the last bit, an absent one
    is an empty cell."""
    out = io.StringIO()
    names = dict.fromkeys([*first, *(name for row in rows for name in row)])
    lines = csv.DictWriter(out, list(names), lineterminator="\n")
    lines.writeheader()
    lines.writerows({key: _value(value) for key, value in row.items()} for row in rows)
    return out.getvalue()


def table_data(table: Table, footnotes: Mapping[str, str]) -> dict[str, object]:
    """A table of numbers as plain data."""
    head = [plain_text(cell) for cell in table.head]
    ticks = slice(table.left, table.left + table.ticks)
    return {
        "title": table.title,
        "kind": table.kind,
        "components": head[ticks],
        "columns": [
            {"group": c.group, "metric": c.key, "title": c.title, "higher_is_better": c.metric.higher_is_better}
            for c in table.columns
        ],
        "rows": [
            {
                "row": label.name,
                "section": label.section,
                "status": plain_text(table.rows[k][1]),
                "calibration": label.bound,
                "footnotes": _of_row(table, k, footnotes),
                "components": [plain_text(cell) for cell in table.rows[k][ticks]],
                "cells": [_number(number, footnotes) for number in table.numbers(k)],
            }
            for k, label in enumerate(table.labels)
        ],
        "notes": list(table.notes),
    }


def _of_row(table: Table, k: int, footnotes: Mapping[str, str]) -> list[str]:
    """What the letters at a row's name say."""
    said = [piece.text for piece in spans(table.rows[k][0]) if isinstance(piece, Span) and piece.style == "raised"]
    return [footnotes[letter] for letter in ", ".join(said).split(", ") if letter in footnotes]


def _number(number: Number, footnotes: Mapping[str, str]) -> dict[str, object]:
    return {
        "text": f"{number.text} {number.interval}".rstrip(),
        "value": number.value,
        "low": number.low,
        "high": number.high,
        "scenes": number.scenes,
        "status": number.status,
        "mark": number.mark,
        "reason": number.reason,
        "identity": number.identity,
        "footnotes": [footnotes[letter] for letter in number.footnotes],
    }


def _value(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return harmless(" | ".join(value) if isinstance(value, list) else value)


def harmless(value: Any) -> Any:
    """A CSV's cell. Names from elsewhere must not become formulas in a spreadsheet; numbers may be negative."""
    if not isinstance(value, str):
        return value
    try:
        float(value)
    except ValueError:
        shown = visible(value, keep="\n")
        return "'" + shown if value.startswith(FORMULA) else shown
    return value
