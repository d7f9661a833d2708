"""What runs painted, and what is claimed of it: identity drift and flicker."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from ihbench.clock.events import Inpainted
from ihbench.document.document import Block, Heading, Paragraph, Table, Words, bullets
from ihbench.files.shape import Within, fault, from_json
from ihbench.record.results import RunResult

Measured = Annotated[float, Within(nan=True, infinite=True)] | None


@dataclass(frozen=True)
class Drift:
    delta_e: Measured
    delta_e_floor: Measured
    texture: Measured
    texture_floor: Measured


@dataclass(frozen=True)
class Flicker:
    deviation: Measured
    deviation_floor: Measured


@dataclass(frozen=True)
class Painted:
    """What the event of a run that painted says."""

    views: Measured
    of: Measured
    pixels: Measured
    identity_drift: Drift
    flicker: Flicker


def inpainting_section(labelled: Mapping[str, Sequence[RunResult]]) -> list[Block]:
    """A table over the runs that painted something; nothing without any."""
    painted = {label: [e for run in runs for e in _painted(run)] for label, runs in labelled.items()}
    events_of: dict[str, list[Painted]] = {
        label: [from_json(e, Painted) for e in events if not fault(e, Painted)] for label, events in painted.items()
    }
    notes: list[Words] = [
        f"not in the means of {label}: {len(events) - len(events_of[label])} whose record of it is damaged"
        for label, events in painted.items()
        if len(events) > len(events_of[label])
    ]
    events_of = {label: events for label, events in events_of.items() if events}
    if not events_of:
        return [Heading(3, "Inpainting"), *bullets(notes)] if notes else []
    rows: list[tuple[Words, ...]] = []
    for label, events in events_of.items():
        drifts, flickers = [event.identity_drift for event in events], [event.flicker for event in events]
        cells = [
            str(len(events)),
            f"{_mean(e.views for e in events):.0f} of {_mean(e.of for e in events):.0f}",
            f"{_mean(e.pixels for e in events):.0f}",
            _pair((d.delta_e for d in drifts), (d.delta_e_floor for d in drifts), 1),
            _pair((d.texture for d in drifts), (d.texture_floor for d in drifts), 1),
            _pair((f.deviation for f in flickers), (f.deviation_floor for f in flickers), 3),
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


def _painted(run: RunResult) -> list[Mapping[str, Any]]:
    events = [event.data for event in run.record.events if event.kind == Inpainted.kind]
    return events[-1:]  # the last, if a run was resumed


def _mean(values: Iterable[Measured]) -> float:
    """The mean of the finite values; NaN without any."""
    known = [value for value in values if value is not None and math.isfinite(value)]
    return math.fsum(known) / len(known) if known else math.nan


def _pair(values: Iterable[Measured], floors: Iterable[Measured], digits: int) -> str:
    value, below = _mean(values), _mean(floors)
    if math.isnan(value):
        return "absent"
    return f"{value:.{digits}f} ({below:.{digits}f})" if math.isfinite(below) else f"{value:.{digits}f}"
