"""What finished runs tell about how long the next one will take."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from ihbench.errors import BadInput
from ihbench.record.store import RunFolder


@dataclass(frozen=True)
class EarlierRuns:
    """Finished runs of one method under one protocol and profile on one processor."""

    count: int
    same_switches: bool  # whether they have the profile's
    same_code: bool  # whether they were made by this code
    seconds: float  # median total
    stages: Mapping[str, float]  # ledger path -> median seconds, over the runs that had the stage


def earlier_runs(runs: Path, method: str, protocol: str, profile: str, cpu: str, code: str) -> EarlierRuns | None:
    """Those under the folder `runs`; None without any. `protocol` is its name with version and changes. Runs with the
    profile's own switches come first, of these those of this code, and where some needed everything, the stages are
    theirs."""
    found = list(_finished(runs, method, protocol, profile, cpu))
    plain = [run for run in found if not run[0].get("changed")]
    chosen = plain or found
    if not chosen:
        return None
    same_code = [run for run in chosen if run[2] == code]
    chosen = [(about, ledger) for about, ledger, _ in same_code or chosen]
    whole = [(about, ledger) for about, ledger in chosen if not _planned_away(about)] or chosen
    stages: dict[str, list[float]] = {}
    for _, ledger in whole:
        for path, stage in ledger["stages"].items():
            stages.setdefault(path, []).append(float(stage["seconds"]))
    seconds = median(float(about["total_seconds"]) for about, _ in chosen)
    medians = {path: median(values) for path, values in stages.items()}
    return EarlierRuns(len(chosen), bool(plain), bool(same_code), seconds, medians)


def _planned_away(about: Mapping[str, Any]) -> bool:
    return any(o["value"] is not None for o in about.get("left_out", ()))


def _finished(
    runs: Path, method: str, protocol: str, profile: str, cpu: str
) -> Iterator[tuple[dict[str, Any], dict[str, Any], str]]:
    """`about`, ledger and code. A damaged record tells nothing about time and is passed over."""
    wanted = (method, protocol, profile, cpu, "done")
    for path in sorted(runs.glob("*/run.json")):
        try:
            run = RunFolder.open(path.parent)
        except BadInput:
            continue
        identity, about, ledger = run.identity, run.record["about"], run.record.get("ledger")
        own = (*(identity[key] for key in ("method", "protocol", "profile")), _cpu(run.record), run.status)
        if own == wanted and ledger is not None and "total_seconds" in about:
            yield about, ledger, identity["code"]


def _cpu(record: Mapping[str, Any]) -> str | None:
    return (record.get("machine") or {}).get("cpu")
