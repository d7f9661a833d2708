"""A document as text for a terminal: aligned columns, each as wide as it needs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path

from ihbench.document.document import Block, Bullets, Cell, Heading, Paragraph, Picture, Table, spans
from ihbench.errors import visible

STYLES = {"strong": "bold", "emphasis": "italic", "underlined": "underline", "small": "dim"}
GAP = 2  # columns between two columns of a table
INDENT = "  "


def write(blocks: Sequence[Block], folder: Path = Path("."), styled: bool = False) -> str:
    """The lines of some blocks: a blank one before headings and after tables. `styled` for a terminal that shows bold
    and underlined text."""
    from rich.console import Console
    from rich.text import Text

    out = StringIO()
    console = Console(
        file=out, force_terminal=styled, color_system="standard" if styled else None, highlight=False, width=1 << 15
    )
    before: Block | None = None
    for block in blocks:
        begins = isinstance(block, Heading) or (isinstance(block, Table) and bool(block.title))
        if before is not None and (begins or isinstance(before, Table)):
            console.print()
        for line in _lines(block, before):
            text = Text()
            for words, style in line:
                text.append(visible(words), style)
            text.rstrip()
            console.print(text)
        before = block
    return out.getvalue()


Line = list[tuple[str, str]]  # words and their styles


def _lines(block: Block, before: Block | None) -> Iterator[Line]:
    match block:
        case Heading(_, text):
            yield [(text, "bold")]
        case Paragraph(words):
            yield _styled(words)
        case Bullets(items):
            yield from ([(INDENT, ""), *_styled(item)] for item in items)
        case Table():
            yield from ([[(block.title, "bold")]] if block.title else [])
            indent = INDENT * (block.bare and isinstance(before, Heading))
            yield from ([(indent, ""), *line] for line in _table(block))
            yield from ([(INDENT, ""), (note, "")] for note in block.notes)
        case Picture(png, caption):
            yield [(f"{caption}: {png}", "")]


def _table(table: Table) -> Iterator[Line]:
    from rich.cells import cell_len

    rows = [[_styled(cell) for cell in row] for row in table.rows]
    if not table.bare:
        rows.insert(0, [[(words, "bold") for words, _ in _styled(cell)] for cell in table.head])
    sizes = [[cell_len("".join(visible(words) for words, _ in cell)) for cell in row] for row in rows]
    widths = [max(column) for column in zip(*sizes, strict=True)]
    for k, (row, own) in enumerate(zip(rows, sizes, strict=True)):
        line: Line = []
        for column, (cell, size, width) in enumerate(zip(row, own, widths, strict=True)):
            padding = (" " * (width - size), "")
            line += [*cell, padding] if column < table.left else [padding, *cell]
            line.append((" " * GAP, ""))
        if not table.bare and k > 0 and table.begins_section(k - 1):
            yield []
        yield line
        if not table.bare and k == 0 and table.left < len(table.head):
            yield [("─" * (sum(widths) + GAP * (len(widths) - 1)), "")]


def _styled(words: Cell) -> Line:
    return [
        (p, "") if isinstance(p, str) else (f"({p.text})" if p.style == "raised" else p.text, STYLES.get(p.style, ""))
        for p in spans(words)
    ]
