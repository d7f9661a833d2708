"""Work-precision diagrams: both axes logarithmic, colours and marks that the colour-blind tell apart, labels that
keep out of each other's way, and the numbers beside the picture. matplotlib is imported when something is drawn.

A diagram is written three times under one name: `.png` to look at, `.svg` to print, `.csv` with what it shows.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ihbench.document.csv import write_rows
from ihbench.errors import visible

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

# Okabe and Ito, "Color universal design", 2008; yellow is left out, it cannot be seen on white
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES = ("-", "--", ":", "-.")
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", ">")
STYLE: Any = {  # as matplotlib names them
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.labelsize": 10,
    "legend.fontsize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "svg.fonttype": "none",  # text stays text
    "svg.hashsalt": "ihbench",  # the same picture is the same file
}
DPI = 150
TICKS_1 = (1, 2, 3, 4, 5, 6, 7, 8, 9)
APART = 7.0  # px between a label and a point
PLACES = (  # of a label around its point: distances and widths to the right, distances and heights up
    (1, 0, 0, -0.5), (-1, -1, 0, -0.5), (0, -0.5, 1, 0), (0, -0.5, -1, -1),
    (0.7, 0, 0.7, 0), (0.7, 0, -0.7, -1), (-0.7, -1, 0.7, 0), (-0.7, -1, -0.7, -1),
)  # fmt: skip
LETTER = 0.6  # mean width of a letter over the font's size


def figure(columns: int = 1, rows: int = 1, width: float = 4.6, height: float = 3.9) -> tuple[Figure, list[Axes]]:
    """An empty figure with a grid of axes, row by row; sizes of one panel in inches."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):
        drawn = Figure(figsize=(columns * width, rows * height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(drawn)  # no display, and no global list of figures
        axes = drawn.subplots(rows, columns, squeeze=False)
    return drawn, [axis for row in axes for axis in row]


def files(drawn: Figure, rows: Sequence[Mapping[str, Any]]) -> dict[str, bytes]:
    """Suffix -> content of the picture (.png, .svg) and of the numbers in it (.csv)."""
    import matplotlib as mpl

    content: dict[str, bytes] = {}
    with mpl.rc_context(STYLE):
        settle(drawn)
        for kind in ("png", "svg"):
            memory = io.BytesIO()
            # an SVG would carry the date, and never be the same file twice
            drawn.savefig(memory, format=kind, dpi=DPI, metadata={"Date": None} if kind == "svg" else None)
            content[f".{kind}"] = memory.getvalue()
    return content | {".csv": write_rows(rows).encode()}


def words(text: str) -> str:
    """Text that matplotlib draws as it is: no mathematics between dollars, no leading _ that hides a legend entry."""
    return f"{' ' * text.startswith('_')}{visible(text, keep=chr(10))}".replace("$", r"\$")


def settle(drawn: Figure) -> None:
    """Lay the figure out once and for all; what is added afterwards moves nothing."""
    engine = drawn.get_layout_engine()
    if engine is not None:
        engine.execute(drawn)
        drawn.set_layout_engine("none")


def logarithmic(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Logarithmic axes around these positive numbers, with ticks at round numbers, few enough to be read."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    _ticks(axes.xaxis, x, axes.set_xlim)
    _ticks(axes.yaxis, y, axes.set_ylim)


def _ticks(axis: Axis, values: Sequence[float], limit: Any) -> None:
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator

    known = [v for v in values if math.isfinite(v) and v > 0]
    low, high = (min(known), max(known)) if known else (1.0, 10.0)
    margin = max((high / low) ** 0.08, 1.08)
    low, high = low / margin, high * margin
    limit(low, high)
    axis.set_major_locator(FixedLocator(round_ticks(low, high)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(value)))
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    minor = [m * 10.0**d for d in decades for m in TICKS_1 if low <= m * 10.0**d <= high]
    axis.set_minor_locator(FixedLocator(minor) if len(minor) < 30 else NullLocator())
    axis.set_minor_formatter(NullFormatter())


def round_ticks(low: float, high: float, most: int = 7) -> list[float]:
    """Round numbers in [low, high] for a logarithmic axis, from the finest ladder that has at most `most` of them.

    Every ladder repeats over the decades or skips some; a range that holds less than two round numbers has its ends,
    rounded to two digits.
    """
    ladders: list[list[float]] = [
        [m / 10 for m in range(10, 100)],
        [1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 9.0],
        [1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0],
        [1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0],
        [1.0, 2.0, 3.0, 5.0],
        [1.0, 2.0, 5.0],
        [1.0, 3.0],
        [1.0],
    ]
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    for ladder, skip in [*((ladder, 1) for ladder in ladders), *(([1.0], skip) for skip in range(2, 40))]:
        ticks = [float(f"{m * 10.0**d:.3g}") for d in decades if d % skip == 0 for m in ladder]
        ticks = [t for t in ticks if low <= t <= high]
        if 2 <= len(ticks) <= most:
            return ticks
    return sorted({float(f"{low:.2g}"), float(f"{high:.2g}")})


def tick_text(value: float) -> str:
    """A tick's number: plain from 0.001 to 99999, a power of ten beyond."""
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:g}"
    exponent = math.floor(math.log10(abs(value)) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10$^{{{exponent}}}$"
    return power if abs(mantissa - 1) < 1e-6 else f"{mantissa:g}·{power}"


@dataclass(frozen=True)
class Label:
    """A text that belongs beside a point."""

    point: tuple[float, float]  # in data coordinates
    text: str  # "" only keeps others off the point
    colour: str = "#333333"


def place_labels(
    axes: Axes, labels: Sequence[Label], lines: Sequence[Sequence[tuple[float, float]]] = (), size: float = 9.0
) -> None:
    """Write each text beside its point, where it covers no point, no line through these points and no other text; a
    thin line leads to it where it had to go further away. What finds no room is in the CSV alone."""
    drawn: Any = axes.figure
    settle(drawn)  # only now is it known where points lie in pixels
    scale = drawn.dpi / 72
    frame = axes.get_window_extent()
    spots = [tuple(axes.transData.transform(label.point)) for label in labels]
    # boxes that are taken, [n, 4] as left, bottom, right, top in px
    taken = [np.array([[x - APART, y - APART, x + APART, y + APART] for x, y in spots]).reshape(-1, 4)]
    for line in lines:
        pixels = axes.transData.transform(np.array(line, np.float64).reshape(-1, 2))
        for start, end in itertools.pairwise(pixels):
            count = max(1, int(np.hypot(*(end - start)) / APART))
            along = np.linspace(start, end, count + 1)
            taken.append(np.concatenate([along - 2, along + 2], 1))
    boxes = np.concatenate(taken)
    for (x, y), label in zip(spots, labels, strict=True):
        if not label.text:
            continue
        width, height = LETTER * size * scale * len(label.text) + 3, 1.1 * size * scale
        # lower left corners relative to the point in px, nearest first, and whether a line must lead there
        offsets = [
            (x * far + across * width, y * far + up * height, far > 18.0)
            for far in (9.0, 18.0, 30.0, 45.0, 64.0)
            for x, across, y, up in PLACES
        ]
        corner = np.array([(x + dx, y + dy) for dx, dy, _ in offsets])
        candidates = np.concatenate([corner, corner + np.array([width, height])], 1)  # [offsets, 4]
        free = (candidates[:, 0] >= frame.x0) & (candidates[:, 1] >= frame.y0)
        free &= (candidates[:, 2] <= frame.x1) & (candidates[:, 3] <= frame.y1)
        apart = (candidates[:, None, :2] >= boxes[None, :, 2:]) | (candidates[:, None, 2:] <= boxes[None, :, :2])
        free &= apart.any(-1).all(-1)
        if not free.any():
            continue
        k = int(free.argmax())
        dx, dy, leader = offsets[k]
        boxes = np.concatenate([boxes, candidates[k : k + 1]])
        axes.annotate(
            words(label.text), label.point, xytext=(dx / scale, dy / scale), textcoords="offset points",
            fontsize=size, color=label.colour, zorder=5,
            arrowprops={"arrowstyle": "-", "color": "#999999", "lw": 0.6} if leader else None,
        )  # fmt: skip
