r"""LaTeX tables read into grids, without TeX.

Understood: tabular, tabular* and tabularx; \multicolumn, \multirow and the rules of booktabs; comments; macros that
\newcommand defines in the same file; and in cells bold, underline, footnotes, spreads and the usual signs. A command
that is not known is read as if it were not there, its braces as text, and noted. Files that are included are not
followed.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field

from ihbench.reports.lint.table_reading import PAIRED, Grid, GridRow, ReadCell, Styled, read_cell

BUDGET = 1000  # groups and macros of a cell: one macro can call itself twice
DEEPEST = 60
TABULAR = re.compile(r"\\begin\{(tabular[*x]?)\}(.*?)(\\end\{\1\}|\Z)", re.DOTALL)
COMMENT = re.compile(r"(?<!\\)((?:\\\\)*)%[^\n]*|\\begin\{comment\}.*?\\end\{comment\}|\\iffalse.*?\\fi", re.DOTALL)
GROUP = r"\{((?:[^{}\\]|\\.|\{(?:[^{}\\]|\\.|\{[^{}]*\})*\})*)\}"  # braces, three deep
MACRO = re.compile(r"\\(?:re)?newcommand\*?\s*\{?\\([A-Za-z]+)\}?\s*(?:\[(\d)\])?\s*" + GROUP)
FULL_RULE = re.compile(r"\s*\\(?:hline|toprule|midrule|bottomrule)\b\s*(?:\[[^\]]*\])?")
BETWEEN = re.compile(
    r"\s*\\(?:c(?:mid)?rule|cline|addlinespace|rowcolor|noalign|vspace)\*?(?:\[[^\]]*\]|\([^)]*\)|\{[^{}]*\})*"
)
SPAN = re.compile(r"\\(multicolumn|multirow)\*?\s*(?:\[[^\]]*\])?\s*\{\s*-?(\d{1,2})\s*\}")
TOKEN = re.compile(r"\\([A-Za-z]+)\*?\s?|\\(.)|(.)", re.DOTALL)
ARGUMENT = re.compile(r"\s*(?:\[[^\]]*\])?\s*(?:" + GROUP + r"|(\\[A-Za-z]+|\\?.))", re.DOTALL)

MARKS = {
    **dict.fromkeys(("textbf", "mathbf", "bm", "boldsymbol", "bf", "bfseries", "best", "first"), "best"),
    **dict.fromkeys(("underline", "uline", "ul", "second", "secondbest"), "second"),
}
DECLARATIONS = ("bf", "bfseries")  # up to the end of the group
# commands that show all of what follows, or whose last argument is shown: how many stand before it
SHOWN = {
    **dict.fromkeys(
        ("textrm", "textsf", "texttt", "textsc", "textit", "emph", "mathit", "mathrm", "text", "mbox", "makecell",
         "num", "ensuremath", "operatorname", "tiny", "scriptsize", "footnotesize", "small", "normalsize",
         "centering", "it", "itshape", "left", "right", "hfill", "displaystyle", "protect"), 0,
    ),
    "textcolor": 1, "color": 1, "href": 1, "scalebox": 1, "raisebox": 1,
    "multirow": 2, "multicolumn": 2, "resizebox": 2,
}  # fmt: skip
DROPPED = (
    "cite", "citep", "citet", "ref", "cref", "label", "footnote", "textsuperscript", "tnote", "phantom", "hphantom",
    "vphantom", "cellcolor", "rowcolor", "hspace", "vspace",
)  # fmt: skip
SIGNS = {
    "uparrow": "↑", "downarrow": "↓", "pm": "±", "times": "×", "cdot": "·", "sim": "~", "approx": "≈", "infty": "∞",
    "le": "≤", "leq": "≤", "ge": "≥", "geq": "≥", "dagger": "†", "ddagger": "‡", "ast": "*", "checkmark": "✓",
    "beta": "β", "bullet": "•", "textdagger": "†", "textdaggerdbl": "‡", "textdegree": "°", "textquotedbl": '"',
    "textasciigrave": "`", "surd": "✓", "textperiodcentered": "·", "textmu": "µ", "degree": "°", "circ": "°",
    "rightarrow": "→", "textendash": "–", "textemdash": "—", "ldots": "…", "dots": "…", "quad": " ", "qquad": " ",
    "textbackslash": "\\", "textless": "<", "textgreater": ">", "textbar": "|", "textasciitilde": "~",
    "textasciicircum": "^", "Delta": "Δ", "delta": "δ", "mu": "μ", "sigma": "σ", "lambda": "λ", "alpha": "α",
    "S": "§",
}  # fmt: skip
SPACING = {**dict.fromkeys(",;: \n\\", " "), **dict.fromkeys("!/-()[]@", "")}  # after a backslash
FOOTNOTE = re.compile(r"[*†‡§¶∗°\s\d]*|[a-z](\s*,\s*[a-z])*")  # a superscript that says nothing of the number
SPREAD = re.compile(r"[±+\-−]\s*[\d.]")

Macros = dict[str, tuple[int, str]]  # name -> number of arguments, body
Notes = list[tuple[int, str]]  # line, text


def latex_grids(text: str) -> tuple[list[Grid], Notes]:
    """The tables of a LaTeX file in order, and notes on what was not understood."""
    paired = [match.start() for match in re.finditer(rf"%\s*{PAIRED}\b", text)]
    code = COMMENT.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)
    macros = {match[1]: (int(match[2] or 0), match[3]) for match in MACRO.finditer(code)}
    code = MACRO.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), code)
    starts = [0, *(match.end() for match in re.finditer("\n", text))]
    grids, notes, before = [], [], 0
    for match in TABULAR.finditer(code):
        reader = _Rows(code, starts, macros, notes)
        line = bisect_right(starts, match.start())
        if not match[3]:
            notes.append((line, rf"\begin{{{match[1]}}} without \end{{{match[1]}}}"))
        inner = match.start(2)
        for _ in range(1 if match[1] == "tabular" else 2):  # width, columns
            if (
                argument := re.compile(r"\s*(?:\[[^\]]*\]\s*)?" + GROUP).match(code, inner, match.end(2))
            ) is not None:
                inner = argument.end()
        rows = reader.rows(inner, match.end(2))
        if any(len(row.cells) > 1 for row in rows):
            grids.append(Grid(line, tuple(rows), any(before <= place < match.start() for place in paired)))
        before = match.end()
    for match in re.finditer(r"\\(?:input|include)\s*\{[^}]*\}", code):
        notes.append((bisect_right(starts, match.start()), f"{match[0]} not followed"))
    return grids, list(dict.fromkeys(notes))


@dataclass
class _Rows:
    code: str
    starts: list[int]  # of the file's lines
    macros: Macros
    notes: Notes

    def rows(self, begin: int, end: int) -> list[GridRow]:
        rows: list[GridRow] = []
        reaching: dict[int, tuple[int, ReadCell]] = {}  # column -> rows that a \multirow still covers, its cell
        pending = False  # a rule that stands alone belongs to the next row
        for row in self._pieces(begin, end, re.compile(r"\\\\\*?(?:\s*\[[^\]]*\])?|\\tabularnewline\b")):
            at, stop = row
            while (rule := FULL_RULE.match(self.code, at, stop) or BETWEEN.match(self.code, at, stop)) is not None:
                pending |= FULL_RULE.match(rule[0]) is not None
                at = rule.end()
            if not self.code[at:stop].strip():
                continue
            cells: list[ReadCell] = []
            for cell_begin, cell_end in self._pieces(at, stop, re.compile("&")):
                cell, across, down = self._cell(cell_begin, cell_end)
                left, above = reaching.pop(len(cells), (0, cell))
                if left > 0 and not cell.text:
                    reaching[len(cells)] = left - 1, above
                    cell = cell if above.number else above
                elif down > 1:
                    reaching[len(cells)] = down - 1, cell
                cells += [cell] * across
            at += len(self.code[at:stop]) - len(self.code[at:stop].lstrip())
            rows.append(GridRow(tuple(cells), bisect_right(self.starts, at), pending))
            pending = False
        return rows

    def _pieces(self, begin: int, end: int, border: re.Pattern[str]) -> Iterator[tuple[int, int]]:
        """What lies between borders outside groups."""
        depth, start, k = 0, begin, begin
        while k < end:
            if depth <= 0 and (match := border.match(self.code, k, end)) is not None:
                yield start, k
                start = k = match.end()
                continue
            c = self.code[k]
            depth += (c == "{") - (c == "}")
            k += 2 if c == "\\" else 1
        yield start, end

    def _cell(self, begin: int, end: int) -> tuple[ReadCell, int, int]:
        """A cell, how many columns it spans, and how many rows."""
        source = self.code[begin:end]
        line = bisect_right(self.starts, begin + len(source) - len(source.lstrip()))
        spans = {match[1]: max(1, int(match[2])) for match in SPAN.finditer(source)}
        shown, notes = show(source, self.macros)
        self.notes += [(line, note) for note in notes]
        text = "".join(character for character, _ in shown)
        trimmed = shown[len(text) - len(text.lstrip()) : len(text.rstrip())]
        return read_cell(trimmed, line), spans.get("multicolumn", 1), spans.get("multirow", 1)


def show(source: str, macros: Macros | None = None) -> tuple[Styled, list[str]]:
    """The characters that a piece of code shows, with their marks, and what was not understood."""
    shown = _Shown(macros or {})
    shown.add(source, "", 0)
    return shown.styled, list(dict.fromkeys(shown.notes))


@dataclass
class _Shown:
    macros: Macros
    styled: Styled = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    left: int = BUDGET

    def add(self, source: str, mark: str, depth: int) -> None:
        """Append what the source shows, marked."""
        self.left -= 1
        if depth > DEEPEST or self.left < 0:
            self.notes.append("nested too deeply, or too long: the rest of the cell is left out")
            return
        at = 0
        while (token := TOKEN.match(source, at)) is not None:
            name, escaped, character = token.groups()
            at = token.end()
            if name is not None:
                at, mark = self._command(name, source, at, mark, depth)
            elif escaped is not None:
                self._put(SPACING.get(escaped, escaped), mark)
            elif character == "{" and (group := re.compile(GROUP).match(source, at - 1)) is not None:
                self.add(group[1], mark, depth + 1)
                at = group.end()
            elif character in "^_":
                at = self._script(source, at, mark, depth)
            elif character not in "{}$":
                self._put(" " if character in "~\n\t" else character, mark)

    def _put(self, text: str, mark: str) -> None:
        self.styled += [(character, mark) for character in text]

    def _command(self, name: str, source: str, at: int, mark: str, depth: int) -> tuple[int, str]:
        """Show a command; behind it, and the mark from there on."""
        own = mark if mark == "best" else MARKS.get(name, mark)
        if name in DECLARATIONS:
            return at, own
        if name in MARKS:
            at, inside = _argument(source, at)
            self.add(inside, own, depth + 1)
        elif name in self.macros:
            count, body = self.macros[name]
            for k in range(count):
                at, inside = _argument(source, at)
                body = body.replace(f"#{k + 1}", inside)[:BUDGET]
            self.add(body, mark, depth + 1)
        elif name in SIGNS:
            self._put(SIGNS[name], mark)
        elif name in DROPPED or name in SHOWN:
            for _ in range(SHOWN.get(name, 1)):
                at, _ = _argument(source, at)
        else:
            self.notes.append(f"\\{name} is not known: its braces are read as text")
        return at, mark

    def _script(self, source: str, at: int, mark: str, depth: int) -> int:
        """A superscript or subscript: shown if it is a spread, left out if it is a footnote's sign."""
        at, inside = _argument(source, at)
        place = len(self.styled)
        self.add(inside, mark, depth + 1)
        text = "".join(character for character, _ in self.styled[place:]).strip()
        if SPREAD.match(text):
            self.styled.insert(place, (" ", mark))
        elif FOOTNOTE.fullmatch(text):
            del self.styled[place:]
        return at


def _argument(source: str, at: int) -> tuple[int, str]:
    """Behind the next argument, and the argument: a group, a command or a character. Optional ones are skipped."""
    match = ARGUMENT.match(source, at)
    return (len(source), "") if match is None else (match.end(), match[1] if match[2] is None else match[2])
