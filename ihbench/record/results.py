"""Finished runs as data: what reports read."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from ihbench.config_fields import Values, as_json
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.metrics import Identity, Mean, Score, mean_over_frames
from ihbench.record.schema import (
    About,
    CurvePoint,
    RunIdentity,
    RunRecord,
    ScoreLine,
    Status,
    curve_points,
    outcome_fault,
    preset_lines,
    score_lines,
)
from ihbench.record.store import RunFolder

if TYPE_CHECKING:
    from ihbench.scoring.scoring import ViewScores

Key = TypeVar("Key")
Value = TypeVar("Value")
TRACEBACK = "traceback.txt"  # of a run that failed, in its folder
Rows = Mapping[str, Mapping[Identity, Mean]]  # row name -> identity -> mean over the scene's test views
Group = tuple[str, str, str, str]  # protocol, its digest, profile, which data


@dataclass(frozen=True)
class RunResult:
    """One run folder, read and checked: see `ihbench.record.schema`."""

    folder: Path
    record: RunRecord  # run.json
    rows: Rows
    presets: Mapping[str, Rows] = field(default_factory=dict)  # preset scored later -> its rows
    curve: Sequence[CurvePoint] = ()
    damage: tuple[str, ...] = ()  # files that no number in `rows` comes from and that cannot be read, and why

    @property
    def status(self) -> Status:
        return self.record.outcome.status

    @property
    def reason(self) -> str:
        return self.record.outcome.reason

    def _repr_html_(self) -> str:
        """What a notebook shows: the headline and the contact sheet."""
        from ihbench.record.notebook import run_html

        return run_html(self)

    @property
    def outcome(self) -> str:
        """The status, and why where it is not done, with the path of the traceback where there is one."""
        reason = self.reason.replace(f"(see {TRACEBACK})", f"(see {self.folder / TRACEBACK})")
        return f"{self.status}: {reason}" if reason else self.status

    @property
    def identity(self) -> RunIdentity:
        return self.record.identity

    @property
    def about(self) -> About:
        return self.record.about

    @property
    def method(self) -> str:
        return self.identity.method

    @property
    def scene(self) -> str:
        return self.identity.scene

    @property
    def seed(self) -> int:
        return self.identity.seed

    @property
    def headline(self) -> str:
        return self.about.headline or ""

    @property
    def own(self) -> Mapping[Identity, Mean]:
        """The method's row of scores; empty where it has none."""
        return self.rows.get(self.method, {})

    @property
    def group(self) -> Group:
        """Runs of one group may stand in one table."""
        return self.identity.protocol, self.identity.protocol_digest, self.identity.profile, self.data

    @property
    def planned(self) -> Values:
        """Switches that the plan has changed for this scene -> the value that was in force."""
        return {o.field: o.value for o in self.about.left_out or () if o.value is not None}

    @property
    def switches(self) -> Values:
        """Dotted name -> value of the method's switches, as the scene's plan left them."""
        return self.identity.switches | self.planned

    @property
    def fit_seconds(self) -> float:
        """NaN for what was not fitted here."""
        return math.nan if self.about.fit_seconds is None else self.about.fit_seconds

    @property
    def timed(self) -> bool:
        return self.about.fit_seconds is not None

    @property
    def missing_views(self) -> int:
        """Test views without an image, over which the means do not run: of predictions whose files were missing."""
        return 0 if self.about.predictions is None else len(self.about.predictions.missing)

    @property
    def data(self) -> str:
        """What the run was made on, as a table names it."""
        if self.about.standin:
            return f"{self.about.standin}: made by the bench, not real data"
        return f"real data ({self.about.variant})"


@dataclass(frozen=True)
class NotRun:
    """A run that was asked for together with others and came to nothing that could be recorded, and why."""

    protocol: str  # as in a run's identity
    profile: str
    method: str
    scene: str
    seed: int
    reason: str


