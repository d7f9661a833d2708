"""GitHub's Markdown tables read into grids: what their cells show, and which numbers are marked."""

from __future__ import annotations

import re
from html import unescape

from ihbench.reports.lint.latex_cells import show
from ihbench.reports.lint.table_reading import PAIRED, Grid, GridRow, Style, Styled, blanked, read_cell

RULE = re.compile(r"\s*\|?\s*:?-+:?\s*(\|\s*:?-+:?\s*)*\|?\s*")
FENCE = re.compile(r"\s*(```+|~~~+)")
AROUND = 3  # lines before and after a table that may be its caption
# what is marked how; the earliest match wins, and of two at one place the first here
SPANS: tuple[tuple[re.Pattern[str], Style], ...] = tuple(
    (re.compile(pattern, re.IGNORECASE | re.DOTALL), style)
    for pattern, style in (
        (r"\*\*\*(?=\S)(.+?)(?<=\S)\*\*\*", Style.BEST | Style.ITALIC),
        (r"\*\*(?=\S)(.+?)(?<=\S)\*\*", Style.BEST),
        (r"(?<!\w)__(?=\S)(.+?)(?<=\S)__(?!\w)", Style.BEST),
        (r"<(?:b|strong)\b[^>]*>(.*?)</(?:b|strong)>", Style.BEST),
        (r"<(?:u|ins)\b[^>]*>(.*?)</(?:u|ins)>", Style.SECOND),
        (r"<(?:i|em)\b[^>]*>(.*?)</(?:i|em)>", Style.ITALIC),
        (r"(?<!\*)\*(?=[^\s*])([^*]+?)(?<=\S)\*(?!\*)", Style.ITALIC),
        (r"(?<!\w)_(?=[^\s_])([^_]+?)(?<=\S)_(?!\w)", Style.ITALIC),
        (r"~~(?=\S)(.+?)(?<=\S)~~", Style.PLAIN),
        (r"!?\[([^\]]*)\]\([^)]*\)", Style.PLAIN),
        (r"<sup\b[^>]*>()(?:.*?)</sup>", Style.PLAIN),
        (r"\$([^$]+)\$", Style.PLAIN),
    )
)
MATH = len(SPANS) - 1
DEEPEST = 40  # nested spans
LONGEST = 5000  # characters of a cell whose spans are looked for
MEDALS = {"🥇": Style.BEST, "🥈": Style.SECOND, "🥉": Style.THIRD}
PROTECTED = 0xE000  # private characters stand for escaped ones while emphasis is looked for


def markdown_grids(text: str) -> tuple[list[Grid], list[tuple[int, str]]]:
    """The tables of a Markdown file in order, and notes (line, text) on what was not understood."""
    lines = _visible(text)
    grids: list[Grid] = []
    notes = [(k + 1, "tables in HTML are not read") for k, line in enumerate(lines) if "<table" in line.lower()]
    comments = [k for k, line in enumerate(text.splitlines()) if re.search(rf"<!--\s*{PAIRED}\s*-->", line)]
    k, before = 1, 0
    while k < len(lines):
        head = _split(lines[k - 1])
        if "|" not in lines[k - 1] or not RULE.fullmatch(lines[k]) or len(_split(lines[k])) != len(head):
            k += 1
            continue
        end = k + 1
        while end < len(lines) and "|" in lines[end]:
            end += 1
        rows = [_row(lines[j], j + 1, len(head)) for j in (k - 1, *range(k + 1, end))]
        around = " ".join([*lines[max(0, k - 1 - AROUND) : k - 1], *lines[end : end + AROUND]])
        grids.append(Grid(k, tuple(rows), around, any(before <= c < k for c in comments), heads=1))
        before, k = end, end + 1
    return grids, notes


def _visible(text: str) -> list[str]:
    """Lines, with fenced code and comments emptied."""
    lines, fence = [], ""
    for line in blanked(text, "<!--", "-->").splitlines():
        found = FENCE.match(line)
        if found and (not fence or found[1].startswith(fence)):
            fence = "" if fence else found[1][:3]
            line = ""
        lines.append("" if fence else line)
    return lines


def _split(line: str) -> list[str]:
    """Cells of a line. A pipe after a backslash is text."""
    cells = re.split(r"(?<!\\)(?:\\\\)*\|", line.strip())
    if line.strip().startswith("|"):
        cells = cells[1:]
    return cells[:-1] if cells and not cells[-1].strip() else cells


def _row(line: str, number: int, width: int) -> GridRow:
    cells = _split(line)[:width]
    cells += [""] * (width - len(cells))
    return GridRow(tuple(read_cell(_inline(cell.strip()), number) for cell in cells), number)


def _inline(text: str) -> Styled:
    """Characters with their styles."""
    escaped = re.sub(r"\\([!-/:-@\[-`{-~])", lambda m: chr(PROTECTED + ord(m[1])), text)
    shown = [(character, style) for character, style in _spans(escaped, Style.PLAIN, 0)]
    styled = [(chr(ord(c) - PROTECTED) if 0 <= ord(c) - PROTECTED < 128 else c, style) for c, style in shown]
    medal = next((MEDALS[c] for c, _ in styled if c in MEDALS), Style.PLAIN)
    kept = [(c, style | medal) for c, style in styled if c not in MEDALS and c != "\ufe0f"]
    while kept and kept[0][0].isspace():
        kept.pop(0)
    while kept and kept[-1][0].isspace():
        kept.pop()
    return kept


def _spans(text: str, style: Style, depth: int) -> Styled:
    shown: Styled = []
    while text:
        found = [(m.start(), k, m) for k, (pattern, _) in enumerate(SPANS) if (m := pattern.search(text)) is not None]
        if not found or depth > DEEPEST or len(text) > LONGEST:
            return [*shown, *_bare(text, style)]
        at, k, match = min(found, key=lambda one: one[:2])
        shown += _bare(text[:at], style)
        shown += _math(match[1], style) if k == MATH else _spans(match[1], style | SPANS[k][1], depth + 1)
        text = text[match.end() :]
    return shown


def _bare(text: str, style: Style) -> Styled:
    spaced = re.sub(r"<br\s*/?>", " ", text, flags=re.IGNORECASE)
    plain = unescape(re.sub(r"</?[A-Za-z][^>]*>", "", spaced)).replace("`", "")
    return [(character, style) for character in plain]


def _math(source: str, style: Style) -> Styled:
    """LaTeX between dollars."""
    code = re.sub(f"[{chr(PROTECTED)}-{chr(PROTECTED + 127)}]", lambda m: "\\" + chr(ord(m[0]) - PROTECTED), source)
    return [(character, style | own) for character, own in show(code).styled]
