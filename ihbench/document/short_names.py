"""Short row names: switches that set a row apart go into a footnote."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from ihbench.document.document import Block, Paragraph, Span, Table

LABEL = re.compile(r"(?P<method>.+?) \((?P<words>.+)\)(?P<rest>(?: on [A-Z]\d*| \[[^\]]*\]| †)*)", re.DOTALL)
NEXT = re.compile(r", (?=[\w.]+=|only |code |predictions|\d+ views )")  # between the words in brackets of a label
LONG = 40  # characters: in Markdown and on pages only longer names are cut


@dataclass
class Footnotes:
    """Letters for texts, in the order in which they are first asked for."""

    letters: dict[str, str] = field(default_factory=dict)

    def letter(self, text: str) -> str:
        return self.letters.setdefault(text, letter(len(self.letters)))

    def of(self, texts: Iterable[str]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(self.letter(text) for text in texts))


def letter(k: int) -> str:
    """a, b, …, z, aa, ab, …"""
    return ("" if k < 26 else letter(k // 26 - 1)) + chr(ord("a") + k % 26)


def split_label(label: str) -> tuple[str, str]:
    """A row's name without its switches, and these; ("ours", "") where there are none. Whatever else stands in the
    brackets, as that views are missing, stays in the name."""
    match = LABEL.fullmatch(label)
    if match is None:
        return label, ""
    words = NEXT.split(match["words"])
    switches, others = [w for w in words if "=" in w], [w for w in words if "=" not in w]
    kept = f" ({', '.join(others)})" if others else ""
    return match["method"] + kept + match["rest"], ", ".join(switches)


def with_short_names(blocks: Sequence[Block], longest: int = 0) -> list[Block]:
    """The same blocks; rows of tables with names longer than `longest` have their switches in a footnote below."""
    notes = Footnotes()
    with_short_names: list[Block] = []
    for block in blocks:
        if not isinstance(block, Table):
            with_short_names.append(block)
            continue
        long_of: dict[str, str] = {}
        rows = []
        for row in block.rows:
            label = row[0]
            name, switches = split_label(label) if isinstance(label, str) and len(label) > longest else ("", "")
            if switches:
                long_of[notes.letter(switches)] = switches
                row = ((name, Span(notes.letter(switches), "raised")), *row[1:])
            rows.append(row)
        with_short_names.append(replace(block, rows=tuple(rows)))
        words: list[str | Span] = []
        for mark, text in long_of.items():
            words += ["; " if words else "", Span(mark, "raised"), f" {text}"]
        with_short_names += [Paragraph(tuple(words))] if words else []
    return with_short_names
