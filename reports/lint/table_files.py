"""Tables read from a LaTeX or Markdown file, by its ending; GitHub's Markdown with what its cells show and mark."""

from __future__ import annotations

import re
from pathlib import Path

from markdown_it import MarkdownIt
from markdown_it.token import Token

from ihbench.errors import BadInput
from ihbench.files.regular import read_text
from ihbench.reports.lint.latex_reading import Notes, latex_grids, show
from ihbench.reports.lint.table_reading import PAIRED, Cell, Grid, Styled, Table, read_cell, tables_of

MARKS = {"u": "second", "ins": "second", "b": "best", "strong": "best"}
TAG = re.compile(r"<(/?)([A-Za-z]+)")
LARGEST_FILE = 4 * 2**20  # bytes


def read_tables(path: Path) -> tuple[list[Table], Notes]:
    """Every table of a .tex or .md file, and notes on what was not understood.

    Raises `BadInput` for a file that is missing, too large, not text, of another kind, or without any table.
    """
    readers = {".tex": latex_grids, ".md": markdown_grids, ".markdown": markdown_grids}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise BadInput(f"{path}: expected a .tex or .md file")
    grids, notes = reader(read_text(path, "a file of tables", LARGEST_FILE))
    if not grids:
        note = f" ({notes[0][1]}, line {notes[0][0]})" if notes else ""
        raise BadInput(f"{path}: no table in it{note}; expected a tabular environment or a Markdown table")
    return [table for grid in grids for table in tables_of(grid)], notes


def markdown_grids(text: str) -> tuple[list[Grid], Notes]:
    """The tables of a Markdown file in order, and notes on what was not understood."""
    grids: list[Grid] = []
    notes: Notes = []
    rows: list[list[Cell]] = []
    paired, line = False, 1
    for token in MarkdownIt("commonmark", {"html": True}).enable("table").parse(text):
        line = token.map[0] + 1 if token.map else line
        if token.type == "html_block":
            paired |= re.search(rf"<!--\s*{PAIRED}\s*-->", token.content) is not None
            if "<table" in token.content.lower():
                notes.append((line, "tables in HTML are not read"))
        elif token.type == "tr_open":
            rows.append([])
        elif token.type == "inline" and rows:
            rows[-1].append(read_cell(_styled(token.children or []), line))
        elif token.type == "table_close":
            grids.append(Grid(rows[0][0].line, rows, [False] * len(rows), paired, heads=1))
            rows, paired = [], False
    return grids, notes


def _styled(tokens: list[Token]) -> Styled:
    """Characters with the mark that they carry. What is raised by <sup> is left out."""
    styled: Styled = []
    opened: list[str] = []
    for token in tokens:
        tag = TAG.match(token.content) if token.type == "html_inline" else None
        name = tag[2].lower() if tag else token.tag
        nesting = (-1 if tag[1] else 1) if tag else token.nesting
        if token.type in ("softbreak", "hardbreak") or name == "br":
            styled.append((" ", ""))
        elif nesting > 0:
            opened.append(name)
        elif nesting < 0:
            opened = [o for o in opened if o != name]
        elif "sup" not in opened:
            mark = min((MARKS[o] for o in opened if o in MARKS), default="")
            for k, part in enumerate(re.split(r"\$([^$]+)\$", token.content)):
                styled += show(part, {}, [], mark) if k % 2 else [(c, mark) for c in part]
    return styled
