"""The work-precision diagram of the kernels: a panel each, error against the float64 oracle over milliseconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ihbench.clock.machine import Machine
from ihbench.document import diagram
from ihbench.kernels.measuring import Row
from ihbench.record import outputs

COLUMNS = 3
UNITS = {
    "splat": "largest error of colour or alpha",
    "zbuffer": "largest error of depth, m",
    "lbs": "largest distance, m",
    "position-map": "largest distance, m",
    "sampler": "rms over hidden pixels, peak 1",
}
WIDE = 24  # letters; of longer names a legend has one column
EXACT_BELOW = 10.0  # an error of 0 is drawn this many times below the least other error, on a line that says so
NO_OTHER = 1e-16  # what "the least other error" is where there is none


def draw(rows: Sequence[Row], here: Machine, folder: Path) -> Path:
    """Write kernels.png, .svg and .csv into a folder; gives the PNG's path.

    Rows without an error are in the CSV alone. Raises `BadInput` where the folder cannot be written.
    """
    path = folder / "kernels"
    shown = [row for row in rows if row.value_error is not None and math.isfinite(row.value_error)]
    kernels = list(dict.fromkeys(row.kernel for row in shown))
    load = f"load average {here.load_average[0]}" if here.load_average else "load unknown"
    machine = f"{here.cpu}, {here.torch_threads} threads{', ' + here.gpu if here.gpu else ''}, {load}"
    records = [{**asdict(row), "machine": machine} for row in rows]
    columns = min(COLUMNS, max(len(kernels), 1))
    drawn, axes = diagram.figure(columns, max(1, math.ceil(len(kernels) / columns)), width=5.4, height=4.9)
    later = [
        _panel(panel, kernel, [row for row in shown if row.kernel == kernel])
        for panel, kernel in zip(axes, kernels, strict=False)
    ]
    for panel in axes[len(kernels) :]:
        panel.set_axis_off()
    drawn.suptitle(f"Kernels: error against the float64 oracle over milliseconds\n{machine}", fontsize=11)
    for panel, (labels, lines) in zip(axes, later, strict=False):
        diagram.place_labels(panel, labels, lines)
    return outputs.write_files(path, diagram.files(drawn, records))


def _panel(
    panel: Any, kernel: str, rows: Sequence[Row]
) -> tuple[list[diagram.Label], list[list[tuple[float, float]]]]:
    """Draw one kernel: a colour and a mark a case, a line where its rows say that they are one thing with a knob.

    Gives the texts to be placed, and the lines that they must not cover."""
    least = min((row.value_error for row in rows if row.value_error), default=NO_OTHER)
    exact = least / EXACT_BELOW
    labels: list[diagram.Label] = []
    lines: list[list[tuple[float, float]]] = []
    for k, case in enumerate(dict.fromkeys(row.case for row in rows)):
        colour, mark = diagram.COLOURS[k % len(diagram.COLOURS)], diagram.MARKS[k % len(diagram.MARKS)]
        mine = [row for row in rows if row.case == case]
        points = [(row.forward_ms, row.value_error or exact) for row in mine]
        joined = "-" if all(row.knob for row in mine) else ""
        panel.plot(
            *zip(*points, strict=True), color=colour, marker=mark, ms=6, lw=1.2, ls=joined, label=case, zorder=3
        )
        for row, point in zip(mine, points, strict=True):
            half = row.forward_iqr_ms / 2
            ends = [max(point[0] - half, point[0] / 10), point[0] + half]
            panel.plot(ends, [point[1]] * 2, color=colour, lw=3, alpha=0.25, zorder=2)
            labels.append(diagram.Label(point, row.backend + (" (unstable)" if row.unstable else ""), colour))
        lines += [points] if joined else []
    errors = [row.value_error or exact for row in rows]
    diagram.logarithmic(panel, [row.forward_ms for row in rows], [*errors, min(errors) / 2, max(errors) * 2])
    if any(row.value_error == 0 for row in rows):
        panel.axhline(exact, color="#777777", lw=0.8, ls=":", zorder=1)
        at = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom", "color": "#777777"}
        panel.annotate("exact", (1, exact), **at)
    panel.set_title(kernel)
    panel.set_xlabel("milliseconds, forward")
    panel.set_ylabel(UNITS.get(kernel, "error of the value"))
    longest = max(len(row.case) for row in rows)
    panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), frameon=False, ncols=1 if longest > WIDE else 2)
    return labels, lines
