"""Finished runs as data: what reports read."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ihbench import atomic
from ihbench.errors import BadInput
from ihbench.metrics import Mean, Score, mean_over_frames
from ihbench.scoring import ViewScores
from ihbench.store import RunFolder

NAMED_BY = {"protocol", "protocol_digest", "profile", "scene", "method", "seed", "code"}  # of the identity


@dataclass(frozen=True)
class RunResult:
    """One run folder, read."""

    folder: Path
    record: dict[str, Any]  # run.json
    rows: dict[str, dict[str, Mean]]  # row name -> identity -> mean over the scene's test views
    presets: dict[str, dict[str, dict[str, Mean]]] = field(default_factory=dict)  # preset scored later -> its rows

    @property
    def status(self) -> str:
        return self.record["status"]

    @property
    def identity(self) -> dict[str, Any]:
        return self.record["identity"]

    @property
    def method(self) -> str:
        return self.identity["method"]

    @property
    def scene(self) -> str:
        return self.identity["scene"]

    @property
    def group(self) -> tuple[str, str, str, str]:
        """Runs of one group may stand in one table: protocol, its digest, profile, which data."""
        identity = self.identity
        return identity["protocol"], identity["protocol_digest"], identity["profile"], self.data

    @property
    def planned(self) -> dict[str, Any]:
        """Switches that the plan has changed for this scene -> the value that was in force."""
        omissions = self.record["about"].get("left_out", ())
        return {o["field"]: o["value"] for o in omissions if o["value"] is not None}

    @property
    def missing_views(self) -> int:
        """Test views without an image, over which the means do not run: of predictions whose files were missing."""
        return len(self.record["about"].get("predictions", {}).get("missing", ()))

    @cached_property
    def curve(self) -> list[dict[str, Any]]:
        """Quality-time points, see `RunFolder.add_curve_point`; none where there is no file, or a damaged one."""
        file = self.folder / "curve.jsonl"
        try:
            points = atomic.read_json_lines(file) if file.is_file() else []
            return [point for point in points if float(point["seconds"]) >= 0 and isinstance(point["scores"], dict)]
        except (BadInput, KeyError, TypeError, ValueError):
            return []

    @property
    def data(self) -> str:
        """What the run was made on, as a table names it."""
        about = self.record["about"]
        if about["standin"]:
            return f"**{about['standin']}**: made by the bench, not real data"
        return f"real data ({about['variant']})"


def group_row(row: str, group: str) -> str:
    """What the row of a further group of test views is called."""
    return f"{row} [{group}]" if group else row


def view_rows(row: str, scores: Iterable[ViewScores]) -> list[dict[str, Any]]:
    """Per-view scores as JSON lines: one object per test view, absent numbers with their reasons."""
    return [
        {
            "row": group_row(row, view.key.group),
            "camera": view.key.camera_id,
            "frame": view.key.frame,
            "scores": {identity: score.value for identity, score in view.scores.items()},
            "absent": {identity: score.reason for identity, score in view.scores.items() if score.absent},
        }
        for view in scores
    ]


def mean_rows(lines: Iterable[dict[str, Any]]) -> dict[str, dict[str, Mean]]:
    """The inverse of `view_rows` up to the mean over views: row -> identity -> mean."""
    scores: dict[str, dict[str, list[Score]]] = {}
    for line in lines:
        for identity, value in line["scores"].items():
            value = float(value)
            reason = line["absent"].get(identity, "no reason recorded") if math.isnan(value) else ""
            scores.setdefault(line["row"], {}).setdefault(identity, []).append(Score(value, identity, reason))
    return {
        row: {identity: mean_over_frames(values) for identity, values in by_identity.items()}
        for row, by_identity in scores.items()
    }


def read_result(folder: Path) -> RunResult:
    """Read a run folder. Raises `BadInput` when it is none or is damaged."""
    run = RunFolder.open(folder)
    run.notice_death()
    record = run.record
    if not record["identity"].keys() >= NAMED_BY or not record["about"].keys() >= {"standin", "variant"}:
        raise BadInput(f"{folder}: run.json is not a run record of this bench")
    lines: list[dict[str, Any]] = []
    for name in ("scores.jsonl", "calibration.jsonl"):
        if (folder / name).is_file():
            lines += atomic.read_json_lines(folder / name)
    try:
        rows = mean_rows(lines)
        presets = {
            file.stem: mean_rows(atomic.read_json_lines(file)[1:])
            for file in sorted((folder / "presets").glob("*.jsonl"))
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(
            f"{folder}: its score files are damaged ({error}); run the same command with --force"
        ) from error
    if record["status"] == "done" and record["identity"]["method"] not in rows:
        raise BadInput(f"{folder}: is done, but its scores are gone; run the same command with --force")
    return RunResult(folder, record, rows, presets)


def as_json(results: Iterable[RunResult]) -> dict[str, Any]:
    """What `--json` prints of runs: strict JSON, numbers that are not finite as strings."""
    results = list(results)
    return {
        "status": "done" if all(r.status == "done" for r in results) else "not done",
        "runs": [
            {
                "folder": str(r.folder),
                "scene": r.scene,
                "method": r.method,
                "seed": r.identity["seed"],
                "status": r.status,
                "reason": r.record["reason"],
                "standin": r.record["about"]["standin"],
                "missing_views": r.missing_views,
                "scores": {
                    row: {identity: atomic.encode(mean.value) for identity, mean in means.items()}
                    for row, means in r.rows.items()
                },
                "fit_seconds": r.record["about"].get("fit_seconds"),
                "total_seconds": r.record["about"].get("total_seconds"),
                "peak_mb": r.record["about"].get("peak_mb"),
            }
            for r in results
        ],
    }