def grouped(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Key -> the values beside it, both in the order given."""
    groups: dict[Key, list[Value]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def by_group(results: Iterable[RunResult]) -> dict[Group, list[RunResult]]:
    """Runs that may stand in one table, in the order given."""
    return grouped((result.group, result) for result in results)


def group_row(row: str, group: str) -> str:
    """What the row of a further group of test views is called."""
    return f"{row} [{group}]" if group else row


def view_rows(row: str, scores: Iterable[ViewScores]) -> list[ScoreLine]:
    """Per-view scores as lines: one for each test view, absent numbers with their reasons."""
    return [
        ScoreLine(
            group_row(row, view.key.group),
            view.key.camera_id,
            view.key.frame,
            {Identity.parse(identity): score.value for identity, score in view.scores.items()},
            {identity: score.reason for identity, score in view.scores.items() if score.absent},
        )
        for view in scores
    ]


def mean_rows(lines: Iterable[ScoreLine]) -> Rows:
    """The inverse of `view_rows` up to the mean over views: row -> identity -> mean."""
    scores: dict[str, dict[Identity, list[Score]]] = {}
    for line in lines:
        for identity, value in line.scores.items():
            name, value = str(identity), float(value)
            reason = line.absent.get(name, "no reason recorded") if math.isnan(value) else ""
            scores.setdefault(line.row, {}).setdefault(identity, []).append(Score(value, name, reason))
    return {
        row: {identity: mean_over_frames(values) for identity, values in by_identity.items()}
        for row, by_identity in scores.items()
    }


def read_result(folder: Path) -> RunResult:
    """Read a run folder. Raises `BadInput` when it is none, or a file that its numbers come from is damaged."""
    run = RunFolder.open(folder)
    run.notice_death()
    record = run.record
    if fault := outcome_fault(record):
        raise BadInput(f"{folder / 'run.json'}: {fault}; run the same command with --force")
    method = record.identity.method
    own, others = (_read_if_there(folder / name, score_lines) for name in ("scores.jsonl", "calibration.jsonl"))
    if fault := _mixed_up(method, own, others):
        raise BadInput(f"{folder}: its score files are damaged ({fault}); run the same command with --force")
    rows = mean_rows([*own, *others])
    if run.status == "done" and method not in rows:
        raise BadInput(f"{folder}: is done, but its scores are gone; run the same command with --force")
    if run.status == "done" and (fault := _views_lost(record, own)):
        raise BadInput(f"{folder}: its scores are not whole ({fault}); run the same command with --force")
    presets: dict[str, Rows] = {}
    curve: list[CurvePoint] = []
    damage: list[str] = []
    for file in sorted((folder / "presets").glob("*.jsonl")):
        try:
            _, lines = preset_lines(file)
            mine, others = ([x for x in lines if _is_row_of(method, x.row) is own] for own in (True, False))
            fault = _mixed_up(method, mine, others) if mine else f"no row of {method[:80]!a}"
            if fault := fault or _views_lost(record, mine):
                raise BadInput(f"{file}: {fault}")
            presets[file.stem] = mean_rows(lines)
        except BadInput as error:
            damage.append(str(error))
    try:
        curve = _read_if_there(folder / "curve.jsonl", curve_points)
    except BadInput as error:
        damage.append(str(error))
    return RunResult(folder, record, rows, presets, curve, tuple(damage))


def read_results(folders: Iterable[Path]) -> tuple[list[RunResult], list[str]]:
    """These run folders, and, one line each, those that are left out: damaged ones, and copies of a run that is
    among them. Raises `BadInput` when none can be read."""
    results, left_out = [], []
    for folder in folders:
        try:
            results.append(read_result(folder))
        except BadInput as error:
            left_out.append(str(error))
    if left_out and not results:
        raise BadInput(left_out[0])
    results, copies = without_copies(results)
    return results, [*left_out, *copies]


def without_copies(results: Sequence[RunResult]) -> tuple[list[RunResult], list[str]]:
    """Runs without second copies of the same one, which would count twice, and a line about each copy. Of several
    folders the one counts that has the run's own name."""
    first: dict[str, RunResult] = {}
    for result in results:
        other = first.setdefault(result.record.digest, result)
        if _has_own_name(result) and not _has_own_name(other):
            first[result.record.digest] = result
    kept, left_out = [], []
    for result in results:
        one = first[result.record.digest]
        if one is result:
            kept.append(result)
        else:
            left_out.append(f"{result.folder}: is a copy of {one.folder}")
    return kept, left_out


def _has_own_name(result: RunResult) -> bool:
    return result.folder.name.endswith(f"__{result.record.digest}")


def _read_if_there(file: Path, read: Callable[[Path], list[Any]]) -> list[Any]:
    return read(file) if os.path.lexists(file) else []


def _mixed_up(method: str, own: Sequence[ScoreLine], others: Sequence[ScoreLine]) -> str:
    """How score lines contradict each other; "" where they do not. All rows of a group of test views have the same
    views: a mean over fewer is not to be compared with the others."""
    groups: dict[str, dict[str, set[tuple[Any, int]]]] = {}
    for lines, of_method in ((own, True), (others, False)):
        for row in {line.row for line in lines}:
            if _is_row_of(method, row) is not of_method:
                return f"row {row[:80]!a} {'is none of' if of_method else 'belongs to'} {method[:80]!a}"
    for line in (*own, *others):
        row = line.row
        group = row.removeprefix(method) if _is_row_of(method, row) else "".join(row.partition(" [")[1:])
        groups.setdefault(group, {}).setdefault(row, set()).add((line.camera, line.frame))
    for rows in groups.values():
        every = set().union(*rows.values())
        for row, views in rows.items():
            if views != every:
                return f"{row[:80]!a} has {len(views)} of {len(every)} test views"
    return ""


def _views_lost(record: RunRecord, own: Sequence[ScoreLine]) -> str:
    """How many test views the rows of the method or of the predictions have too few or too many, those of further
    groups among them; "" where none, or where the record does not say how many there are. A view without a prediction
    has scores, too: absent ones."""
    files, measured = record.about.predictions, (record.about.measure or {}).get("test_views")
    expected = measured if files is None else files.views
    return (
        f"{len(own)} of {expected} test views" if isinstance(expected, int) and expected not in (0, len(own)) else ""
    )


def _is_row_of(method: str, row: str) -> bool:
    return row == method or (row.startswith(f"{method} [") and row.endswith("]"))


def summary(results: Iterable[RunResult], not_run: Sequence[NotRun] = ()) -> dict[str, object]:
    """What `--json` prints of runs: strict JSON, numbers that are not finite as strings."""
    results = list(results)
    return {
        "status": "done" if not not_run and all(r.status == "done" for r in results) else "not done",
        **({"not_run": [asdict(missing) for missing in not_run]} if not_run else {}),
        "runs": [
            {
                "folder": str(r.folder),
                "scene": r.scene,
                "method": r.method,
                "seed": r.seed,
                "status": r.status,
                "reason": r.reason,
                "standin": r.about.standin,
                "missing_views": r.missing_views,
                "scores": {
                    row: {str(identity): atomic.encode(mean.value) for identity, mean in means.items()}
                    for row, means in r.rows.items()
                },
                "fit_seconds": r.about.fit_seconds,
                "total_seconds": r.about.total_seconds,
                "peak_mb": r.about.peak_mb,
                "render_ms": r.about.render_ms,
                **({} if r.about.predictions is None else {"predictions": as_json(r.about.predictions)}),
            }
            for r in results
        ],
    }
