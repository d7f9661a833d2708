r"""LaTeX tables read into grids, without TeX.

Understood: tabular, tabular*, tabularx, tabulary, longtable, tabu, tblr and NiceTabular; \multicolumn, \multirow;
rules of all packages; comments; the file's own macros; and in cells what `latex_cells.py` understands. Files that are
included are not followed.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from ihbench.reports.lint.latex_cells import LONGEST, Macros, after_optional, closing, show
from ihbench.reports.lint.table_reading import PAIRED, Grid, GridRow, ReadCell, Styled, blanked, read_cell

TABULARS = (
    "tabular", "tabular*", "tabularx", "tabulary", "longtable", "xltabular", "supertabular", "tabu", "longtabu",
    "tblr", "longtblr", "talltblr", "NiceTabular", "NiceTabular*", "NiceTabularX",
)  # fmt: skip
WITH_WIDTH = ("tabular*", "tabularx", "tabulary", "xltabular", "NiceTabular*", "NiceTabularX")  # {width}{columns}
FLOATS = ("table", "wraptable", "sidewaystable", "figure", "minipage")
EDGE = re.compile(r"\\(begin|end)\s*\{(" + "|".join(map(re.escape, TABULARS)) + r")\}")
ENVIRONMENT = re.compile(r"\\(begin|end)\s*\{")
ROW_END = re.compile(r"(?:\\\\\*?|\\tabularnewline\b|\\cr\b)(?:\s*\[[-+.\w\s\\]*\])?")
COMMENT = re.compile(r"(?<!\\)((?:\\\\)*)%[^\n]*")
HIDDEN = (
    *((rf"\begin{{{name}}}", rf"\end{{{name}}}") for name in ("comment", "verbatim", "lstlisting")),
    (r"\iffalse", r"\fi"),
)
DEFINITION = re.compile(
    r"\\(?:(?:re)?newcommand|providecommand|DeclareRobustCommand)\*?\s*\{?\s*\\([A-Za-z]+)\s*\}?\s*(?:\[(\d)\])?"
    r"(?:\[[^\]]*\])?\s*(?=\{)|\\def\s*\\([A-Za-z]+)\s*((?:#\d)*)\s*(?=\{)"
)
CAPTION = re.compile(r"\\caption(?:of)?\*?(?:\s*\{(?:table|figure)\})?(?:\s*\[[^\]]*\])?\s*(?=\{)")
INPUT = re.compile(r"\\(?:input|include)\s*\{[^}]*\}")
FULL_RULES = (
    "hline",
    "Hline",
    "toprule",
    "midrule",
    "bottomrule",
    "specialrule",
    "Xhline",
    "hdashline",
    "thickhline",
)
# what may stand between two rows: how many arguments it has beside optional ones
BETWEEN = {
    **dict.fromkeys(FULL_RULES, 0),
    **dict.fromkeys(
        ("addlinespace", "morecmidrules", "endhead", "endfirsthead", "endfoot", "endlastfoot", "smallskip", "medskip",
         "bigskip", "pagebreak", "nopagebreak"), 0,
    ),
    **dict.fromkeys(
        ("Xhline", "cline", "cmidrule", "cdashline", "cdashlinelr", "hhline", "noalign", "arrayrulecolor", "rowcolor",
         "vspace", "SetRow", "caption", "label"), 1,
    ),
    **dict.fromkeys(("Xcline", "setlength", "rule"), 2),
    **dict.fromkeys(("specialrule", "rowcolors"), 3),
}  # fmt: skip

Notes = list[tuple[int, str]]  # line, text


def latex_grids(text: str) -> tuple[list[Grid], Notes]:
    """The tables of a LaTeX file in order, and notes on what was not understood."""
    paired = [found.start() for found in re.finditer(rf"%\s*{PAIRED}\b", text)]
    code = text
    for opening, ending in HIDDEN:
        code = blanked(code, opening, ending)
    code = COMMENT.sub(_spaces, code)
    macros, code = _macros(code)
    reader = _Reader(code, [0, *(found.end() for found in re.finditer("\n", text))], macros)
    grids, before = [], 0
    for begin, inner, end in reader.tabulars():
        rows = reader.rows(inner, end)
        if rows:
            told = any(before <= place < end for place in paired)
            grids.append(Grid(reader.line(begin), tuple(rows), _caption(code, begin, end), told))
        before = end
    reader.notes += [(reader.line(found.start()), f"{found[0]} not followed") for found in INPUT.finditer(code)]
    return grids, list(dict.fromkeys(reader.notes))


def _spaces(found: re.Match[str]) -> str:
    """As many spaces, so that everything else stays where it is."""
    return re.sub(r"[^\n]", " ", found[0])


def _macros(code: str) -> tuple[Macros, str]:
    """The file's own macros, and the file without their definitions."""
    macros: Macros = {}
    parts, at, kept = [], 0, 0
    while (found := DEFINITION.search(code, at)) is not None:
        at = found.end()
        end = closing(code, at)
        if end is None:
            break
        count = int(found[2] or 0) if found[1] else len(found[4] or "") // 2
        macros[found[1] or found[3]] = count, code[at + 1 : end]
        at = end + 1
        parts += [code[kept : found.start()], re.sub(r"[^\n]", " ", code[found.start() : at])]
        kept = at
    return macros, "".join([*parts, code[kept:]])


