"""Means over the seeds of a scene, before any mean over scenes: every report averages in this order."""

from __future__ import annotations

import math
from collections.abc import Iterable

from ihbench.metrics import Identity, Mean, mean_over_frames
from ihbench.record.results import RunResult, grouped


def seed_means(values: Iterable[tuple[str, float]]) -> dict[str, float]:
    """Scene -> mean of its values; NaN where one is."""
    return {scene: math.fsum(group) / len(group) for scene, group in grouped(values).items()}


def scene_means(runs: Iterable[RunResult], identity: Identity, row: str | None = None) -> dict[str, Mean]:
    """Scene -> mean over its runs (seeds), absent and infinite ones included. `row` names another row of the runs'
    scores than the method's own, such as a calibration row or a group of test views."""
    rows = ((run.scene, run.rows.get(row or run.method, {})) for run in runs)
    scored = grouped((scene, means[identity]) for scene, means in rows if identity in means)
    return {scene: mean_over_frames(means) for scene, means in scored.items()}


def per_scene(runs: Iterable[RunResult], identity: Identity) -> dict[str, float]:
    """The values of `scene_means`; scenes without a finite number are left out."""
    means = scene_means(runs, identity)
    return {scene: mean.value for scene, mean in means.items() if math.isfinite(mean.value)}
