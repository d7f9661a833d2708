"""A document in Markdown (GitHub's): best numbers bold, second-best ones underlined."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from ihbench.document.document import Block, Bullets, Cell, Heading, Paragraph, Picture, Span, Table, spans
from ihbench.errors import visible

STYLES = {
    "strong": "**{}**", "emphasis": "*{}*", "code": "`{}`", "raised": "<sup>{}</sup>", "underlined": "<u>{}</u>",
    "small": "{}",
}  # fmt: skip
PAIRED = "<!-- ihbench lint: paired -->"  # tells the linter that marks come from paired differences


def write(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """The text of some blocks, with a blank line between two."""
    return "\n\n".join(_block(block, folder) for block in blocks) + "\n"


def fragment(blocks: Sequence[Block]) -> str:
    """The tables alone, and the paragraphs that say what their letters mean."""
    kept = [_table(b) if isinstance(b, Table) else _block(b, Path()) for b in blocks if not isinstance(b, Heading)]
    return "\n\n".join(kept) + "\n"


def _block(block: Block, folder: Path) -> str:
    match block:
        case Heading(level, text):
            return f"{'#' * level} {plain(text)}"
        case Paragraph(words):
            return _line(words)
        case Bullets(items):
            return "\n".join(f"- {_line(item)}" for item in items)
        case Table():
            title = f"### {plain(block.title)}\n\n" if block.title else ""
            notes = "\n".join(f"- {_line(note)}" for note in block.notes)
            return title + _table(block) + (f"\n\n{notes}" if notes else "")
        case Picture(png, caption):
            where = Path(os.path.relpath(png, folder)).as_posix()
            return f"![{plain(caption).replace(']', '')}](<{quote(where, safe='/@+=,~')}>)\n\n{plain(caption)}"


def _table(table: Table) -> str:
    numbers = len(table.head) - table.left - table.ticks
    rule = "|" + "---|" * table.left + ":---:|" * table.ticks + "---:|" * numbers
    head, *rows = ("| " + " | ".join(map(_words, row)) + " |" for row in (table.head, *table.rows))
    return "\n".join([*([PAIRED] if table.paired else []), head, rule, *rows])


def _words(words: Cell) -> str:
    return "".join(plain(piece) if isinstance(piece, str) else _span(piece) for piece in spans(words))


def _span(span: Span) -> str:
    # a code span shows everything as it is but its own mark, and a cell's end
    return STYLES[span.style].format(_bare(span.text) if span.style == "code" else plain(span.text))


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


def _line(words: Cell) -> str:
    """Words that begin a line of their own."""
    text = _words(words)
    first = re.match(r"\s*(?:[#>+=\[-]|\d+[.)])", text)
    return text if first is None else OPENS.sub(r"\\", first[0], count=1) + text[first.end() :]


def _bare(text: str) -> str:
    return visible(" ".join(text.split())).replace("|", "\\|").replace("`", "'")
