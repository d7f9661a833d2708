"""A paper's table as one HTML file: text is escaped, nothing is fetched and nothing runs."""

from __future__ import annotations

from ihbench.reports.general.html import POLICY, STYLE, escape
from ihbench.reports.paper.paper_table import Block, Cell, Frame, Row

MARKS = {"best": "<strong>{}</strong>", "second": "<u>{}</u>", "": "{}"}
OWN_STYLE = """
section { margin: 2rem 0; padding: .2rem 1rem; border-left: 5px solid #888; }
section.quoted { border-color: #777; } section.real-data { border-color: #1b7837; }
section.stand-in { border-color: #b35806; background: #fff7ec; }
th.group { text-align: center; } tr.section td { border-top: 1px solid #bbb; }
tr.calibration { color: #666; } td.absent { color: #888; } td.unreliable { color: #a00; }
.interval { color: #555; font-size: 85%; } sup { font-size: 70%; line-height: 0; }
"""


def write(frame: Frame) -> str:
    """The whole page, one section for each block."""
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{escape(frame.title)}</title><style>{STYLE}{OWN_STYLE}</style></head><body>",
            f"<h1>{escape(frame.title)}</h1>",
            f"<p>Source of quoted numbers: {escape(frame.source)}.</p>",
            *(_block(frame, block) for block in frame.blocks),
            *_footnotes(frame),
            "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in frame.notes) + "</ul>",
            "</body></html>\n",
        ]
    )


def fragment(frame: Frame) -> str:
    """The tables alone, one for each block, and what their letters mean, without a page around them."""
    return "\n".join([*(_table(frame, block) for block in frame.blocks), *_footnotes(frame)]) + "\n"


def _footnotes(frame: Frame) -> list[str]:
    return [f"<p><sup>{letter}</sup> {escape(text)}</p>" for letter, text in frame.footnotes.items()]


def _block(frame: Frame, block: Block) -> str:
    return "\n".join(
        [
            f'<section class="{block.kind.replace(" ", "-")}"><h2>{escape(block.title)}</h2>',
            f'<div class="wide">{_table(frame, block)}</div>',
            "<ul>" + "".join(f"<li>{escape(note)}</li>" for note in block.notes) + "</ul></section>",
        ]
    )


def _table(frame: Frame, block: Block) -> str:
    words = [frame.head, "status", *block.components]
    above = "".join(f'<th class="group" colspan="{len(g.columns)}">{escape(g.name)}</th>' for g in block.groups)
    below = "".join(f'<th class="left">{escape(word)}</th>' for word in words)
    below += "".join(f"<th>{escape(column.title)}</th>" for column in block.columns)
    rows, section = [], block.rows[0].section if block.rows else ""
    for row in block.rows:
        rows.append(_row(row, begins=row.section != section))
        section = row.section
    return "\n".join(
        [
            "<table><thead>",
            f'<tr><th colspan="{len(words)}"></th>{above}</tr><tr>{below}</tr></thead>',
            "<tbody>",
            *rows,
            "</tbody></table>",
        ]
    )


def _row(row: Row, begins: bool) -> str:
    kinds = [name for name, holds in (("section", begins), ("calibration", row.calibration)) if holds]
    label = f"<em>{escape(row.name)}</em>" if row.calibration else escape(row.name)
    label += f"<sup>{', '.join(row.footnotes)}</sup>" if row.footnotes else ""
    cells = "".join(f'<td class="left">{word}</td>' for word in (label, escape(row.status), *row.components))
    opening = f'<tr class="{" ".join(kinds)}">' if kinds else "<tr>"
    return opening + cells + "".join(_cell(cell) for cell in row.cells) + "</tr>"


def _cell(cell: Cell) -> str:
    text = MARKS[cell.mark].format(escape(cell.number))
    if cell.interval:
        text += f' <span class="interval">{escape(cell.interval)}</span>'
    said = [*(["unreliable"] if cell.status == "unreliable" else []), *cell.footnotes]
    text += f"<sup>{', '.join(said)}</sup>" if said else ""
    told = f"{cell.status}: {cell.reason}" if cell.reason else f"{cell.status} {cell.identity}".rstrip()
    return f'<td class="{cell.status}" title="{escape(told)}">{text}</td>'
