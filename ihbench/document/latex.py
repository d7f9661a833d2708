"""A document in LaTeX, which pdflatex compiles, tables with booktabs' rules."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ihbench.document.document import Block, Bullets, Cell, Column, Heading, Paragraph, Picture, Table, spans
from ihbench.errors import visible

PREAMBLE = r"""\documentclass[10pt]{article}
\usepackage[T1]{fontenc}
\usepackage[utf8]{inputenc}
\usepackage[a4paper,margin=18mm]{geometry}
\usepackage{booktabs,graphicx,textcomp}
\setlength{\parindent}{0pt}\setlength{\parskip}{4pt}
% a table that is wider than the page is made as wide as the page
\newcommand{\fitted}[1]{\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{#1}}
\begin{document}
"""
SPECIAL = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", '"': r"\textquotedbl{}", "`": r"\textasciigrave{}", "'": "'",
    "–": "--", "—": "---", "…": r"\ldots{}", "·": r"\textperiodcentered{}", "●": r"$\bullet$", "○": r"$\circ$",
    "↑": r"$\uparrow$", "↓": r"$\downarrow$", "→": r"$\rightarrow$", "×": r"$\times$", "±": r"$\pm$",
    "−": r"$-$", "∞": r"$\infty$", "≤": r"$\leq$", "≥": r"$\geq$", "≈": r"$\approx$", "°": r"\textdegree{}",
    "²": r"\textsuperscript{2}", "³": r"\textsuperscript{3}", "µ": r"\textmu{}", "Δ": r"$\Delta$", "β": r"$\beta$",
    "✓": r"$\surd$", "†": r"\textdagger{}", "‡": r"\textdaggerdbl{}", "§": r"\S{}",
}  # fmt: skip
NEEDS = r"% a fragment for \input: needs \usepackage{booktabs}, \usepackage{textcomp} and, in pdflatex, T1 fonts"
STYLES = {
    "strong": r"\textbf{%s}", "emphasis": r"\emph{%s}", "code": r"\texttt{%s}", "raised": r"\textsuperscript{%s}",
    "underlined": r"\underline{%s}", "small": r"{\scriptsize %s}",
}  # fmt: skip
LATIN = 0x17F  # the last letter that T1 fonts have
PAIRED = "% ihbench lint: paired"  # tells the linter that marks come from paired differences


def write(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """A whole document of some blocks; a table with a title is a table environment with its notes."""
    return PREAMBLE + "\n\n".join(_block(block, folder) for block in blocks) + "\n\\end{document}\n"


def fragment(blocks: Sequence[Block]) -> str:
    """The tabulars alone, to be taken into somebody's document with \\input; it needs booktabs. What belongs below
    a table stands in comments."""
    lines = [NEEDS]
    for block in blocks:
        if isinstance(block, Table):
            lines += [f"% {' '.join(visible(block.title).split())}"] if block.title else []
            lines += [*([PAIRED] if block.paired else []), _tabular(block)]
        elif not isinstance(block, Heading):
            lines.append(f"% {_block(block, Path())}")
    return "\n".join(lines) + "\n"


def escape(text: str) -> str:
    """Text that LaTeX sets as it is. A letter that no font of the document has is shown by its number."""
    return "".join(SPECIAL.get(c) or (c if ord(c) <= LATIN and c.isprintable() else _unknown(c)) for c in text)


def _unknown(character: str) -> str:
    return " " if character.isspace() else f"[U+{ord(character):04X}]"


def _block(block: Block, folder: Path) -> str:
    match block:
        case Heading(level, text):
            return rf"\{'section' if level <= 2 else 'subsection'}*{{{escape(text)}}}"
        case Paragraph(words):
            return rf"\sloppy {_words(words)}"
        case Bullets(items):
            return "\n".join(
                [r"\begin{itemize}", *(rf"\item {{}}{_words(item)}" for item in items), r"\end{itemize}"]
            )
        case Table():
            return _environment(block) if block.title else rf"\fitted{{{_tabular(block)}}}"
        case Picture(png, caption):
            where = Path(os.path.relpath(png, folder)).as_posix()
            return (
                r"\begin{center}" + rf"\includegraphics[width=\linewidth]{{\detokenize{{{where}}}}}"
                rf"\\ {escape(caption)}" + r"\end{center}"
            )


def _environment(table: Table) -> str:
    notes = [rf"\par {escape(note)}" for note in table.notes]
    lines = [
        *([PAIRED] if table.paired else []),
        r"\begin{table}[!htbp]",
        r"\centering\footnotesize",
        rf"\caption{{{escape(table.title)}.}}",
        *([rf"\label{{tab:{table.name}}}"] if table.name else []),
        rf"\par\smallskip\fitted{{{_tabular(table)}}}",
        *([r"\par\medskip\begin{minipage}{\linewidth}\footnotesize\raggedright"] if notes else []),
        *notes,
        *([r"\end{minipage}"] if notes else []),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _tabular(table: Table) -> str:
    words = table.left + table.ticks
    spec = "l" * table.left + "c" * table.ticks + "r" * (len(table.head) - words)
    groups, rules, at = [], [], words + 1
    for name, width in table.groups.items():
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(name)}}}")
        rules.append(rf"\cmidrule(lr){{{at}-{at + width - 1}}}")
        at += width
    lines = [rf"\begin{{tabular}}{{{spec}}}", r"\toprule"]
    lines += [" & " * words + " & ".join(groups) + r" \\", " ".join(rules)] if groups else []
    lines += [_row([cell.title if isinstance(cell, Column) else cell for cell in table.head]), r"\midrule"]
    for k, row in enumerate(table.rows):
        lines += [*([r"\midrule"] if table.begins_section(k) else []), _row(row)]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _row(cells: Sequence[Cell]) -> str:
    row = " & ".join(map(_words, cells)) + r" \\"
    # after the \\ of the row above, a bracket or a star would be taken for its argument
    return ("{}" if row[:1] in "[*" else "") + row


def _words(words: Cell) -> str:
    return "".join(
        escape(piece) if isinstance(piece, str) else STYLES[piece.style] % escape(piece.text)
        for piece in spans(words)
    )
