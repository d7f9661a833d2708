"""Finished runs that nobody ran, with numbers a test chooses. In memory, or as run folders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ihbench.files import atomic
from ihbench.metrics import Mean
from ihbench.record.results import RunResult
from ihbench.record.store import RunFolder, RunIdentity

PSNR, SSIM, LPIPS = "psnr/pooled/range1/{}/v1", "ssim/gauss11-1.5/range1/{}/v1", "lpips/vgg0.1/range-1,1/{}/v1"
STANDIN = "stand-in v1 seed 0"
SUBJECTS = ("a", "b", "c", "d")


def identity(scene: str, method: str, **changes: Any) -> RunIdentity:
    fields: dict[str, Any] = {
        "protocol": "zju_occ@1", "protocol_digest": "abc", "dataset": "zju_mocap", "scene": scene, "data": STANDIN,
        "method": method, "config": {}, "profile": "quick", "seed": 0, "body": "0", "code": "1+0",
    }  # fmt: skip
    return RunIdentity(**fields | changes)


def about(**changes: Any) -> dict[str, Any]:
    subjects = {"names": list(SUBJECTS), "standin": list(SUBJECTS)}
    return {
        "standin": STANDIN, "variant": "original", "headline": "body", "changed": [], "left_out": [],
        "fit_seconds": 10.0, "total_seconds": 20.0, "peak_mb": 100.0, "protocol": {"subjects": subjects},
    } | changes  # fmt: skip


def means(psnr: float, ssim: float, lpips: float = math.nan, region: str = "body") -> dict[str, Mean]:
    found = {}
    for name, value in ((PSNR, psnr), (SSIM, ssim), (LPIPS, lpips)):
        found[name.format(region)] = Mean(
            value, name.format(region), "weights are not there" if math.isnan(value) else "", n=4
        )
    return found


def fake_run(
    scene: str = "a",
    method: str = "ours",
    psnr: float = 20.0,
    ssim: float = 0.9,
    lpips: float = math.nan,
    *,
    views: Mapping[str, tuple[float, float]] | None = None,  # further groups of test views -> PSNR, SSIM
    status: str = "done",
    reason: str = "",
    who: Mapping[str, Any] | None = None,  # of the identity
    said: Mapping[str, Any] | None = None,  # of the record's "about"
) -> RunResult:
    """A run whose numbers are these; with a truth row beside it."""
    named = identity(scene, method, **who or {})
    rows = {method: means(psnr, ssim, lpips), "truth": means(math.inf, 1.0, 0.0)}
    rows |= {f"{method} [{name}]": means(*values) for name, values in (views or {}).items()}
    record = {"status": status, "reason": reason, "identity": vars(named), "about": about(**said or {})}
    return RunResult(Path("runs") / scene, record, rows if status == "done" else {})


def write_run(runs: Path, scene: str, method: str, psnr: float, ssim: float, **changes: Any) -> Path:
    """A run folder with one test view."""
    folder = RunFolder.create(runs, identity(scene, method, **changes), about())
    values = {PSNR.format("body"): psnr, SSIM.format("body"): ssim, LPIPS.format("body"): math.nan}
    absent = {LPIPS.format("body"): "weights are not there"}
    row = {"row": method, "camera": 1, "frame": 0, "scores": values, "absent": absent}
    folder.write_scores([row])
    atomic.write_json_lines(folder.path / "calibration.jsonl", [row | {"row": "truth"}])
    folder.set_status("done")
    return folder.path
