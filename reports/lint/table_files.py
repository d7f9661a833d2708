"""Tables read from a LaTeX or Markdown file, by its ending; GitHub's Markdown with what its cells show and mark."""

from __future__ import annotations

import re
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

from ihbench.errors import BadInput
from ihbench.files.regular import read_text
from ihbench.reports.lint.latex_reading import latex_grids, show
from ihbench.reports.lint.table_reading import PAIRED, Grid, GridRow, ReadCell, Reading, Styled, read_cell, tables_of

BOLD, UNDERLINED = ("strong", "b"), ("u", "ins")
TAG = re.compile(r"<(/?)([A-Za-z]+)")
LARGEST_FILE = 4 * 2**20  # bytes


def read_tables(path: Path) -> Reading:
    """Every table of a .tex or .md file.

    Raises `BadInput` for a file that is missing, too large, not text, of another kind, or without any table.
    """
    readers = {".tex": latex_grids, ".md": markdown_grids, ".markdown": markdown_grids}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise BadInput(f"{path}: expected a .tex or .md file")
    text = read_text(path, "a file of tables", LARGEST_FILE)
    grids, notes = reader(text)
    if not grids:
        note = f" ({notes[0][1]}, line {notes[0][0]})" if notes else ""
        raise BadInput(f"{path}: no table in it{note}; expected a tabular environment or a Markdown table")
    return Reading([table for grid in grids for table in tables_of(grid)], notes)


def markdown_grids(text: str) -> tuple[list[Grid], list[tuple[int, str]]]:
    """The tables of a Markdown file in order, and notes (line, text) on what was not understood."""
    grids: list[Grid] = []
    notes: list[tuple[int, str]] = []
    rows: list[GridRow] = []
    cells: list[ReadCell] = []
    paired, line = False, 1
    for token in MarkdownIt("commonmark", {"html": True}).enable("table").parse(text):
        line = token.map[0] + 1 if token.map else line
        if token.type == "html_block":
            paired |= re.search(rf"<!--\s*{PAIRED}\s*-->", token.content) is not None
            if "<table" in token.content.lower():
                notes.append((line, "tables in HTML are not read"))
        elif token.type == "table_open":
            rows = []
        elif token.type == "tr_open":
            cells = []
        elif token.type == "inline":
            cells.append(read_cell(_styled(token.children or []), line))
        elif token.type == "tr_close":
            rows.append(GridRow(tuple(cells), line))
        elif token.type == "table_close":
            grids.append(Grid(rows[0].line, tuple(rows), paired, heads=1))
            paired = False
    return grids, notes


def _styled(tokens: list[Token]) -> Styled:
    """Characters with the mark that they carry. What is raised by <sup> is left out."""
    styled: Styled = []
    opened: list[str] = []
    for token in tokens:
        tag = TAG.match(token.content) if token.type == "html_inline" else None
        name = tag[2].lower() if tag else token.tag
        if (tag and not tag[1] and name != "br") or token.nesting > 0:
            opened.append(name)
        elif (tag and tag[1]) or token.nesting < 0:
            if name in opened:
                opened.remove(name)
        elif token.type in ("softbreak", "hardbreak") or name == "br":
            styled.append((" ", ""))
        elif "sup" not in opened:
            mark = (
                "best" if any(o in BOLD for o in opened) else "second" if any(o in UNDERLINED for o in opened) else ""
            )
            for k, part in enumerate(re.split(r"\$([^$]+)\$", token.content)):
                styled += [(c, own or mark) for c, own in (show(part)[0] if k % 2 else [(c, "") for c in part])]
    text = "".join(character for character, _ in styled)
    return styled[len(text) - len(text.lstrip()) : len(text.rstrip())]
