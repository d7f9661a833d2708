"""What runs painted, and what is claimed of it: identity drift and flicker."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, TypedDict

from ihbench.clock.events import Inpainted
from ihbench.document.document import Block, Heading, Paragraph, Table, Words, bullets
from ihbench.record.results import RunResult
from ihbench.record.shape import Within, fault

Measured = Annotated[float, Within(nan=True, infinite=True)] | None


class Drift(TypedDict):
    delta_e: Measured
    delta_e_floor: Measured
    texture: Measured
    texture_floor: Measured


class Flicker(TypedDict):
    deviation: Measured
    deviation_floor: Measured


class Painted(TypedDict):
    """What the event of a run that painted says."""

    views: Measured
    of: Measured
    pixels: Measured
    identity_drift: Drift
    flicker: Flicker


def inpainting_section(labelled: Mapping[str, Sequence[RunResult]]) -> list[Block]:
    """A table over the runs that painted something; nothing without any."""
    painted = {label: [e for run in runs for e in _painted(run)] for label, runs in labelled.items()}
    found = {label: [e for e in events if not fault(e, Painted)] for label, events in painted.items()}
    notes: list[Words] = [
        f"not in the means of {label}: {len(events) - len(found[label])} whose record of it is damaged"
        for label, events in painted.items()
        if len(events) > len(found[label])
    ]
    found = {label: events for label, events in found.items() if events}
    if not found:
        return [Heading(3, "Inpainting"), *bullets(notes)] if notes else []
    rows: list[tuple[Words, ...]] = []
    for label, events in found.items():
        drifts = [event["identity_drift"] for event in events]
        flickers = [event["flicker"] for event in events]
        cells = [
            str(len(events)),
            f"{_mean(events, 'views'):.0f} of {_mean(events, 'of'):.0f}",
            f"{_mean(events, 'pixels'):.0f}",
            _pair(drifts, "delta_e", "delta_e_floor", 1),
            _pair(drifts, "texture", "texture_floor", 1),
            _pair(flickers, "deviation", "deviation_floor", 3),
        ]
        rows.append((label, *cells))
    head = ("method", "runs", "views painted", "pixels", "drift ΔE (floor)", "texture (floor)", "flicker (floor)")
    return [
        Heading(3, "Inpainting"),
        Table(head, tuple(rows)),
        Paragraph(
            "Drift: painted surface against the mean of what other views show of it; flicker: standard deviation of "
            "painted surface over views. Floors: the same for surface that was seen, lighting and resampling alone."
        ),
        *bullets(notes),
    ]


def _painted(run: RunResult) -> list[dict[str, Any]]:
    events = (run.record.get("ledger") or {}).get("events", [])
    painted = [event["data"] for event in events if event["kind"] == Inpainted.kind]
    return painted[-1:]  # the last, if a run was resumed


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float:
    """The mean of the finite values; NaN without any."""
    values = [float(row[name]) for row in rows if row[name] is not None and math.isfinite(float(row[name]))]
    return math.fsum(values) / len(values) if values else math.nan


def _pair(rows: Sequence[Mapping[str, Any]], name: str, floor: str, digits: int) -> str:
    value, below = _mean(rows, name), _mean(rows, floor)
    if math.isnan(value):
        return "absent"
    return f"{value:.{digits}f} ({below:.{digits}f})" if math.isfinite(below) else f"{value:.{digits}f}"
