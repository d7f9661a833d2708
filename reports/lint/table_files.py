"""Tables read from a LaTeX or Markdown file, by its ending."""

from __future__ import annotations

from pathlib import Path

from ihbench.errors import BadInput
from ihbench.files.regular import read_text
from ihbench.reports.lint.latex_reading import latex_grids
from ihbench.reports.lint.markdown_reading import markdown_grids
from ihbench.reports.lint.table_reading import Reading, tables_of

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
        told = f" ({notes[0][1]}, line {notes[0][0]})" if notes else ""
        raise BadInput(f"{path}: no table in it{told}; expected a tabular environment or a Markdown table")
    return Reading([table for grid in grids for table in tables_of(grid)], notes)
