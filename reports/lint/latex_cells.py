r"""What a piece of LaTeX shows, without TeX: its characters, which of them are bold or underlined, and its colours.

A command that is not known is read as if it were not there, its braces as text, and noted.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from ihbench.reports.lint.table_reading import Style, Styled

DEEPEST = 60  # nested groups and macros
LONGEST = 20_000  # characters of a cell, its macros replaced
MOST = 500  # groups and macros of a cell: one macro can call itself twice

# macros of other files, by what papers call them
_NAMED = r"(?:tab|table|rank|cell|mark|res)?(?:{})(?:best|result|res|cell|val|num|bf)?"
NAMED = tuple(
    (re.compile(_NAMED.format(names), re.IGNORECASE), style)
    for names, style in (
        ("second|scnd|snd|sec|sbest|silver|runnerup|ranktwo|toptwo", Style.SECOND),
        ("third|thrd|trd|bronze|rankthree|topthree", Style.THIRD),
        ("best|bst|first|fst|frst|gold|winner|rankone|topone", Style.BEST),
    )
)
BOLD = {"textbf", "mathbf", "bm", "boldsymbol", "pmb", "bf", "bfseries", "boldmath"}
UNDERLINED = {"underline", "uline", "ul", "underbar"}
ITALIC = {"textit", "emph", "mathit", "it", "itshape", "em", "textsl", "slshape"}
DECLARATIONS = {"bf", "bfseries", "boldmath", "it", "itshape", "em", "slshape"}  # up to the end of the group
COLOURS = {"cellcolor": "cell", "colorbox": "cell", "textcolor": "text", "color": "text"}
TRANSPARENT = {
    "textrm", "textsf", "texttt", "textsc", "textup", "textmd", "textnormal", "textsubscript", "mathrm", "mathsf",
    "mathtt", "mathcal", "rm", "sf", "tt", "sc", "text", "mbox", "hbox", "makecell", "thead", "shortstack", "num",
    "ensuremath", "smash", "operatorname", "tiny", "scriptsize", "footnotesize", "small", "normalsize", "large",
    "normalfont", "selectfont", "centering", "raggedright", "raggedleft", "relax", "protect", "displaystyle",
    "textstyle", "left", "right", "big", "Big", "hfill", "hfil", "null", "leavevmode", "noindent", "unskip",
    "ignorespaces", "strut", "xspace", "limits",
}  # fmt: skip
# commands whose arguments are not shown: how many there are
DROPPED = {
    "footnotemark": 0, "kern": 0, "cite": 1, "citep": 1, "citet": 1, "citealp": 1, "citeauthor": 1, "citeyear": 1,
    "ref": 1, "eqref": 1, "cref": 1, "Cref": 1, "autoref": 1, "label": 1, "footnote": 1, "footnotetext": 1,
    "tablefootnote": 1, "tnote": 1, "textsuperscript": 1, "vspace": 1, "hspace": 1, "phantom": 1, "hphantom": 1,
    "vphantom": 1, "rowcolor": 1, "columncolor": 1, "arrayrulecolor": 1, "includegraphics": 1, "rowfont": 1,
    "SetCell": 1, "SetRow": 1, "index": 1, "rule": 2, "setlength": 2, "addtolength": 2, "fontsize": 2,
}  # fmt: skip
# commands of whose arguments only the last is shown: how many stand before it
LAST_SHOWN = {
    "makebox": 0, "framebox": 0, "fbox": 0, "SI": 0, "qty": 0, "rotatebox": 1, "scalebox": 1, "raisebox": 1,
    "parbox": 1, "href": 1, "adjustbox": 1, "hyperlink": 1, "multirowcell": 1, "resizebox": 2, "multirow": 2,
    "multicolumn": 2, "fcolorbox": 2,
}  # fmt: skip
SYMBOLS = {
    "uparrow": "↑", "downarrow": "↓", "Uparrow": "⇑", "Downarrow": "⇓", "textuparrow": "↑", "textdownarrow": "↓",
    "pm": "±", "textpm": "±", "times": "×", "texttimes": "×", "cdot": "·", "sim": "~", "approx": "≈", "infty": "∞",
    "leq": "≤", "le": "≤", "geq": "≥", "ge": "≥", "dagger": "†", "dag": "†", "ddagger": "‡", "ddag": "‡",
    "textdagger": "†", "ast": "*", "star": "*", "textasteriskcentered": "*", "checkmark": "✓", "cmark": "✓",
    "surd": "✓", "xmark": "✗", "textendash": "–", "textemdash": "—", "ldots": "…", "dots": "…", "cdots": "…",
    "rightarrow": "→", "to": "→", "leftarrow": "←", "quad": " ", "qquad": " ", "newline": " ", "degree": "°",
    "circ": "°", "S": "§", "textbackslash": "\\", "textless": "<", "textgreater": ">", "textbar": "|",
    "textasciitilde": "~", "mid": "|", "alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "Delta": "Δ",
    "lambda": "λ", "mu": "μ", "sigma": "σ", "theta": "θ", "epsilon": "ε", "textmu": "µ", "textperiodcentered": "·",
}  # fmt: skip
SPACING = {**dict.fromkeys(",;: \n\\", " "), **dict.fromkeys("!/-()[]@", "")}  # after a backslash
FOOTNOTE = re.compile(r"[*†‡§¶∗°\s\d]*|[a-z](\s*,\s*[a-z])*")  # a superscript that says nothing of the number
SPREAD = re.compile(r"[±+\-−]\s*[\d.]")

Macros = dict[str, tuple[int, str]]  # name -> number of arguments, body


@dataclass
class Shown:
    """What a piece of code shows."""

    styled: Styled = field(default_factory=list)
    colours: list[str] = field(default_factory=list)  # "cell:red!25", "text:blue"
    notes: list[str] = field(default_factory=list)  # what was not understood

    def add(self, text: str, style: Style) -> None:
        self.styled += [(character, style) for character in text]


def show(source: str, macros: Macros | None = None) -> Shown:
    """What a cell shows, with the file's own macros replaced."""
    shown = Shown()
    _Showing(macros or {}, shown).show(source, Style.PLAIN, 0)
    return shown