def _caption(code: str, begin: int, end: int) -> str:
    """The caption of the float around a table, without commands."""
    opened = max(code.rfind(rf"\begin{{{name}", 0, begin) for name in FLOATS)
    if opened < 0 or any(code.find(rf"\end{{{name}", opened, begin) >= 0 for name in FLOATS):
        return ""
    closed = min((at for name in FLOATS if (at := code.find(rf"\end{{{name}", end)) >= 0), default=len(code))
    found = CAPTION.search(code, opened, closed)
    close = None if found is None else closing(code, found.end())
    if found is None or close is None:
        return ""
    return " ".join(re.sub(r"\\[A-Za-z]+\*?|[{}~]", " ", code[found.end() : close]).split())


@dataclass
class _Reader:
    code: str
    starts: Sequence[int]  # of the file's lines
    macros: Macros
    notes: Notes = field(default_factory=list)

    def line(self, at: int) -> int:
        return bisect_right(self.starts, at)

    def tabulars(self) -> Iterator[tuple[int, int, int]]:
        """(begin, begin of the rows, end of the rows) of tables, of nested ones too, if they have cells."""
        opened: list[tuple[str, int, int]] = []
        found: list[tuple[str, int, int, int]] = []  # name, begin, behind the name, end
        for edge in EDGE.finditer(self.code):
            if edge[1] == "begin":
                opened.append((edge[2], edge.start(), edge.end()))
            elif any(name == edge[2] for name, _, _ in opened):
                while (last := opened.pop())[0] != edge[2]:
                    found.append((*last, edge.start()))
                    self._unclosed(*last[:2])
                found.append((*last, edge.start()))
        for last in opened:
            found.append((*last, len(self.code)))
            self._unclosed(*last[:2])
        for name, begin, after, end in sorted(found, key=lambda table: table[1]):
            inner = self._after_arguments(name, after, end)
            if re.compile(r"(?<!\\)&").search(self.code, inner, end):
                yield begin, inner, end

    def _unclosed(self, name: str, begin: int) -> None:
        self.notes.append((self.line(begin), rf"\begin{{{name}}} without \end{{{name}}}"))

    def _after_arguments(self, name: str, at: int, end: int) -> int:
        """Behind the arguments of an environment: [position], {width}, {columns}."""
        braces = 2 if name in WITH_WIDTH else 1
        spread = re.compile(r"\s*(?:to|spread)\s*[^\s{]+").match(self.code, at)
        if name in ("tabu", "longtabu") and spread is not None:
            at = spread.end()
        while True:
            while at < end and self.code[at].isspace():
                at += 1
            behind = after_optional(self.code, at)
            if behind == at and braces and self.code[at : at + 1] == "{":
                close = closing(self.code, at)
                behind, braces = (at if close is None else close + 1), braces - 1
            if behind == at:
                return min(at, end)
            at = behind

    def rows(self, begin: int, end: int) -> list[GridRow]:
        rows: list[GridRow] = []
        reaching: dict[int, tuple[int, ReadCell]] = {}  # column -> rows that a \multirow still covers, its cell
        pending = False  # a rule that stands alone belongs to the next row
        for row_begin, row_end in self._pieces(begin, end, rows=True):
            at, ruled = self._between(row_begin, row_end)
            pending |= ruled
            if not self.code[at:row_end].strip():
                continue
            cells: list[ReadCell] = []
            for cell_begin, cell_end in self._pieces(at, row_end, rows=False):
                cell, across, down = self._cell(cell_begin, cell_end)
                column = len(cells)
                left, above = reaching.pop(column, (0, cell))
                if left > 0 and not cell.text:
                    reaching[column] = left - 1, above
                    cell = cell if above.number else above
                elif down > 1:
                    reaching[column] = down - 1, cell
                cells += [cell] * across
            rows.append(GridRow(tuple(cells), self.line(at), pending))
            pending = False
        return rows

    def _pieces(self, begin: int, end: int, rows: bool) -> Iterator[tuple[int, int]]:
        r"""What lies between \\ (rows) or & (cells), outside groups and inner environments."""
        code, depth, inner, start, k = self.code, 0, 0, begin, begin
        while k < end:
            c = code[k]
            if c == "\\":
                if (edge := ENVIRONMENT.match(code, k)) is not None:
                    inner += 1 if edge[1] == "begin" else -1
                    k = edge.end() - 1
                elif rows and depth <= 0 and inner <= 0 and (found := ROW_END.match(code, k, end)) is not None:
                    yield start, k
                    start = k = found.end()
                else:
                    k += 2
                continue
            depth += (c == "{") - (c == "}")
            if c == "&" and not rows and depth <= 0 and inner <= 0:
                yield start, k
                start = k + 1
            k += 1
        yield start, end

    def _between(self, at: int, end: int) -> tuple[int, bool]:
        """Behind the rules at the start of a row, and whether one of them goes all the way across."""
        code, ruled = self.code, False
        while True:
            while at < end and code[at].isspace():
                at += 1
            found = re.compile(r"\\([A-Za-z]+)\*?").match(code, at, end)
            if found is None or found[1] not in BETWEEN:
                return at, ruled
            ruled |= found[1] in FULL_RULES
            at, arguments = found.end(), BETWEEN[found[1]]
            while at < end:
                optional = re.compile(r"\s*(?:\[[^\]]*\]|\([^)]*\))").match(code, at, end)
                brace = re.compile(r"\s*\{").match(code, at, end) if arguments else None
                if optional is not None:
                    at = optional.end()
                elif brace is not None and (close := closing(code, brace.end() - 1)) is not None:
                    at, arguments = close + 1, arguments - 1
                else:
                    break

    def _cell(self, begin: int, end: int) -> tuple[ReadCell, int, int]:
        """A cell, how many columns it spans, and how many rows."""
        source = self.code[begin : min(end, begin + LONGEST)]
        line = self.line(begin + len(source) - len(source.lstrip()))
        if end - begin > LONGEST:
            self.notes.append((line, "a cell is too long: the rest of it is left out"))
        across, down = (_spanned(source, name) for name in ("multicolumn", "multirow"))
        if re.search(r"\\SetCell\s*\[[^\]]*\b[cr]\s*=", source):
            self.notes.append((line, r"\SetCell over several cells: only the first is read"))
        shown = show(source, self.macros)
        self.notes += [(line, note) for note in shown.notes]
        return read_cell(_trimmed(shown.styled), line, shown.colours), across, down


def _spanned(source: str, name: str) -> int:
    found = re.search(rf"\\{name}\*?\s*(?:\[[^\]]*\])?\s*\{{\s*-?(\d{{1,3}})\s*\}}", source)
    return max(1, min(int(found[1]), 200)) if found else 1


def _trimmed(styled: Styled) -> Styled:
    text = "".join(character for character, _ in styled)
    return styled[len(text) - len(text.lstrip()) : len(text.rstrip())]
