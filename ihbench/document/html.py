"""A document as one HTML file: pictures are inside, text is escaped, nothing is fetched and nothing runs."""

from __future__ import annotations

import html
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path

from ihbench.document.document import Block, Bullets, Cell, Column, Heading, Number, Paragraph, Picture, Table, spans
from ihbench.errors import visible

STYLES = {
    "strong": "<strong>{}</strong>", "emphasis": "<em>{}</em>", "code": "<code>{}</code>", "raised": "<sup>{}</sup>",
    "underlined": "<u>{}</u>", "small": '<span class="interval">{}</span>',
}  # fmt: skip
# even if something slipped through the escaping, a browser that obeys this neither runs it nor loads anything
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; form-action 'none'; base-uri 'none'"
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 2rem auto; max-width: 74rem;
  padding: 0 1rem; }
h1, h2 { border-bottom: 1px solid #ccc; padding-bottom: .2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; margin: .6rem 0 1rem; border-top: 2px solid; border-bottom: 2px solid; }
th, td { padding: .2rem .7rem; text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
th { border-bottom: 1px solid; }
.left { text-align: left; white-space: normal; }
td.left:first-child { min-width: 11rem; }
code { background: #f3f3f3; padding: 0 .2em; }
img { max-width: 100%; height: auto; }
figure { margin: 1.5rem 0; } figcaption { color: #444; }
section { margin: 2rem 0; padding: .2rem 1rem; border-left: 5px solid #888; }
section.quoted, section.quoted-elsewhere { border-color: #777; } section.real-data { border-color: #1b7837; }
section.stand-in { border-color: #b35806; background: #fff7ec; }
th.group { text-align: center; } tr.section td { border-top: 1px solid #bbb; }
tr.bound { color: #666; } td.absent { color: #888; } td.unreliable { color: #a00; }
.interval { color: #555; font-size: 85%; } sup { font-size: 70%; line-height: 0; }
"""


def write(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """A whole page of some blocks; it needs nothing beside it."""
    title = next((b.text for b in blocks if isinstance(b, Heading) and b.level == 1), "ihbench report")
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *(_block(block) for block in blocks if not isinstance(block, Heading) or block.level > 1),
            "</body></html>\n",
        ]
    )


def fragment(blocks: Sequence[Block]) -> str:
    """The tables alone, and the paragraphs that say what their letters mean, without a page around them."""
    kept = [_table(b) if isinstance(b, Table) else _block(b) for b in blocks if not isinstance(b, Heading)]
    return "\n".join(kept) + "\n"


def escape(text: str) -> str:
    """Text that a browser shows as it is, in an attribute too."""
    return html.escape(visible(text))


def _block(block: Block) -> str:
    match block:
        case Heading(level, text):
            return f"<h{level}>{escape(text)}</h{level}>"
        case Paragraph(words):
            return f"<p>{_words(words)}</p>"
        case Bullets(items):
            return "<ul>" + "".join(f"<li>{_words(item)}</li>" for item in items) + "</ul>"
        case Table(title=""):
            return _table(block)
        case Table():
            notes = "".join(f"<li>{escape(note)}</li>" for note in block.notes)
            opened = f'<section class="{block.kind.replace(" ", "-")}"><h2>{escape(block.title)}</h2>'
            return f"{opened}\n{_table(block)}\n<ul>{notes}</ul></section>"
        case Picture(png, caption):
            data = b64encode(png.read_bytes()).decode("ascii")
            image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
            return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"


def _table(table: Table) -> str:
    words = table.left + table.ticks
    groups = "".join(f'<th class="group" colspan="{n}">{escape(name)}</th>' for name, n in table.groups.items())
    head = f'<tr><th colspan="{words}"></th>{groups}</tr>' if groups else ""
    titles = [cell.title if isinstance(cell, Column) else cell for cell in table.head]
    head += f"<tr>{''.join(_cell(cell, k < words, 'th') for k, cell in enumerate(titles))}</tr>"
    rows = []
    for k, row in enumerate(table.rows):
        kinds = ["section"] * table.begins_section(k) + ["bound"] * (bool(table.labels) and table.labels[k].bound)
        opened = f'<tr class="{" ".join(kinds)}">' if kinds else "<tr>"
        rows.append(f"{opened}{''.join(_cell(cell, k < words) for k, cell in enumerate(row))}</tr>")
    return f'<div class="wide"><table><thead>{head}</thead><tbody>{"".join(rows)}</tbody></table></div>'


def _cell(cell: Cell, left: bool, tag: str = "td") -> str:
    about = ' class="left"' if left else ""
    if isinstance(cell, Number):
        why = f"{cell.status}: {cell.reason}" if cell.reason else f"{cell.status} {cell.identity}".rstrip()
        about = f' class="{cell.status}" title="{escape(why)}"'
    return f"<{tag}{about}>{_words(cell)}</{tag}>"


def _words(words: Cell) -> str:
    return "".join(
        escape(piece) if isinstance(piece, str) else STYLES[piece.style].format(escape(piece.text))
        for piece in spans(words)
    )
