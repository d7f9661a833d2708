"""The general report as one HTML file: pictures are inside, text is escaped, nothing is fetched and nothing runs."""

from __future__ import annotations

import html
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from ihbench.document.document import Block, Bullets, Heading, Paragraph, Picture, Table, Words, spans
from ihbench.errors import visible
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult
from ihbench.reports.general.content import general_report, score_tables
from ihbench.reports.general.figures import draw
from ihbench.reports.general.run_pictures import run_pictures
from ihbench.reports.general.short_names import LONG, with_short_names

TAGS = {"strong": "strong", "emphasis": "em", "code": "code", "raised": "sup"}
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
"""


def write(
    results: Sequence[RunResult],
    presets: Sequence[str] = (),
    *,
    targets: Sequence[Target] = (),
    pictures: Sequence[tuple[Path, str]] = (),  # file, caption
    folder: Path = Path("."),  # where the text will lie; this report needs nothing beside it
    left_out: Sequence[str] = (),  # folders, with the reasons
    fragment: bool = False,  # the tables of scores alone, without a document around them
) -> str:
    """The report of these runs; see `general_report`. The runs' own pictures are in it, and diagrams: the ones given,
    else its own."""
    if fragment:
        return fragments(results, presets)
    own = run_pictures(results)
    if pictures:
        return page(with_short_names(general_report(results, presets, targets, [*pictures, *own], left_out), LONG))
    with TemporaryDirectory() as name:
        drawn = [*draw(results, Path(name)), *own]
        return page(with_short_names(general_report(results, presets, targets, drawn, left_out), LONG))


def fragments(results: Sequence[RunResult], presets: Sequence[str] = ()) -> str:
    """The tables of scores alone, without a page around them."""
    tables = with_short_names([table for _, table in score_tables(results, presets)], LONG)
    return "\n".join(map(_block, tables)) + "\n"


def page(blocks: Sequence[Block], title: str = "ihbench report") -> str:
    """A whole document of some blocks."""
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
            f"<h1>{escape(title)}</h1>",
            *(_block(block) for block in blocks),
            "</body></html>\n",
        ]
    )


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
        case Table():
            return _table(block)
        case Picture(png, caption):
            data = b64encode(png.read_bytes()).decode("ascii")
            image = f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
            return f"<figure>{image}<figcaption>{escape(caption)}</figcaption></figure>"
    raise TypeError(f"report: expected a block of document.py, got {type(block).__name__}")


def _table(table: Table) -> str:
    def row(cells: Sequence[Words], tag: str) -> str:
        opened = [f'<{tag} class="left">' if k < table.left else f"<{tag}>" for k in range(len(cells))]
        shown = (f"{begin}{_words(cell)}</{tag}>" for begin, cell in zip(opened, cells, strict=True))
        return f"<tr>{''.join(shown)}</tr>"

    body = "".join(row(cells, "td") for cells in table.rows)
    return f'<div class="wide"><table><thead>{row(table.head, "th")}</thead><tbody>{body}</tbody></table></div>'


def _words(words: Words) -> str:
    return "".join(
        escape(piece)
        if isinstance(piece, str)
        else f"<{TAGS[piece.style]}>{escape(piece.text)}</{TAGS[piece.style]}>"
        for piece in spans(words)
    )
