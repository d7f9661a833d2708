r"""LaTeX tables read into grids, without TeX.

Understood: tabular, tabular* and tabularx; \multicolumn, \multirow and the rules of booktabs; comments; macros that
\newcommand defines in the same file; and in cells bold, underline, footnotes, spreads and the usual signs. A command
that is not known is read as if it were not there, its braces as text, and noted. Files that are included are not
followed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.entities import html5

from ihbench.document.latex import SPECIAL
from ihbench.reports.lint.table_reading import PAIRED, Cell, Grid, Styled, read_cell

COMMENT = re.compile(r"(?<!\\)((?:\\\\)*)%[^\n]*|\\begin\{comment\}.*?\\end\{comment\}|\\iffalse.*?\\fi", re.DOTALL)
GROUP = r"\{((?:[^{}\\]|\\.|\{(?:[^{}\\]|\\.|\{[^{}]*\})*\})*)\}"  # braces, three deep
ARGUMENT = re.compile(rf"\s*(?:\[[^\]]*\])?\s*(?:{GROUP}|(\\[A-Za-z]+|\\?.))", re.DOTALL)
MACRO = re.compile(rf"\\(?:re)?newcommand\*?\s*\{{?\\([A-Za-z]+)\}}?\s*(?:\[(\d)\])?\s*{GROUP}")
TABULAR = re.compile(r"\\begin\{(tabular[*x]?)\}(.*?)(\\end\{\1\}|\Z)", re.DOTALL)
WIDTH_OR_COLUMNS = re.compile(rf"\s*(?:\[[^\]]*\]\s*)?{GROUP}")
ROW_END = re.compile(r"\\\\\*?(?:\s*\[[^\]]*\])?|\\tabularnewline\b")
RULES = re.compile(  # and what else may stand between rows
    r"(?:\s*\\(?:hline|toprule|midrule|bottomrule|c(?:mid)?rule|cline|addlinespace|rowcolor|noalign|vspace)\b\*?"
    r"(?:\[[^\]]*\]|\([^)]*\)|\{[^{}]*\})*)*"
)
FULL_RULE = re.compile(r"\\(?:hline|toprule|midrule|bottomrule)\b")
SPAN = re.compile(r"\\(multicolumn|multirow)\*?\s*(?:\[[^\]]*\])?\s*\{\s*-?(\d{1,2})\s*\}")
TOKEN = re.compile(r"\\([A-Za-z]+)\*?\s?|\\(.)|(.)", re.DOTALL)

MARKS = {
    **dict.fromkeys(("textbf", "mathbf", "bm", "boldsymbol", "bf", "bfseries", "best", "first"), "best"),
    **dict.fromkeys(("underline", "uline", "ul", "second", "secondbest"), "second"),
}
DECLARATIONS = ("bf", "bfseries")  # up to the end of the group
# how many arguments of a command are not shown; what follows these is
LEFT_OUT = {
    name: count
    for count, names in enumerate((
        "textrm textsf texttt textsc textit emph mathit mathrm text mbox makecell num ensuremath operatorname tiny "
        "scriptsize footnotesize small normalsize centering it itshape left right hfill displaystyle protect",
        "textcolor color href scalebox raisebox cite citep citet ref cref label footnote textsuperscript tnote "
        "phantom hphantom vphantom cellcolor rowcolor hspace vspace",
        "multirow multicolumn resizebox",
    ))
    for name in names.split()
}  # fmt: skip
SIGNS = {  # beside those that HTML has under the same name
    **{code.strip("$\\{}"): sign for sign, code in SPECIAL.items()}, "cdot": "·", "sim": "~", "infty": "∞",
    "dots": "…", "degree": "°", "circ": "°", "textendash": "–", "textemdash": "—", "quad": " ", "qquad": " ",
}  # fmt: skip
SPACING = {**dict.fromkeys(",;: \n\\", " "), **dict.fromkeys("!/-()[]@", "")}  # after a backslash
FOOTNOTE = re.compile(r"[*†‡§¶∗°\s\d]*|[a-z](\s*,\s*[a-z])*")  # a superscript that says nothing of the number
SPREAD = re.compile(r"[±+\-−]\s*[\d.]")

Macros = dict[str, tuple[int, str]]  # name -> number of arguments, body
Notes = list[tuple[int, str]]  # line, text


def latex_grids(text: str) -> tuple[list[Grid], Notes]:
    """The tables of a LaTeX file in order, and notes on what was not understood."""
    paired = [match.start() for match in re.finditer(rf"%\s*{PAIRED}\b", text)]
    code = COMMENT.sub(_blank, text)
    macros = {match[1]: (int(match[2] or 0), match[3]) for match in MACRO.finditer(code)}
    code = MACRO.sub(_blank, code)
    grids, notes, before = [], [], 0
    for match in TABULAR.finditer(code):
        line = _line(code, match.start())
        if not match[3]:
            notes.append((line, rf"\begin{{{match[1]}}} without \end{{{match[1]}}}"))
        begin = match.start(2)
        for _ in range(1 if match[1] == "tabular" else 2):
            argument = WIDTH_OR_COLUMNS.match(code, begin, match.end(2))
            begin = argument.end() if argument else begin
        rows, ruled = _rows(code, begin, match.end(2), macros, notes)
        if any(len(row) > 1 for row in rows):
            grids.append(Grid(line, rows, ruled, any(before <= place < match.start() for place in paired)))
        before = match.end()
    for match in re.finditer(r"\\(?:input|include)\s*\{[^}]*\}", code):
        notes.append((_line(code, match.start()), f"{match[0]} not followed"))
    return grids, list(dict.fromkeys(notes))


def _blank(match: re.Match[str]) -> str:
    return re.sub(r"[^\n]", " ", match[0])


def _line(code: str, at: int) -> int:
    return code.count("\n", 0, at) + 1


def _rows(code: str, begin: int, end: int, macros: Macros, notes: Notes) -> tuple[list[list[Cell]], list[bool]]:
    """The rows, and whether a full rule stands above each."""
    rows: list[list[Cell]] = []
    ruled = []
    reaching: dict[int, tuple[int, Cell]] = {}  # column -> rows that a \multirow still covers, its cell
    pending = False  # a rule that stands alone belongs to the next row
    for at, stop in _pieces(code, begin, end, ROW_END):
        rules = RULES.match(code, at, stop)
        assert rules is not None
        pending |= FULL_RULE.search(rules[0]) is not None
        if not code[rules.end() : stop].strip():
            continue
        row: list[Cell] = []
        for cell_begin, cell_end in _pieces(code, rules.end(), stop, re.compile("&")):
            source = code[cell_begin:cell_end]
            line = _line(code, cell_begin + len(source) - len(source.lstrip()))
            spans = {match[1]: max(1, int(match[2])) for match in SPAN.finditer(source)}
            unknown: list[str] = []
            cell = read_cell(show(source, macros, unknown), line)
            notes += [(line, note) for note in unknown]
            left, above = reaching.pop(len(row), (0, cell))
            if left > 0 and not cell.text:
                reaching[len(row)] = left - 1, above
                cell = cell if above.shown else above
            elif spans.get("multirow", 1) > 1:
                reaching[len(row)] = spans["multirow"] - 1, cell
            row += [cell] * spans.get("multicolumn", 1)
        rows.append(row)
        ruled.append(pending)
        pending = False
    return rows, ruled


def _pieces(code: str, begin: int, end: int, border: re.Pattern[str]) -> Iterator[tuple[int, int]]:
    """What lies between borders outside groups."""
    depth, start, at = 0, begin, begin
    while at < end:
        if depth <= 0 and (match := border.match(code, at, end)) is not None:
            yield start, at
            start = at = match.end()
            continue
        depth += (code[at] == "{") - (code[at] == "}")
        at += 2 if code[at] == "\\" else 1
    yield start, end


def show(source: str, macros: Macros, notes: list[str], mark: str = "") -> Styled:
    """The characters that a piece of code shows, with their marks. What is not understood is noted."""
    styled: Styled = []
    at = 0

    def argument() -> str:
        """The next one: a group, a command or a character. Optional ones are skipped."""
        nonlocal at
        match = ARGUMENT.match(source, at)
        at = len(source) if match is None else match.end()
        return "" if match is None else match[2] or match[1] or ""

    while (token := TOKEN.match(source, at)) is not None:
        name, escaped, character = token.groups()
        at = token.end()
        sign = ""
        if name in MARKS:
            own = mark if mark == "best" else MARKS[name]
            if name in DECLARATIONS:
                mark = own
            else:
                styled += show(argument(), macros, notes, own)
        elif name in macros:
            count, body = macros[name]
            for k in range(count):
                body = body.replace(f"#{k + 1}", argument())
            # a macro that calls itself would never end
            styled += show(body, {n: macro for n, macro in macros.items() if n != name}, notes, mark)
        elif name in LEFT_OUT:
            for _ in range(LEFT_OUT[name]):
                argument()
        elif name:
            sign = SIGNS.get(name) or html5.get(f"{name};", "")
            notes += [] if sign else [f"\\{name} is not known: its braces are read as text"]
        elif escaped:
            sign = SPACING.get(escaped, escaped)
        elif character in "^_":
            raised = show(argument(), macros, notes, mark)
            text = "".join(c for c, _ in raised).strip()
            styled += [(" ", mark)] if SPREAD.match(text) else []
            styled += [] if FOOTNOTE.fullmatch(text) else raised  # shown if it is a spread, but not a footnote's sign
        elif character == "{" and (group := re.compile(GROUP).match(source, at - 1)) is not None:
            styled += show(group[1], macros, notes, mark)
            at = group.end()
        elif character not in "{}$":
            sign = " " if character in "~\n\t" else character
        styled += [(c, mark) for c in sign]
    return styled
