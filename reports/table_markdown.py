"""A paper's table in Markdown (GitHub's): best numbers bold, second-best ones underlined."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ihbench.reports.markdown import plain
from ihbench.reports.paper_table import Block, Cell, Frame, Row

MARKS = {"best": "**{}**", "second": "<u>{}</u>", "": "{}"}
PAIRED = "<!-- ihbench lint: paired -->"  # tells the linter that marks come from paired differences


def write(frame: Frame) -> str:
    """The whole text, one table for each block."""
    lines = [f"## {_text(frame.title)}", "", f"Source of quoted numbers: {_text(frame.source)}.", ""]
    for block in frame.blocks:
        lines += [*_block(frame, block), ""]
    lines += [f"<sup>{letter}</sup> {_text(text)}  " for letter, text in frame.footnotes.items()]
    lines += ["", *(f"- {_text(note)}" for note in frame.notes)]
    return "\n".join(lines).rstrip() + "\n"


def _block(frame: Frame, block: Block) -> list[str]:
    columns = [f"{column.group} {column.title}" for column in block.columns]
    head = [frame.head, "status", *block.components, *columns]
    rule = "---|" * 2 + ":---:|" * len(block.components) + "---:|" * len(columns)
    lines = [f"### {_text(block.title)}", "", *([PAIRED] if block.kind != "quoted" else [])]
    lines += [_line([_text(word) for word in head]), f"|{rule}"]
    lines += [_line(_row(row)) for row in block.rows]
    return [*lines, "", *(f"- {_text(note)}" for note in block.notes)]


def _row(row: Row) -> list[str]:
    label = f"*{_text(row.label)}*" if row.calibration else _text(row.label)
    return [label, row.status, *row.components, *(_cell(row, cell) for cell in row.cells)]


def _cell(row: Row, cell: Cell) -> str:
    text = MARKS[cell.mark].format(cell.number) + (f" {cell.interval}" if cell.interval else "")
    said = [*(["unreliable"] if cell.status == "unreliable" else []), *cell.footnotes]
    return text + (f"<sup>{', '.join(said)}</sup>" if said else "")


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _text(text: str) -> str:
    """Words that Markdown shows as they are."""
    return re.sub(r"([*`$\[\]]|(?<![A-Za-z0-9])_|_(?![A-Za-z0-9]))", r"\\\1", plain(text.replace("\\", "\\\\")))
