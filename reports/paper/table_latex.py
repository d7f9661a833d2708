"""A paper's table in LaTeX: a document for pdflatex, of table environments to copy, with booktabs' rules."""

from __future__ import annotations

from ihbench.errors import visible
from ihbench.reports.general.latex import NEEDS, PREAMBLE, escape
from ihbench.reports.paper.paper_table import Block, Cell, Frame, Row

MARKS = {"best": r"\textbf{%s}", "second": r"\underline{%s}", "": "%s"}
PAIRED = "% ihbench lint: paired"  # tells the linter that marks come from paired differences
CHECK = {"✓": r"$\surd$", "": "", "?": "?"}


def fragment(frame: Frame) -> str:
    """The tabulars alone, one for each block, to be taken into somebody's document with \\input. What belongs below
    stands in comments."""
    lines = [NEEDS]
    for block in frame.blocks:
        lines += [f"% {' '.join(visible(block.title).split())}", *([PAIRED] if block.kind != "quoted" else [])]
        lines.append(_tabular(frame, block))
    lines += [rf"% \textsuperscript{{{letter}}} {escape(text)}" for letter, text in frame.footnotes.items()]
    return "\n".join(lines) + "\n"


def write(frame: Frame) -> str:
    """The whole document, one table environment for each block."""
    tables = [_block(frame, block, k) for k, block in enumerate(frame.blocks)]
    notes = [rf"\textsuperscript{{{letter}}} {escape(text)}" for letter, text in frame.footnotes.items()]
    notes += [escape(note) for note in (*frame.notes, f"Source of quoted numbers: {frame.source}.")]
    return "\n\n".join([PREAMBLE.rstrip(), *tables, _notes(notes), r"\end{document}"]) + "\n"


def _block(frame: Frame, block: Block, k: int) -> str:
    lines = [
        *([PAIRED] if block.kind != "quoted" else []),
        r"\begin{table}[!htbp]",
        r"\centering\footnotesize",
        rf"\caption{{{escape(f'{frame.title}. {block.title}')}.}}",
        rf"\label{{tab:{frame.name}-{k + 1}}}",
        rf"\par\smallskip\fitted{{{_tabular(frame, block)}}}",
        _notes([escape(note) for note in block.notes]),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _tabular(frame: Frame, block: Block) -> str:
    left = 2 + len(block.components)
    spec = "ll" + "c" * len(block.components) + "r" * len(block.columns)
    groups, rules, at = [], [], left + 1
    for group in block.groups:
        width = len(group.columns)
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(group.name)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    head = [frame.head, "status", *block.components, *(column.title for column in block.columns)]
    lines = [
        rf"\begin{{tabular}}{{{spec}}}",
        r"\toprule",
        " & " * left + " & ".join(groups) + r" \\",
        " ".join(rules),
        " & ".join(escape(word) for word in head) + r" \\",
        r"\midrule",
    ]
    section = block.rows[0].section if block.rows else ""
    for row in block.rows:
        if row.section != section:
            lines.append(r"\midrule")
            section = row.section
        lines.append(_row(row))
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines)


def _row(row: Row) -> str:
    label = rf"\emph{{{escape(row.name)}}}" if row.calibration else escape(row.name)
    label += rf"\textsuperscript{{{', '.join(row.footnotes)}}}" if row.footnotes else ""
    cells = [label, escape(row.status), *(CHECK[part] for part in row.components), *map(_cell, row.cells)]
    # after the \\ of the row above, a bracket or a star would be taken for its argument
    return ("{}" if label[:1] in "[*" else "") + " & ".join(cells) + r" \\"


def _cell(cell: Cell) -> str:
    text = MARKS[cell.mark] % escape(cell.number)
    if cell.interval:
        text += rf" {{\scriptsize {escape(cell.interval)}}}"
    said = [*(["unreliable"] if cell.status == "unreliable" else []), *cell.footnotes]
    return text + (rf"\textsuperscript{{{', '.join(said)}}}" if said else "")


def _notes(lines: list[str]) -> str:
    body = "\n".join(rf"\par {line}" for line in lines)
    return "\\par\\medskip\\begin{minipage}{\\linewidth}\\footnotesize\\raggedright\n" + body + "\n\\end{minipage}"
