"""What runs painted, and what is claimed of it: identity drift and flicker."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ihbench.clock.events import Inpainted
from ihbench.document.document import Block, Heading, Paragraph, Table, Words
from ihbench.record.results import RunResult


def inpainting_section(labelled: Mapping[str, Sequence[RunResult]]) -> list[Block]:
    """A table over the runs that painted something; nothing without any."""
    import pandas as pd

    rows: list[tuple[Words, ...]] = []
    for label, runs in labelled.items():
        painted = [[event.data for event in run.record.events if event.kind == Inpainted.kind] for run in runs]
        last = [dict(events[-1]) for events in painted if events]  # of several, if a run was resumed
        if not last:
            continue
        numbers = pd.json_normalize(last).apply(pd.to_numeric, errors="coerce")
        means = numbers.replace([math.inf, -math.inf], math.nan).mean().to_dict()
        views, of, pixels = (means.get(name, math.nan) for name in ("views", "of", "pixels"))
        drift = [_with_floor(means, f"identity_drift.{name}", 1) for name in ("delta_e", "texture")]
        flicker = _with_floor(means, "flicker.deviation", 3)
        rows.append((label, str(len(last)), f"{views:.0f} of {of:.0f}", f"{pixels:.0f}", *drift, flicker))
    if not rows:
        return []
    head = ("method", "runs", "views painted", "pixels", "drift ΔE (floor)", "texture (floor)", "flicker (floor)")
    note = (
        "Drift: painted surface against the mean of what other views show of it; flicker: standard deviation of "
        "painted surface over views. Floors: the same for surface that was seen, lighting and resampling alone."
    )
    return [Heading(3, "Inpainting"), Table(head, tuple(rows)), Paragraph(note)]


def _with_floor(means: Mapping[str, float], name: str, digits: int) -> str:
    value, floor = means.get(name, math.nan), means.get(f"{name}_floor", math.nan)
    if math.isnan(value):
        return "absent"
    return f"{value:.{digits}f}" + ("" if math.isnan(floor) else f" ({floor:.{digits}f})")
