"""What runs painted, and what is claimed of it: identity drift and flicker."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from ihbench.clock.events import Inpainted
from ihbench.document.document import Block, Heading, Paragraph, Table, Words
from ihbench.record.results import RunResult
from ihbench.record.scene_means import seed_means

Painted = list[tuple[str, Mapping[str, Any]]]  # scene, what its run says of its painting


def inpainting_section(labelled: Mapping[str, Sequence[RunResult]]) -> list[Block]:
    """A table over the runs that painted something; nothing without any."""
    rows: list[tuple[Words, ...]] = []
    for label, runs in labelled.items():
        events = [(run, [event for event in run.record.events if event.kind == Inpainted.kind]) for run in runs]
        painted: Painted = [(run.scene, of[-1].data) for run, of in events if of]  # of several, if a run was resumed
        if not painted:
            continue
        views, of, pixels = (_mean(painted, name) for name in ("views", "of", "pixels"))
        drift = [_with_floor(painted, f"identity_drift.{name}", 1) for name in ("delta_e", "texture")]
        flicker = _with_floor(painted, "flicker.deviation", 3)
        rows.append(
            (label, f"{len(painted)} of {len(runs)}", f"{views:.0f} of {of:.0f}", f"{pixels:.0f}", *drift, flicker)
        )
    if not rows:
        return []
    head = ("method", "runs", "views painted", "pixels", "drift ΔE (floor)", "texture (floor)", "flicker (floor)")
    note = (
        "Means over the runs that painted something; the others painted nothing. Drift: painted surface against the "
        "mean of what other views show of it; flicker: standard deviation of painted surface over views. Floors: the "
        "same for surface that was seen, lighting and resampling alone, over the same runs; where not all that "
        "painted have a number, the cell says how many do."
    )
    return [Heading(3, "Inpainting"), Table(head, tuple(rows)), Paragraph(note)]


def _with_floor(painted: Painted, name: str, digits: int) -> str:
    """ "3.9 (3.2), 1 of 5 runs": value and floor, both over the runs that have both."""
    floor = f"{name}_floor"
    having = [one for one in painted if math.isfinite(_number(one[1], name))]
    bounded = [one for one in having if math.isfinite(_number(one[1], floor))]
    of = bounded or having
    if not of:
        return "absent"
    shown = f"{_mean(of, name):.{digits}f}" + (f" ({_mean(bounded, floor):.{digits}f})" if bounded else "")
    return shown + (f", {len(of)} of {len(painted)} runs" if len(of) < len(painted) else "")


def _mean(painted: Painted, name: str) -> float:
    """Over the runs of a scene, then over scenes; runs without the number are left out."""
    means = seed_means((s, value) for s, data in painted if math.isfinite(value := _number(data, name)))
    return math.fsum(means.values()) / len(means) if means else math.nan


def _number(data: Mapping[str, Any], name: str) -> float:
    """A number by its dotted name; NaN for what is none."""
    value: Any = data
    for part in name.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) else math.nan
