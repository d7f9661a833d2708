"""The general report in LaTeX: one document that pdflatex compiles, tables with booktabs' rules."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ihbench.document.document import Block, Bullets, Heading, Paragraph, Picture, Table, Words, spans
from ihbench.errors import visible
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult
from ihbench.reports.general.content import general_report, score_tables
from ihbench.reports.general.short_names import with_short_names

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
    "†": r"\textdagger{}", "‡": r"\textdaggerdbl{}", "§": r"\S{}",
}  # fmt: skip
NEEDS = r"% a fragment for \input: needs \usepackage{booktabs}, \usepackage{textcomp} and, in pdflatex, T1 fonts"
STYLES = {"strong": r"\textbf", "emphasis": r"\emph", "code": r"\texttt", "raised": r"\textsuperscript"}
LATIN = 0x17F  # the last letter that T1 fonts have


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
    """The report of these runs; see `general_report`. Row names are short, their switches stand below."""
    if fragment:
        return fragments(results, presets)
    return latex(with_short_names(general_report(results, presets, targets, pictures, left_out)), folder)


def fragments(results: Sequence[RunResult], presets: Sequence[str] = ()) -> str:
    """The tabulars alone, to be taken into somebody's document with \\input; it needs booktabs. What belongs below a
    table stands in comments."""
    lines = [NEEDS]
    for title, table in score_tables(results, presets):
        lines.append(f"% {_comment(title)}")
        for block in with_short_names([table]):
            lines.append(_tabular(block) if isinstance(block, Table) else f"% below it: {_block(block, Path())}")
    return "\n".join(lines) + "\n"


def _comment(text: str) -> str:
    return " ".join(visible(text).split())


def latex(blocks: Sequence[Block], folder: Path = Path(".")) -> str:
    """A whole document of some blocks."""
    return PREAMBLE + "\n\n".join(_block(block, folder) for block in blocks) + "\n\\end{document}\n"


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
            return _table(block)
        case Picture(png, caption):
            where = Path(os.path.relpath(png, folder)).as_posix()
            return (
                r"\begin{center}" + rf"\includegraphics[width=\linewidth]{{\detokenize{{{where}}}}}"
                rf"\\ {escape(caption)}" + r"\end{center}"
            )
    raise TypeError(f"report: expected a block of document.py, got {type(block).__name__}")


def _table(table: Table) -> str:
    return rf"\fitted{{{_tabular(table)}}}"


def _tabular(table: Table) -> str:
    columns = "l" * table.left + "r" * (len(table.head) - table.left)
    rows = [" & ".join(_words(cell) for cell in row) + r" \\" for row in (table.head, *table.rows)]
    body = "\n".join([r"\toprule", rows[0], r"\midrule", *rows[1:], r"\bottomrule"])
    return rf"\begin{{tabular}}{{{columns}}}" + f"\n{body}\n" + r"\end{tabular}"


def _words(words: Words) -> str:
    return "".join(
        escape(piece) if isinstance(piece, str) else f"{STYLES[piece.style]}{{{escape(piece.text)}}}"
        for piece in spans(words)
    )
