"""A report before it is written down: headings, paragraphs, lists, tables and pictures, of plain words.

What a report says is made once (`content.py`); Markdown, LaTeX and HTML are three ways of writing it. Words are
never escaped here: each writer does that for its own syntax, and text from elsewhere (names of scenes, reasons) goes
in as it is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Span:
    """Some words in another style."""

    text: str
    style: Literal["strong", "emphasis", "code", "raised"]  # raised: a footnote's letter


Words = str | Span | tuple[str | Span, ...]


@dataclass(frozen=True)
class Heading:
    level: int  # 2: a group of runs, 3: a table
    text: str


@dataclass(frozen=True)
class Paragraph:
    words: Words


@dataclass(frozen=True)
class Bullets:
    items: tuple[Words, ...]


@dataclass(frozen=True)
class Table:
    """Rows of as many cells as the head has; the first `left` columns are words, the others numbers."""

    head: tuple[Words, ...]
    rows: tuple[tuple[Words, ...], ...]
    left: int = 1

    def __post_init__(self) -> None:
        wrong = [len(row) for row in self.rows if len(row) != len(self.head)]
        if wrong:
            raise ValueError(f"table: expected rows of {len(self.head)} cells, got one of {wrong[0]}")


@dataclass(frozen=True)
class Picture:
    """A drawing, with what it shows in words; `png` is an existing file."""

    png: Path
    caption: str


Block = Heading | Paragraph | Bullets | Table | Picture


def spans(words: Words) -> tuple[str | Span, ...]:
    """Words as a sequence of plain and styled pieces."""
    return words if isinstance(words, tuple) else (words,)


def strong(text: str) -> Span:
    return Span(text, "strong")


def emphasis(text: str) -> Span:
    return Span(text, "emphasis")


def code(text: str) -> Span:
    return Span(text, "code")


def bullets(items: list[Words]) -> list[Block]:
    """A list, or nothing where there are no items."""
    return [Bullets(tuple(items))] if items else []
