"""What finished runs tell about how long the next one will take."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ihbench.errors import BadInput
from ihbench.record.schema import RunRecord
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
    found = list(_finished(runs, (method, protocol, profile, cpu)))
    plain = [record for record in found if not record.about.changed]
    chosen = plain or found
    if not chosen:
        return None
    same_code = [record for record in chosen if record.identity.code == code]
    chosen = same_code or chosen
    whole = [record for record in chosen if not _planned_away(record)] or chosen
    stages: dict[str, list[float]] = {}
    for record in whole:
        for path, stage in record.ledger.stages.items() if record.ledger is not None else ():
            stages.setdefault(path, []).append(stage.seconds)
    seconds = median(record.about.total_seconds or 0.0 for record in chosen)
    medians = {path: median(values) for path, values in stages.items()}
    return EarlierRuns(len(chosen), bool(plain), bool(same_code), seconds, medians)


def _planned_away(record: RunRecord) -> bool:
    return any(o.value is not None for o in record.about.left_out or ())


def _finished(runs: Path, wanted: tuple[str, str, str, str]) -> Iterator[RunRecord]:
    """A damaged record tells nothing about time and is passed over."""
    for path in sorted(runs.glob("*/run.json")):
        try:
            record = RunFolder.open(path.parent).record
        except BadInput:
            continue
        own = record.identity.method, record.identity.protocol, record.identity.profile, record.machine.cpu
        known = record.ledger is not None and record.about.total_seconds is not None
        if own == wanted and record.outcome.status == "done" and known:
            yield record
