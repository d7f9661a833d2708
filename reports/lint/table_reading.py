"""Tables as somebody wrote them, in LaTeX or Markdown, read back into heads, rows, numbers and marks."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from ihbench.reports.lint.metric_names import HeadMetric, head_metric

NUM = r"[-+−]?(?:\d{1,3}(?:,\d{3})+(?:\.\d+)?|\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
UNITS = r"%|dB|ms|sec|s|mins?|hours?|hrs?|h|[GM]i?B|FPS|fps|[kKMBG]|×|x|mm|cm|m"
CELL = re.compile(
    rf"""\s*[~≈<>≤≥]?\s*(?P<value>{NUM}|∞)\s*(?P<unit>{UNITS})?\s*
    (?:±\s*(?P<half>{NUM})\s*
      |\[\s*(?P<low>{NUM})\s*[,;]\s*(?P<high>{NUM})\s*\]
    )?
    \s*(?P<unit2>{UNITS})?\s*(?:\([-+−↑↓][^)]*\))?\s*[†‡§¶*∗⋆]*\s*""",
    re.VERBOSE,
)  # fmt: skip
UNRANKED = re.compile(r"(gt|ground[- ]?truth|oracle|upper[- ]?bound)\b", re.IGNORECASE)
PAIRED = "ihbench lint: paired"  # a comment before a table: its marks come from paired differences

Styled = list[tuple[str, str]]  # characters with the mark that they carry: "best", "second" or ""


@dataclass(frozen=True)
class Number:
    """The number in a cell."""

    shown: str
    value: float
    decimals: int
    significant: int
    unit: str = ""
    low: float = math.nan  # of its interval
    high: float = math.nan

    @property
    def has_interval(self) -> bool:
        return math.isfinite(self.low) and math.isfinite(self.high)


@dataclass(frozen=True)
class ReadCell:
    text: str
    line: int
    number: Number | None = None
    mark: str = ""  # best, second


@dataclass(frozen=True)
class GridRow:
    cells: tuple[ReadCell, ...]
    line: int
    ruled: bool = False  # a full rule stands above it


@dataclass(frozen=True)
class Grid:
    """A table before anybody knows which of its rows are heads. Cells that span columns are repeated."""

    line: int
    rows: tuple[GridRow, ...]
    paired: bool = False
    heads: int = 0  # rows that the syntax makes heads


@dataclass(frozen=True)
class Head:
    """A column's head."""

    cell: ReadCell  # the one that names the metric
    title: str  # such as "ZJU-MoCap SSIM ↑"
    metric: HeadMetric | None


@dataclass(frozen=True)
class ReadRow:
    label: str
    cells: tuple[ReadCell, ...]
    line: int
    section: int = 0  # counted by full rules

    @property
    def ranked(self) -> bool:
        from ihbench.scoring.calibration import ROWS

        first = self.label.partition(" / ")[0]  # what follows tells rows of one name apart
        return first not in ROWS and UNRANKED.match(self.label) is None


@dataclass(frozen=True)
class ReadTable:
    line: int
    heads: tuple[Head, ...]
    rows: tuple[ReadRow, ...]
    paired: bool = False


@dataclass
class Reading:
    tables: list[ReadTable] = field(default_factory=list)
    notes: list[tuple[int, str]] = field(default_factory=list)  # line, what was not understood


# -------------------------------------------------------------------------------------------------------- cells


def read_cell(styled: Styled, line: int) -> ReadCell:
    """A cell from its characters: its number, and the mark on that number."""
    written = "".join(character for character, _ in styled)
    match, text = CELL.fullmatch(written), " ".join(written.split())
    if match is None:
        return ReadCell(text, line)
    return ReadCell(text, line, _number(match), styled[match.start("value")][1])