def closing(code: str, at: int, left: str = "{", right: str = "}") -> int | None:
    """Where the group that opens at `at` closes; None when it does not."""
    depth, k = 0, at
    while k < len(code):
        c = code[k]
        if c == "\\":
            k += 2
            continue
        depth += (c == left) - (c == right)
        if depth == 0:
            return k
        k += 1
    return None


def after_optional(source: str, at: int) -> int:
    """Behind [..] if one comes next."""
    found = re.compile(r"\s*\[").match(source, at)
    close = None if found is None else closing(source, found.end() - 1, "[", "]")
    return at if close is None else close + 1


def argument(source: str, at: int) -> tuple[int, str]:
    """Behind the next argument, and the argument: a group, a command or a character. Optional ones are skipped."""
    at = after_optional(source, at)
    while at < len(source) and source[at].isspace():
        at += 1
    if at >= len(source):
        return at, ""
    if source[at] == "{":
        close = closing(source, at)
        return (len(source), source[at + 1 :]) if close is None else (close + 1, source[at + 1 : close])
    found = re.compile(r"\\(?:[A-Za-z]+|.)|.", re.DOTALL).match(source, at)
    return (at + 1, source[at]) if found is None else (found.end(), found[0])


def style_of(name: str) -> Style:
    """The mark that a command sets, by its name."""
    for names, style in ((BOLD, Style.BEST), (UNDERLINED, Style.SECOND), (ITALIC, Style.ITALIC)):
        if name in names:
            return style
    return next((style for pattern, style in NAMED if pattern.fullmatch(name)), Style.PLAIN)


