"""A paper's table in Markdown (GitHub's): best numbers bold, second-best ones underlined."""

from __future__ import annotations

from collections.abc import Sequence

from ihbench.reports.general.markdown import plain
from ihbench.reports.paper.paper_table import Block, Cell, Frame, Row

MARKS = {"best": "**{}**", "second": "<u>{}</u>", "": "{}"}
PAIRED = "<!-- ihbench lint: paired -->"  # tells the linter that marks come from paired differences


def write(frame: Frame) -> str:
    """The whole text, one table for each block."""
    lines = [f"## {plain(frame.title)}", "", f"Source of quoted numbers: {plain(frame.source)}.", ""]
    for block in frame.blocks:
        lines += [*_block(frame, block), ""]
    lines += _footnotes(frame)
    lines += ["", *(f"- {plain(note)}" for note in frame.notes)]
    return "\n".join(lines).rstrip() + "\n"


def _footnotes(frame: Frame) -> list[str]:
    return [f"<sup>{letter}</sup> {plain(text)}  " for letter, text in frame.footnotes.items()]


def fragment(frame: Frame) -> str:
    """The tables alone, one for each block, and what their letters mean."""
    tables = ["\n".join(_table(frame, block)) for block in frame.blocks]
    return "\n\n".join([*tables, *(["\n".join(_footnotes(frame))] if frame.footnotes else [])]) + "\n"


def _block(frame: Frame, block: Block) -> list[str]:
    lines = [f"### {plain(block.title)}", "", *_table(frame, block)]
    return [*lines, "", *(f"- {plain(note)}" for note in block.notes)]


def _table(frame: Frame, block: Block) -> list[str]:
    columns = [f"{column.group} {column.title}" for column in block.columns]
    head = [frame.head, "status", *block.components, *columns]
    rule = "---|" * 2 + ":---:|" * len(block.components) + "---:|" * len(columns)
    lines = [*([PAIRED] if block.kind != "quoted" else []), _line([plain(word) for word in head]), f"|{rule}"]
    return [*lines, *(_line(_row(row)) for row in block.rows)]


def _row(row: Row) -> list[str]:
    label = f"*{plain(row.name)}*" if row.calibration else plain(row.name)
    label += f"<sup>{', '.join(row.footnotes)}</sup>" if row.footnotes else ""
    return [label, row.status, *row.components, *(_cell(row, cell) for cell in row.cells)]


def _cell(row: Row, cell: Cell) -> str:
    text = MARKS[cell.mark].format(cell.number) + (f" {cell.interval}" if cell.interval else "")
    said = [*(["unreliable"] if cell.status == "unreliable" else []), *cell.footnotes]
    return text + (f"<sup>{', '.join(said)}</sup>" if said else "")


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