def _number(match: re.Match[str]) -> Number:
    shown = match["value"].replace("−", "-")
    plain = shown.replace(",", "")
    value = math.inf if plain == "∞" else float(plain)
    mantissa = re.split("[eE]", plain)[0]
    decimals = len(mantissa.partition(".")[2])
    significant = len(mantissa.lstrip("+-0.").replace(".", ""))
    unit = match["unit"] or match["unit2"] or ""
    low = high = math.nan
    if match["half"] is not None:
        half = abs(_float(match["half"]))
        low, high = value - half, value + half
    elif match["low"] is not None:
        low, high = _float(match["low"]), _float(match["high"])
    return Number(shown, value, decimals, significant, unit, low, high)


def _float(text: str) -> float:
    return float(text.replace(",", "").replace("−", "-"))


# ------------------------------------------------------------------------------------------- from grids to tables


def tables_of(grid: Grid) -> list[ReadTable]:
    """The tables in a grid: a row of metric names after rows of numbers begins another one."""
    rows = grid.rows
    width = max((len(row.cells) for row in rows), default=0)
    tables: list[ReadTable] = []
    heads: list[GridRow] = []
    body: list[tuple[GridRow, int]] = []
    first, section = _leading_heads(rows, grid.heads), 0
    for k, row in enumerate(rows):
        section += row.ruled
        if k < first or (_is_head(row) and (body or not _has_numbers(row))):
            if body:
                tables += _table(grid, heads, body, width)
                heads, body = [], []
            heads.append(row)
        elif any(cell.text for cell in row.cells):
            body.append((row, section))
    return [*tables, *_table(grid, heads, body, width)]


def _leading_heads(rows: Sequence[GridRow], given: int) -> int:
    """How many rows at the top are heads: those above the first full rule, if they look like it."""
    if given:
        return given
    end = next((k for k, row in enumerate(rows) if k and row.ruled), 0)
    above = rows[:end]
    if any(_is_head(row) for row in above) or not any(_has_numbers(row) for row in above):
        return end
    return 0


def _has_numbers(row: GridRow) -> bool:
    return any(cell.number for cell in row.cells[1:])


def _is_head(row: GridRow) -> bool:
    """Metric names beside the first column, and no numbers."""
    return not _has_numbers(row) and any(head_metric(cell.text) for cell in row.cells[1:])


def _table(grid: Grid, heads: list[GridRow], body: list[tuple[GridRow, int]], width: int) -> list[ReadTable]:
    if not body:
        return []
    columns = [_head(heads, k, grid.line) for k in range(width)]
    # how many columns at the left name a row: at least one, up to the first with a metric or a number
    numbers = {k for row, _ in body for k, cell in enumerate(row.cells) if cell.number}
    labels = next((k for k in range(1, width) if columns[k].metric or k in numbers), 1)
    rows = []
    for name, (row, section) in zip(_names([row for row, _ in body], labels), body, strict=True):
        cells = [*row.cells, *[ReadCell("", row.line)] * (width - len(row.cells))]
        rows.append(ReadRow(name, tuple(cells[labels:]), row.line, section))
    return [ReadTable(grid.line, tuple(columns[labels:]), tuple(rows), grid.paired)]


def _names(rows: Sequence[GridRow], labels: int) -> list[str]:
    """What rows are called: by the first column, if that tells them apart, else by all columns before the numbers."""
    first = [row.cells[0].text for row in rows]
    if len({*first}) == len(rows) and all(first):
        return first
    joined = [" / ".join(dict.fromkeys(c.text for c in row.cells[:labels] if c.text)) for row in rows]
    return [name or f"row {k + 1}" for k, name in enumerate(joined)]


def _head(heads: Sequence[GridRow], k: int, line: int) -> Head:
    parts = [row.cells[k] for row in heads if k < len(row.cells) and row.cells[k].text]
    title = " ".join(dict.fromkeys(cell.text for cell in parts))
    for cell in reversed(parts):
        metric = head_metric(cell.text)
        if metric is not None:
            # a group's head may hold the arrow of all its columns
            arrow = metric.arrow or next((m.arrow for c in parts if (m := head_metric(c.text)) and m.arrow), "")
            return Head(cell, title, replace(metric, arrow=arrow))
    return Head(parts[-1] if parts else ReadCell("", line), title, None)
