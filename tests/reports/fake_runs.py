"""Finished runs that nobody ran, with numbers a test chooses. In memory, or as run folders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ihbench.clock.events import Event, Happening
from ihbench.clock.ledger import LedgerState
from ihbench.clock.machine import Machine
from ihbench.config_fields import as_json
from ihbench.files import atomic
from ihbench.metrics import Identity, Mean
from ihbench.record.provenance import Provenance
from ihbench.record.results import RunResult
from ihbench.record.schema import About, Outcome, RunIdentity, RunRecord, ScoreLine, Status
from ihbench.record.store import RunFolder

PSNR, SSIM, LPIPS = "psnr/pooled/range1/{}/v1", "ssim/gauss11-1.5/range1/{}/v1", "lpips/vgg0.1/range-1,1/{}/v1"
STANDIN = "stand-in v1 seed 0"
SUBJECTS = ("a", "b", "c", "d")
UNKNOWN_MACHINE = Machine()


def identity(scene: str, method: str, **changes: Any) -> RunIdentity:
    fields: dict[str, Any] = {
        "protocol": "zju_occ@1", "protocol_digest": "abc", "dataset": "zju_mocap", "scene": scene, "data": STANDIN,
        "method": method, "config": {}, "profile": "quick", "seed": 0, "body": "0", "code": "1+0",
    }  # fmt: skip
    return RunIdentity(**fields | changes)


def about(**changes: Any) -> About:
    subjects = {"names": list(SUBJECTS), "standin": list(SUBJECTS)}
    fields: dict[str, Any] = {
        "standin": STANDIN, "variant": "original", "headline": "body", "changed": {}, "left_out": (),
        "fit_seconds": 10.0, "total_seconds": 20.0, "peak_mb": 100.0, "protocol": {"subjects": subjects},
    }  # fmt: skip
    return About(**fields | changes)


def record(
    named: RunIdentity, said: About, status: Status = "done", reason: str = "", machine: Machine = UNKNOWN_MACHINE
) -> RunRecord:
    outcome = Outcome(status, reason, created="2025-01-01T00:00:00+00:00")
    return RunRecord(named.digest, outcome, named, said, machine, Provenance())


def with_about(run: RunResult, **changes: Any) -> RunResult:
    return replace(run, record=replace(run.record, about=replace(run.about, **changes)))


def with_events(run: RunResult, *happenings: Happening) -> RunResult:
    """The run with a ledger in which these things happened, and nothing else."""
    events = tuple(Event.at(happening, 1.0, 1.0) for happening in happenings)
    return replace(run, record=replace(run.record, ledger=LedgerState({}, 1.0, 1.0, events)))


def mean(identity: str, value: float, reason: str = "", n: int = 4, **counts: int) -> Mapping[Identity, Mean]:
    return {Identity.parse(identity): Mean(value, identity, reason, n=n, **counts)}


def means(psnr: float, ssim: float, lpips: float = math.nan, region: str = "body") -> dict[Identity, Mean]:
    found: dict[Identity, Mean] = {}
    for name, value in ((PSNR, psnr), (SSIM, ssim), (LPIPS, lpips)):
        found |= mean(name.format(region), value, "weights are not there" if math.isnan(value) else "")
    return found


def fake_run(
    scene: str = "a",
    method: str = "ours",
    psnr: float = 20.0,
    ssim: float = 0.9,
    lpips: float = math.nan,
    *,
    views: Mapping[str, tuple[float, float]] | None = None,  # further groups of test views -> PSNR, SSIM
    status: Status = "done",
    reason: str = "",
    who: Mapping[str, Any] | None = None,  # of the identity
    said: Mapping[str, Any] | None = None,  # of the record's "about"
) -> RunResult:
    """A run whose numbers are these; with a truth row beside it."""
    rows = {method: means(psnr, ssim, lpips), "truth": means(math.inf, 1.0, 0.0)}
    rows |= {f"{method} [{name}]": means(*values) for name, values in (views or {}).items()}
    told = record(identity(scene, method, **who or {}), about(**said or {}), status, reason)
    return RunResult(Path("runs") / scene, told, rows if status == "done" else {})


def write_run(runs: Path, scene: str, method: str, psnr: float, ssim: float, **changes: Any) -> Path:
    """A run folder with one test view."""
    folder = RunFolder.create(runs, identity(scene, method, **changes), about())
    values = {identity: mean.value for identity, mean in means(psnr, ssim).items()}
    line = ScoreLine(method, 1, 0, values, {LPIPS.format("body"): "weights are not there"})
    folder.write_scores([line])
    atomic.write_json_lines(folder.path / "calibration.jsonl", as_json([replace(line, row="truth")]))
    folder.set_status("done")
    return folder.path
