"""The general report in Markdown; it also goes to a terminal."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ihbench.quality_time import Target
from ihbench.reports.content import general_report
from ihbench.reports.document import Block, Bullets, Heading, Paragraph, Picture, Table, Words, spans
from ihbench.results import RunResult

MARKS = {"strong": "**", "emphasis": "*", "code": "`"}


def write(
    results: Sequence[RunResult],
    presets: Sequence[str] = (),
    *,
    targets: Sequence[Target] = (),
    pictures: Sequence[tuple[Path, str]] = (),  # file, caption
    folder: Path = Path("."),  # where the text will lie
) -> str:
    """The report of these runs; see `general_report`."""
    return markdown(general_report(results, presets, targets, pictures), folder)


def markdown(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """The text of some blocks, with a blank line between two."""
    return "\n\n".join(_block(block, folder) for block in blocks) + "\n"


def _block(block: Block, folder: Path) -> str:
    match block:
        case Heading(level, text):
            return f"{'#' * level} {plain(text)}"
        case Paragraph(words):
            return _words(words)
        case Bullets(items):
            return "\n".join(f"- {_words(item)}" for item in items)
        case Table():
            rule = "---|" * block.left + "---:|" * (len(block.head) - block.left)
            rows = ["| " + " | ".join(_words(cell) for cell in row) + " |" for row in (block.head, *block.rows)]
            return "\n".join([rows[0], f"|{rule}", *rows[1:]])
        case Picture(png, caption):
            where = Path(os.path.relpath(png, folder)).as_posix()
            return f"![{plain(caption).replace(']', '')}](<{where}>)\n\n{plain(caption)}"
    raise TypeError(f"report: expected a block of document.py, got {type(block).__name__}")


def _words(words: Words) -> str:
    # a code span shows everything as it is but its own mark, and a cell's end
    return "".join(
        plain(piece)
        if isinstance(piece, str)
        else f"{MARKS[piece.style]}{_bare(piece.text) if piece.style == 'code' else plain(piece.text)}"
        f"{MARKS[piece.style]}"
        for piece in spans(words)
    )


def plain(text: str) -> str:
    """Text that neither ends a table's cell or line nor is taken for HTML. Spaces at its ends stay."""
    inner = " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")
    before, after = (" " if text[:1].isspace() else ""), (" " if text[-1:].isspace() else "")
    return before + inner + after if inner else before


def _bare(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|").replace("`", "'")
