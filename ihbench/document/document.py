"""A report before it is written down: headings, paragraphs, lists, tables and pictures, of plain words.

What a report says is made once; Markdown, LaTeX, HTML, CSV and text for a terminal are ways of writing it (`write`).
Words are never escaped here: each writer does that for its own syntax, and text from elsewhere (names of scenes,
reasons) goes in as it is.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from ihbench.metrics.identity import Metric

WRITERS = {"terminal": "terminal", "md": "markdown", "tex": "latex", "html": "html", "csv": "csv"}  # format -> module
MARKED = {"best": "strong", "second": "underlined"}


@dataclass(frozen=True)
class Span:
    """Some words in another style."""

    text: str
    # raised: a footnote's letter; small: an interval beside its number
    style: Literal["strong", "emphasis", "code", "raised", "underlined", "small"]


Words = str | Span | tuple[str | Span, ...]


@dataclass(frozen=True)
class Number:
    """A number in a table, what it is worth, and what must be said of it."""

    text: str  # as shown, without interval: "24.65", "—"
    value: float = math.nan  # in the column's unit; NaN when absent
    status: str = ""  # reported, quoted, unreliable, measured, stand-in, absent
    interval: str = ""  # as shown: "[23.90, 25.40]"
    low: float = math.nan  # of the interval
    high: float = math.nan
    scenes: int = 0  # that the mean runs over; 0 where it is none
    mark: str = ""  # best, second
    reason: str = ""  # of an absent number
    identity: str = ""  # of a measured number
    footnotes: tuple[str, ...] = ()  # letters

    @property
    def words(self) -> tuple[str | Span, ...]:
        said = [*(["unreliable"] if self.status == "unreliable" else []), *self.footnotes]
        return (
            Span(self.text, MARKED[self.mark]) if self.mark else self.text,  # pyright: ignore[reportArgumentType]
            *((" ", Span(self.interval, "small")) if self.interval else ()),
            *((Span(", ".join(said), "raised"),) if said else ()),
        )


@dataclass(frozen=True)
class Column:
    """The head of a column of one metric, under the name of its group of columns."""

    group: str
    key: str  # "psnr"

    @property
    def metric(self) -> Metric:
        from ihbench.metrics.identity import metric_of

        return metric_of(self.key)

    @property
    def title(self) -> str:
        """Such as "PSNR ↑ (dB)"."""
        return f"{self.metric.title} {self.metric.arrow}{f' ({self.metric.unit})' if self.metric.unit else ''}"

    @property
    def words(self) -> str:
        return f"{self.group} {self.title}"


Cell = Words | Number | Column


@dataclass(frozen=True)
class Heading:
    level: int  # 1: the whole document, 2: a group of runs, 3: a table
    text: str


@dataclass(frozen=True)
class Paragraph:
    words: Words


@dataclass(frozen=True)
class Bullets:
    items: tuple[Words, ...]


@dataclass(frozen=True)
class RowLabel:
    """What a row is, beside its cells."""

    name: str  # whole, without footnotes
    section: str = ""  # rows of one section stand together
    bound: bool = False  # bounds the others, is not ranked among them


@dataclass(frozen=True)
class Table:
    """Rows of as many cells as the head has; first come `left` columns of words, then `ticks` of yes or no, then
    numbers. With a `title` it is a table of its own, which has its `notes` with it."""

    head: tuple[Cell, ...]
    rows: tuple[tuple[Cell, ...], ...]
    left: int = 1
    ticks: int = 0
    bare: bool = False  # pairs of name and content: a terminal shows no head
    labels: tuple[RowLabel, ...] = ()  # of the rows, if known
    title: str = ""
    name: str = ""  # by which text refers to it
    kind: str = ""  # of its numbers, as quoted, real data, stand-in
    paired: bool = False  # its marks come from paired differences
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        wrong = [len(row) for row in self.rows if len(row) != len(self.head)]
        if wrong:
            raise ValueError(f"table: expected rows of {len(self.head)} cells, got one of {wrong[0]}")

    @property
    def groups(self) -> dict[str, int]:
        """Name -> number of columns of the groups of columns."""
        return dict(Counter(column.group for column in self.columns))

    @property
    def columns(self) -> list[Column]:
        return [cell for cell in self.head if isinstance(cell, Column)]

    def begins_section(self, k: int) -> bool:
        return bool(self.labels) and k > 0 and self.labels[k].section != self.labels[k - 1].section

    def numbers(self, k: int) -> list[Number]:
        return [cell for cell in self.rows[k] if isinstance(cell, Number)]


@dataclass(frozen=True)
class Picture:
    """A drawing, with what it shows in words; `png` is an existing file."""

    png: Path
    caption: str


Block = Heading | Paragraph | Bullets | Table | Picture


def write(blocks: Sequence[Block], form: str, folder: Path = Path(".")) -> str:
    """The document in a format of `WRITERS`; `folder` is where it will lie."""
    return import_module(f"ihbench.document.{WRITERS[form]}").write(blocks, folder)


def write_fragment(blocks: Sequence[Block], form: str) -> str:
    """The tables and what must stand below them, without a document around them, in md, tex or html."""
    return import_module(f"ihbench.document.{WRITERS[form]}").fragment(blocks)


def spans(words: Cell) -> tuple[str | Span, ...]:
    """Words as a sequence of plain and styled pieces."""
    shown: Any = words.words if isinstance(words, Number | Column) else words
    return shown if isinstance(shown, tuple) else (shown,)


def plain_text(words: Cell) -> str:
    """Words without their styles."""
    return "".join(piece if isinstance(piece, str) else piece.text for piece in spans(words))


def strong(text: str) -> Span:
    return Span(text, "strong")


def emphasis(text: str) -> Span:
    return Span(text, "emphasis")


def code(text: str) -> Span:
    return Span(text, "code")


def bullets(items: Sequence[Words]) -> list[Block]:
    """A list, or nothing where there are no items."""
    return [Bullets(tuple(items))] if items else []
