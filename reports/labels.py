"""What a row of a report is called, and which runs it is made of."""

from __future__ import annotations

from collections.abc import Sequence

from ihbench.results import RunResult


def by_label(runs: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    """Runs by their row's label, in the order given. Seeds and scenes of one configuration share a row."""
    found: dict[str, list[RunResult]] = {}
    for run in runs:
        found.setdefault(label_of(run, runs), []).append(run)
    return found


def label_of(run: RunResult, runs: Sequence[RunResult]) -> str:
    """The method with what sets this row apart. Runs of several versions of its code are several rows."""
    changed = list(run.record["about"]["changed"])
    if run.record["about"].get("provenance") == "predictions":
        changed.append("predictions")
    if len({other.identity["code"] for other in runs if other.method == run.method}) > 1:
        changed.append(f"code {run.identity['code']}")
    return run.method + (f" ({', '.join(changed)})" if changed else "")