@dataclass
class _Showing:
    macros: Macros
    shown: Shown
    left: list[int] = field(default_factory=lambda: [MOST])  # of the budget, shared with what is inside

    def show(self, source: str, style: Style, depth: int) -> None:
        self.left[0] -= 1
        if depth > DEEPEST or self.left[0] < 0 or len(self.shown.styled) > LONGEST:
            note = "nested too deeply, or too long: the rest of the cell is left out"
            self.shown.notes += [note] if note not in self.shown.notes else []
            return
        k = 0
        while k < len(source):
            c = source[k]
            if c == "\\":
                k, style = self._command(source, k, style, depth)
            elif c == "{":
                close = closing(source, k)
                close = len(source) if close is None else close
                self.show(source[k + 1 : close], style, depth + 1)
                k = close + 1
            elif c in "^_":
                k = self._script(source, k, style, depth)
            else:
                if c not in "}$":
                    self.shown.add(" " if c in "~\n\t" else c, style)
                k += 1

    def _script(self, source: str, k: int, style: Style, depth: int) -> int:
        """A superscript or subscript: shown if it is a spread or a power, left out if it is a footnote's sign."""
        at, inside = argument(source, k + 1)
        inner = _Showing(self.macros, Shown(), self.left)
        inner.show(inside, style, depth + 1)
        styled = inner.shown.styled
        text = "".join(character for character, _ in styled).strip()
        power = re.fullmatch(r"[-−]?\d+", text) and self.shown.styled[-2:] and self._ends_with("10")
        if SPREAD.match(text) and not power:
            self.shown.add(" ", style)
            self.shown.styled += styled
        elif power or not FOOTNOTE.fullmatch(text):
            self.shown.styled += styled
        return at

    def _ends_with(self, text: str) -> bool:
        return "".join(c for c, _ in self.shown.styled[-len(text) :]) == text

    def _command(self, source: str, k: int, style: Style, depth: int) -> tuple[int, Style]:
        """Show the command at `k`; behind it, and the style from there on."""
        found = re.compile(r"\\([A-Za-z]+)\*?\s?").match(source, k)
        if found is None:  # \%, \&, \,
            c = source[k + 1 : k + 2]
            self.shown.add(SPACING.get(c, c), style)
            return k + 2, style
        name, at = found[1], found.end()
        own = style_of(name)
        if name in self.macros:
            at = self._expand(source, name, at, style | own, depth)
            return at, (style if self.macros[name][0] else style | own)  # \best 24.65: up to the end of the group
        if name in DECLARATIONS:
            return at, style | own
        if name in SYMBOLS:
            self.shown.add(SYMBOLS[name], style)
            return at, style
        if name in COLOURS:
            at, colour = argument(source, at)
            self.shown.colours.append(f"{COLOURS[name]}:{colour.lower()}")
            return at, style  # what \textcolor and \colorbox show comes next, in braces
        if name in DROPPED or name in LAST_SHOWN:
            for _ in range({**DROPPED, **LAST_SHOWN}[name]):
                at = argument(source, at)[0]
            return after_optional(source, at), style
        if name in ("diagbox", "slashbox", "backslashbox"):
            at, first = argument(source, at)
            self.show(first + " / ", style, depth + 1)
            return at, style
        if name in ("begin", "end"):  # of a tabular inside the cell: its rows are the cell's lines
            at, environment = argument(source, at)
            return (argument(source, at)[0] if name == "begin" and environment.startswith("tabular") else at), style
        if own != Style.PLAIN:
            at, inside = argument(source, at)
            self.show(inside, style | own, depth + 1)
            return at, style
        if name not in TRANSPARENT:
            self.shown.notes.append(f"\\{name} is not known: its braces are read as text")
        return after_optional(source, at), style

    def _expand(self, source: str, name: str, at: int, style: Style, depth: int) -> int:
        count, body = self.macros[name]
        for k in range(count):
            at, inside = argument(source, at)
            body = body.replace(f"#{k + 1}", inside)
            if len(body) > LONGEST:
                self.shown.notes.append(f"\\{name} grows too long: left out")
                return at
        self.show(body, style, depth + 1)
        return at
