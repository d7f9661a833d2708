"""A paper's table for programs: CSV with one line for each cell, and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

from ihbench.document.diagram import harmless
from ihbench.files import atomic
from ihbench.reports.paper.paper_table import Block, Cell, Frame, Row

FIELDS: tuple[str, ...] = (
    "table", "block", "kind", "row", "section", "calibration", "group", "metric", "unit", "text", "value", "low",
    "high", "scenes", "status", "mark", "reason", "identity", "footnotes",
)  # fmt: skip


def write_csv(frame: Frame) -> str:
    """One line for each cell. Absent numbers are empty; footnotes are in words."""
    out = io.StringIO()
    lines = csv.DictWriter(out, FIELDS, lineterminator="\n")
    lines.writeheader()
    for block in frame.blocks:
        for row in block.rows:
            for column, cell in zip(block.columns, row.cells, strict=True):
                about = {
                    "table": frame.name,
                    "block": block.title,
                    "kind": block.kind,
                    "row": row.label,
                    "section": row.section,
                    "calibration": "yes" if row.calibration else "no",
                    "group": column.group,
                    "metric": column.metric.title,
                    "unit": column.metric.unit,
                    **{key: _csv_value(value) for key, value in _cell(frame, cell).items()},
                }
                lines.writerow({key: harmless(value) for key, value in about.items()})
    return out.getvalue()


def write_json(frame: Frame) -> str:
    """Strict JSON; numbers that are not finite are strings, as in every file of this bench."""
    content = {
        "table": frame.name,
        "title": frame.title,
        "source": frame.source,
        "blocks": [_block(frame, block) for block in frame.blocks],
        "footnotes": dict(frame.footnotes),
        "notes": list(frame.notes),
    }
    return json.dumps(atomic.encode(content), indent=1) + "\n"


def _block(frame: Frame, block: Block) -> dict[str, Any]:
    return {
        "title": block.title,
        "kind": block.kind,
        "components": list(block.components),
        "columns": [
            {"group": c.group, "metric": c.key, "title": c.title, "higher_is_better": c.metric.higher_is_better}
            for c in block.columns
        ],
        "rows": [_row(frame, row) for row in block.rows],
        "notes": list(block.notes),
    }


def _row(frame: Frame, row: Row) -> dict[str, Any]:
    return {
        "row": row.label,
        "section": row.section,
        "status": row.status,
        "calibration": row.calibration,
        "components": list(row.components),
        "cells": [_cell(frame, cell) for cell in row.cells],
    }


def _cell(frame: Frame, cell: Cell) -> dict[str, Any]:
    return {
        "text": cell.text,
        "value": cell.value,
        "low": cell.low,
        "high": cell.high,
        "scenes": cell.scenes,
        "status": cell.status,
        "mark": cell.mark,
        "reason": cell.reason,
        "identity": cell.identity,
        "footnotes": [frame.footnotes[letter] for letter in cell.footnotes],
    }


def _csv_value(value: Any) -> Any:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return " | ".join(value) if isinstance(value, list) else value
