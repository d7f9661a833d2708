"""What a row of a report is called, and which runs it is made of."""

from __future__ import annotations

from collections.abc import Sequence

from ihbench.record.results import RunResult, grouped


def by_label(runs: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    """Runs by their row's label, in the order given. Seeds and scenes of one configuration share a row."""
    return {_with_views(label, row): row for label, row in by_configuration(runs).items()}


def by_configuration(runs: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    """Runs by the label alone, without what is told beside it: that views are missing."""
    codes = grouped((run.method, run.identity.code) for run in runs)
    return grouped((_label(run, several_codes=len({*codes[run.method]}) > 1), run) for run in runs)


def _with_views(label: str, runs: Sequence[RunResult]) -> str:
    """A row whose means do not run over all test views says so: files of some predictions were missing."""
    missing = sum(run.missing_views for run in runs)
    if not missing:
        return label
    views = sum(run.about.predictions.views for run in runs if run.about.predictions is not None)
    note = f"only {views - missing} of {views} views" if views else f"{missing} views missing"
    return f"{label[:-1]}, {note})" if label.endswith(")") else f"{label} ({note})"


def _label(run: RunResult, several_codes: bool) -> str:
    """The method with what sets this row apart, or the name that somebody gave the row. Runs of several versions of
    its code are several rows."""
    if run.about.label is not None:
        return run.about.label
    changed = run.about.differences
    if run.about.predictions is not None:
        changed.append("predictions")
    if several_codes:
        changed.append(f"code {run.identity.code}")
    return run.method + (f" ({', '.join(changed)})" if changed else "")
