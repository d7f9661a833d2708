"""Pictures in rows and columns for print: PNG and PDF at the width of a page, and their caption as text.

matplotlib is imported when something is drawn.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 7.0  # in, of two columns of a paper
DPI = 300
LETTERS, SMALL, SMALLEST = 7.0, 5.5, 4.0  # pt
LINE, NOTE, GAP = 0.11, 0.11, 0.03  # in: a line of a head, the line under a panel, between panels
LETTER = 0.56  # mean width of a letter over the font's size
TALLEST = 2.2  # times its width that a panel may be high
PIXEL = 1 / 40  # in that a panel's pixel is drawn wide at most: few pixels make a small figure, not a large blur


@dataclass(frozen=True)
class Panel:
    """One picture, and the line under it."""

    image: NDArray[np.uint8]  # [H, W, 3]
    note: str = ""

    def __post_init__(self) -> None:
        if self.image.dtype != np.uint8 or self.image.ndim != 3 or self.image.shape[2] != 3 or not self.image.size:
            raise ValueError(f"image: expected uint8 [H, W, 3], got {self.image.dtype} {list(self.image.shape)}")


@dataclass(frozen=True)
class PictureSheet:
    """Rows of panels under the columns' heads; an empty place is None.

    Raises `ValueError` without a row, and for rows of another length.
    """

    columns: tuple[str, ...]
    rows: Sequence[tuple[str, Sequence[Panel | None]]]  # the row's head, its panels
    caption: str

    def __post_init__(self) -> None:
        if not self.rows:
            raise ValueError("rows: there is none")
        for head, panels in self.rows:
            if len(panels) != len(self.columns):
                raise ValueError(f"row {head!r}: {len(panels)} panels under {len(self.columns)} heads")

    def files(self) -> dict[str, bytes]:
        """Suffix -> content: .png, .pdf and .txt, the caption. The same pictures give the same bytes."""
        import matplotlib as mpl

        content = {".txt": (self.caption.strip() + "\n").encode()}
        with mpl.rc_context({"font.size": LETTERS, "pdf.fonttype": 42, "svg.hashsalt": "ihbench"}):
            drawn = self._drawn()
            for kind in ("png", "pdf"):
                memory = io.BytesIO()
                undated = {"CreationDate": None} if kind == "pdf" else None
                drawn.savefig(memory, format=kind, dpi=DPI, metadata=undated)
                content[f".{kind}"] = memory.getvalue()
        return content

    def _measured(self, side: float) -> tuple[float, list[float], list[float], list[_Head]]:
        """in: the columns' width beside row heads of `side`; of each row its scale, its height and its head."""
        widest = max((p.image.shape[1] for _, panels in self.rows for p in panels if p is not None), default=1)
        across = len(self.columns)
        width = min((WIDTH - side - GAP * (across - 1)) / across, max(widest * PIXEL, 0.6))
        scales = [_scale(panels, width) for _, panels in self.rows]
        heights = [scale * _tallest(panels) for scale, (_, panels) in zip(scales, self.rows, strict=True)]
        heads = [_heads([head], height)[0] for (head, _), height in zip(self.rows, heights, strict=True)]
        return width, scales, heights, heads

    def _drawn(self) -> Figure:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        across = len(self.columns)
        *_, heads = self._measured(2 * LINE)  # the rows' heads, turned; long ones take more lines
        side = max(head.height for head in heads)
        width, scales, heights, heads = self._measured(side)
        tops = _heads(self.columns, width)
        top = max(head.height for head in tops)
        noted = [NOTE if any(p is not None and p.note for p in panels) else 0.0 for _, panels in self.rows]
        total_width = side + across * width + GAP * (across - 1)
        total_height = top + sum(heights) + sum(noted) + GAP * (len(self.rows) - 1)
        drawn = Figure(figsize=(total_width, total_height), dpi=DPI)
        FigureCanvasAgg(drawn)  # no display, and no global list of figures

        def place(x: float, y: float) -> tuple[float, float]:  # in from the left and from the top
            return x / total_width, 1 - y / total_height

        middle: Any = {"ha": "center", "va": "center"}
        for c, head in enumerate(tops):
            x = side + c * (width + GAP) + width / 2
            drawn.text(*place(x, top / 2), head.text, fontsize=head.size, **middle)
        y = top
        for (_, panels), head, scale, height, note in zip(self.rows, heads, scales, heights, noted, strict=True):
            at = place(side / 2, y + height / 2)
            drawn.text(*at, head.text, rotation=90, fontsize=head.size, **middle)
            for c, panel in enumerate(panels):
                if panel is None:
                    continue
                x = side + c * (width + GAP)
                high, wide = (scale * n for n in panel.image.shape[:2])
                left, bottom = place(x + (width - wide) / 2, y + (height + high) / 2)
                axes = drawn.add_axes((left, bottom, wide / total_width, high / total_height))
                axes.imshow(panel.image, interpolation="none", aspect="equal")  # a PDF keeps the pixels as they are
                axes.axis("off")
                if panel.note:
                    at = place(x + width / 2, y + height + note / 2)
                    drawn.text(*at, _plain(panel.note), fontsize=SMALL, **middle)
            y += height + note + GAP
        return drawn


def _tallest(panels: Sequence[Panel | None]) -> int:
    """px; of a row without a panel 1."""
    return max((panel.image.shape[0] for panel in panels if panel is not None), default=1)


def _scale(panels: Sequence[Panel | None], width: float) -> float:
    """in a pixel of a row, one for all its panels: sizes in a row compare."""
    widest = max((panel.image.shape[1] for panel in panels if panel is not None), default=1)
    return min(width / widest, TALLEST * width / _tallest(panels))


@dataclass(frozen=True)
class _Head:
    """A head of a row or column, in as many lines as it needs."""

    text: str
    size: float  # pt

    @property
    def height(self) -> float:
        """in"""
        return LINE * (self.text.count("\n") + 1.5)


def _heads(texts: Sequence[str], room: float) -> list[_Head]:  # in
    """Heads of one size: large in one line where all of them fit, else small in several, so that no word is broken
    that letters of `SMALLEST` keep whole."""
    letters = room * 72 / LETTER  # of 1 pt
    if all(len(text) * LETTERS <= letters for text in texts):
        return [_Head(_plain(text), LETTERS) for text in texts]
    longest = max((len(word) for text in texts for word in re.split(r"(?<=-)|\s", text)), default=1)
    size = min(SMALL, max(letters / max(longest, 1), SMALLEST))
    return [_Head(_plain(fill(text, max(int(letters / size + 1e-9), 8))), size) for text in texts]


def _plain(text: str) -> str:
    """A dollar sign would begin mathematics."""
    return text.replace("$", r"\$")
