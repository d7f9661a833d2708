"""The general report in Markdown; it also goes to a terminal."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from ihbench.document.document import Block, Bullets, Heading, Paragraph, Picture, Table, Words, spans
from ihbench.errors import visible
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult
from ihbench.reports.general.content import general_report, score_tables
from ihbench.reports.general.short_names import LONG, with_short_names

MARKS = {"strong": "**", "emphasis": "*", "code": "`"}


def write(
    results: Sequence[RunResult],
    presets: Sequence[str] = (),
    *,
    targets: Sequence[Target] = (),
    pictures: Sequence[tuple[Path, str]] = (),  # file, caption
    folder: Path = Path("."),  # where the text will lie
    left_out: Sequence[str] = (),  # folders, with the reasons
    fragment: bool = False,  # the tables of scores alone, without a document around them
) -> str:
    """The report of these runs; see `general_report`."""
    if fragment:
        return fragments(results, presets)
    return markdown(with_short_names(general_report(results, presets, targets, pictures, left_out), LONG), folder)


def fragments(results: Sequence[RunResult], presets: Sequence[str] = ()) -> str:
    """The tables of scores alone."""
    return markdown(with_short_names([table for _, table in score_tables(results, presets)], LONG))


def markdown(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """The text of some blocks, with a blank line between two."""
    return "\n\n".join(_block(block, folder) for block in blocks) + "\n"


def _block(block: Block, folder: Path) -> str:
    match block:
        case Heading(level, text):
            return f"{'#' * level} {plain(text)}"
        case Paragraph(words):
            return _line(words)
        case Bullets(items):
            return "\n".join(f"- {_line(item)}" for item in items)
        case Table():
            rule = "---|" * block.left + "---:|" * (len(block.head) - block.left)
            rows = ["| " + " | ".join(_words(cell) for cell in row) + " |" for row in (block.head, *block.rows)]
            return "\n".join([rows[0], f"|{rule}", *rows[1:]])
        case Picture(png, caption):
            where = Path(os.path.relpath(png, folder)).as_posix()
            return f"![{plain(caption).replace(']', '')}](<{quote(where, safe='/@+=,~')}>)\n\n{plain(caption)}"
    raise TypeError(f"report: expected a block of document.py, got {type(block).__name__}")


def _words(words: Words) -> str:
    # a code span shows everything as it is but its own mark, and a cell's end
    return "".join(
        plain(piece)
        if isinstance(piece, str)
        else f"<sup>{plain(piece.text)}</sup>"
        if piece.style == "raised"
        else f"{MARKS[piece.style]}{_bare(piece.text) if piece.style == 'code' else plain(piece.text)}"
        f"{MARKS[piece.style]}"
        for piece in spans(words)
    )


# what GitHub's Markdown would take for an entity, emphasis, mathematics, code, a link, an address or a mention
LIVE = re.compile(
    r"""&(?=\#?\w+;) | [\\*~$`] | (?<![^\W_])_ | _(?![^\W_]) | \](?=[(\[]) | !(?=\[)
    | (?<=:)/(?=/) | (?<=[wW]{3})\. | (?<=[\w.+-])@(?=[\w-]+\.) | [<|]""",
    re.VERBOSE,
)
OTHERWISE = {"&": "&amp;", "@": "<!-- -->@", "<": "&lt;"}  # where a backslash does not help, or shows
OPENS = re.compile(r"(?=[#>+=\[-])|(?<=\d)(?=[.)])")


def plain(text: str) -> str:
    """Text that a reader sees as it is: it ends neither a table's cell nor a line, and makes no link, picture, style
    or HTML. Spaces at its ends stay."""
    inner = LIVE.sub(lambda found: OTHERWISE.get(found[0], "\\" + found[0]), visible(" ".join(text.split())))
    before, after = (" " if text[:1].isspace() else ""), (" " if text[-1:].isspace() else "")
    return before + inner + after if inner else before


def _line(words: Words) -> str:
    """Words that begin a line of their own."""
    text = _words(words)
    first = re.match(r"\s*(?:[#>+=\[-]|\d+[.)])", text)
    return text if first is None else OPENS.sub(r"\\", first[0], count=1) + text[first.end() :]


def _bare(text: str) -> str:
    return visible(" ".join(text.split())).replace("|", "\\|").replace("`", "'")
