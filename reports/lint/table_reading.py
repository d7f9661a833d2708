"""Tables as somebody wrote them, in LaTeX or Markdown, read back into heads, rows, numbers and marks."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ihbench.reports.lint.metric_names import NO_METRIC, HeadMetric, head_metric
from ihbench.scoring.calibration import ROWS

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


@dataclass(frozen=True, eq=False)
class Cell:
    """Equal to itself only."""

    text: str
    line: int
    shown: str = ""  # its number, if it has one
    value: float = math.nan
    decimals: int = 0
    significant: int = 0
    unit: str = ""
    low: float = math.nan  # of its interval
    high: float = math.nan
    mark: str = ""  # on its number: best, second
    label: str = ""  # of its row
    section: int = 0  # of its row, counted by full rules

    @property
    def ranked(self) -> bool:
        """Whether its row does more than bound the others."""
        first = self.label.partition(" / ")[0]  # what follows tells rows of one name apart
        return first not in ROWS and UNRANKED.match(self.label) is None


Row = Sequence[Cell]


@dataclass(frozen=True)
class Grid:
    """A table before anybody knows which of its rows are heads. Cells that span columns are repeated."""

    line: int
    rows: Sequence[Row]
    ruled: Sequence[bool]  # a full rule stands above the row
    paired: bool = False
    heads: int = 0  # rows that the syntax makes heads


@dataclass(frozen=True)
class Column:
    title: str  # such as "ZJU-MoCap SSIM ↑"
    line: int  # of the cell that names the metric
    metric: HeadMetric
    cells: Row


@dataclass(frozen=True)
class Table:
    columns: Sequence[Column]  # without those that name the rows
    paired: bool


def read_cell(styled: Styled, line: int) -> Cell:
    """A cell from its characters: its number, and the mark on that number."""
    written = "".join(character for character, _ in styled)
    match, text = CELL.fullmatch(written), " ".join(written.split())
    if match is None:
        return Cell(text, line)
    shown = match["value"].replace("−", "-")
    value, low, high, half = (_float(match[name]) for name in ("value", "low", "high", "half"))
    if match["half"]:
        low, high = value - abs(half), value + abs(half)
    mantissa = re.split("[eE]", shown.replace(",", ""))[0]
    decimals, significant = len(mantissa.partition(".")[2]), len(mantissa.lstrip("+-0.").replace(".", ""))
    unit, mark = match["unit"] or match["unit2"] or "", styled[match.start("value")][1]
    return Cell(text, line, shown, value, decimals, significant, unit, low, high, mark)


def _float(text: str | None) -> float:
    return float((text or "nan").replace(",", "").replace("−", "-").replace("∞", "inf"))


def tables_of(grid: Grid) -> list[Table]:
    """The tables in a grid: a row of metric names after rows of numbers begins another one."""
    tables: list[Table] = []
    heads: list[Row] = []
    body: list[tuple[int, Row]] = []  # with their sections
    first, section = grid.heads or _heads_above_rule(grid), 0
    for k, row in enumerate(grid.rows):
        section += grid.ruled[k]
        if k < first or _is_head(row):
            if body:
                tables.append(_table(grid, heads, body))
                heads, body = [], []
            heads.append(row)
        elif any(cell.text for cell in row):
            body.append((section, row))
    return [*tables, _table(grid, heads, body)] if body else tables


def _heads_above_rule(grid: Grid) -> int:
    """How many rows at the top are heads: those above the first full rule, if they look like it."""
    end = next((k for k, ruled in enumerate(grid.ruled) if k and ruled), 0)
    above = grid.rows[:end]
    return end if any(map(_is_head, above)) or not any(map(_has_numbers, above)) else 0


def _has_numbers(row: Row) -> bool:
    return any(cell.shown for cell in row[1:])


def _is_head(row: Row) -> bool:
    """Metric names beside the first column, and no numbers."""
    return not _has_numbers(row) and any(head_metric(cell.text) for cell in row[1:])


def _table(grid: Grid, heads: Sequence[Row], body: Sequence[tuple[int, Row]]) -> Table:
    width = max(map(len, grid.rows))
    columns = [_column(heads, k, grid.line) for k in range(width)]
    # how many columns at the left name a row: at least one, up to the first with a metric or a number
    numbers = {k for _, row in body for k, cell in enumerate(row) if cell.shown}
    labels = next((k for k in range(1, width) if columns[k].metric != NO_METRIC or k in numbers), 1)
    names = [row[0].text for _, row in body]
    if len({*names}) < len(body) or not all(names):  # where the first column does not tell rows apart, all that may
        joined = (" / ".join(dict.fromkeys(cell.text for cell in row[:labels] if cell.text)) for _, row in body)
        names = [name or f"row {k + 1}" for k, name in enumerate(joined)]
    rows = [
        [replace(cell, label=name, section=section) for cell in (*row, *[Cell("", 0)] * (width - len(row)))]
        for name, (section, row) in zip(names, body, strict=True)
    ]
    return Table([replace(columns[k], cells=[row[k] for row in rows]) for k in range(labels, width)], grid.paired)


def _column(heads: Sequence[Row], k: int, line: int) -> Column:
    """The column's head. A group's head may hold the arrow of all its columns."""
    parts = [row[k] for row in heads if k < len(row) and row[k].text]
    named = [(cell.line, metric) for cell in parts if (metric := head_metric(cell.text))]
    line, metric = named[-1] if named else (parts[-1].line if parts else line, NO_METRIC)
    arrow = metric.arrow or next((m.arrow for _, m in named if m.arrow), "")
    return Column(" ".join(dict.fromkeys(cell.text for cell in parts)), line, replace(metric, arrow=arrow), ())
