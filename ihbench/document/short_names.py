"""Short row names: switches that set a row apart go into a footnote."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from ihbench.document.document import Block, Paragraph, Span, Table

LABEL = re.compile(r"(?P<method>.+?) \((?P<words>.+)\)(?P<rest>(?: on [A-Z]\d*| \[[^\]]*\])*)", re.DOTALL)
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
    found = LABEL.fullmatch(label)
    if found is None:
        return label, ""
    words = NEXT.split(found["words"])
    switches, others = [w for w in words if "=" in w], [w for w in words if "=" not in w]
    kept = f" ({', '.join(others)})" if others else ""
    return found["method"] + kept + found["rest"], ", ".join(switches)


def with_short_names(blocks: Sequence[Block], longest: int = 0) -> list[Block]:
    """The same blocks; rows of tables with names longer than `longest` have their switches in a footnote below."""
    notes = Footnotes()
    found: list[Block] = []
    for block in blocks:
        if not isinstance(block, Table):
            found.append(block)
            continue
        told: dict[str, str] = {}
        rows = []
        for row in block.rows:
            label = row[0]
            name, switches = split_label(label) if isinstance(label, str) and len(label) > longest else ("", "")
            if switches:
                told[notes.letter(switches)] = switches
                row = ((name, Span(notes.letter(switches), "raised")), *row[1:])
            rows.append(row)
        found.append(replace(block, rows=tuple(rows)))
        words: list[str | Span] = []
        for mark, text in told.items():
            words += ["; " if words else "", Span(mark, "raised"), f" {text}"]
        found += [Paragraph(tuple(words))] if words else []
    return found
