"""What the files of a run folder hold, checked once where they are read: after that the code may rely on it.

Every number that is read here is a number within bounds, every list a list. Fields that an earlier version of the
bench did not write may be missing; fields that nobody reads may hold any JSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, NotRequired, TypedDict

from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.regular import read_bytes
from ihbench.metrics.identity import Identity as MetricIdentity
from ihbench.record.shape import WHOLE, Matches, Within, fault

LARGEST_RECORD = 32 * 2**20  # bytes; no honest run.json comes near
LARGEST_TABLE = 256 * 2**20  # bytes; nor do scores

Status = Literal["running", "done", "diverged", "failed", "interrupted", "skipped", "timeout"]


@dataclass(frozen=True)
class _Time:
    """A moment with its time zone, as ISO 8601 has it."""

    def fault(self, value: str) -> str:
        try:
            aware = datetime.fromisoformat(value).tzinfo is not None
        except ValueError:
            aware = False
        return "" if aware else f"is {value[:60]!a}, expected a time such as 2025-01-31T12:00:00+00:00"


Seconds = Annotated[float, Within(0)]
Megabytes = Annotated[float, Within(0, nan=True)]  # NaN where the system does not tell
Count = Annotated[int, Within(0, WHOLE)]
Moment = Annotated[str, _Time()]
Words = Annotated[str, Matches(re.compile(r"(?s).{1,1000}"), "a name of 1 to 1000 letters")]
StagePath = Annotated[
    str, Matches(re.compile(r"[A-Za-z0-9][A-Za-z0-9 _.+-]{0,99}(/[A-Za-z0-9][A-Za-z0-9 _.+-]{0,99}){0,9}"), "a stage")
]  # fmt: skip


class Config(TypedDict):
    keep: NotRequired[list[str]]


class Identity(TypedDict):
    """See `store.RunIdentity`, which has every field; what a later version adds is covered by the digest."""

    protocol: Words
    protocol_digest: Words
    dataset: Words
    scene: Words
    data: str
    method: Words
    config: Config
    profile: Words
    seed: Count
    body: str
    code: str


class Omission(TypedDict):
    field: str
    value: Any
    reason: str
    spares: NotRequired[dict[str, float]]


class Subjects(TypedDict):
    names: NotRequired[list[str]]
    standin: NotRequired[list[str]]


class Image(TypedDict):
    size: NotRequired[Annotated[int, Within(1, 100_000)]]


class ProtocolContent(TypedDict):
    subjects: NotRequired[Subjects]
    image: NotRequired[Image]


class PredictionFiles(TypedDict):
    missing: list[str]
    surplus: list[str]
    notes: list[str]
    doubts: NotRequired[list[str]]
    alpha: NotRequired[str]
    views: NotRequired[Count]


class About(TypedDict):
    """What a reader of the result should know. A run that failed early knows little."""

    standin: NotRequired[str]
    variant: NotRequired[str]
    body: NotRequired[str]
    headline: NotRequired[Words]
    protocol: NotRequired[ProtocolContent]
    device: NotRequired[str]
    command: NotRequired[list[str]]
    provenance: NotRequired[str]
    label: NotRequired[str]
    predictions: NotRequired[PredictionFiles]
    changed: NotRequired[list[str]]
    left_out: NotRequired[list[Omission]]
    avatar_files: NotRequired[list[str]]
    fit_seconds: NotRequired[Seconds | None]
    total_seconds: NotRequired[Seconds]
    peak_mb: NotRequired[Megabytes]


class Machine(TypedDict):
    cpu: NotRequired[str | None]
    cores: NotRequired[Annotated[int, Within(1, 1e6)] | None]
    cores_usable: NotRequired[Annotated[int, Within(1, 1e6)] | None]
    torch_threads: NotRequired[Annotated[int, Within(1, 1e6)] | None]
    gpu: NotRequired[str | None]
    load_average: NotRequired[list[Seconds] | None]
    load_average_end: NotRequired[list[Seconds] | None]


class Stage(TypedDict):
    seconds: Seconds
    cpu_seconds: NotRequired[float]
    peak_mb: NotRequired[Megabytes]
    peak_device_mb: NotRequired[Megabytes | None]
    entered: NotRequired[Count]


class Event(TypedDict):
    kind: str
    data: dict[str, Any]
    fit_seconds: NotRequired[float]
    seconds: NotRequired[float]


class LedgerState(TypedDict):
    stages: dict[StagePath, Stage]
    seconds: Seconds
    cpu_seconds: float
    events: list[Event]


class Record(TypedDict):
    """run.json"""

    schema_version: int
    status: Status
    reason: str
    digest: Words
    identity: Identity
    about: About
    created: Moment
    updated: NotRequired[Moment]
    provenance: NotRequired[dict[str, Any] | None]
    machine: NotRequired[Machine | None]
    ledger: NotRequired[LedgerState | None]
    warnings: list[str]


class ScoreLine(TypedDict):
    """One test view of one row of scores.jsonl, calibration.jsonl or a preset's file."""

    row: Words
    camera: str | int
    frame: Count
    scores: dict[str, Annotated[float, Within(-1e12, 1e12, nan=True, infinite=True)]]
    absent: dict[str, str]


class PresetHead(TypedDict):
    """The first line of a preset's file."""

    lacking: list[str]  # metrics that could not be computed
    code: NotRequired[str]


class CurvePoint(TypedDict):
    """One point of curve.jsonl: the quality of some test views at a moment of the fit clock."""

    step: Count
    seconds: Seconds
    views: NotRequired[Count]
    scores: dict[str, Annotated[float, Within(-1e12, 1e12, nan=True, infinite=True)]]


def read_json(file: Path, largest: int = LARGEST_RECORD) -> Any:
    """The JSON of one file of a run folder. Raises `BadInput` for what is no plain file, is larger than any record,
    or no strict JSON: an object with a key twice, NaN, a number of 400 digits, values nested without end."""
    return _parsed(file, _content(file, largest))


def read_lines(file: Path, kind: Any) -> list[Any]:
    """The lines of one file of a run folder, each of the type `kind`. Raises `BadInput` as `read_json` does, and for
    a line of another shape."""
    lines = []
    for number, text in enumerate(_content(file, LARGEST_TABLE).split("\n"), 1):
        if text.strip():
            line = _parsed(file, text, f", line {number}")
            if found := fault(line, kind):
                raise BadInput(f"{file}, line {number}: {found.lstrip('. ')}")
            lines.append(line)
    return lines


def score_lines(file: Path) -> list[Any]:
    """Per-view scores in the order of the file. Raises `BadInput` as `read_lines` does, and for a name that is no
    metric's identity or a view that stands there twice."""
    return _scores(file, read_lines(file, ScoreLine))


def preset_lines(file: Path) -> tuple[PresetHead, list[Any]]:
    """What a preset's file of scores begins with, and its score lines. Raises `BadInput` as `score_lines` does."""
    first, *lines = read_lines(file, Any) or [None]
    if found := fault(first, PresetHead):
        raise BadInput(f"{file}, line 1: {found.lstrip('. ')}")
    for number, line in enumerate(lines, 2):
        if found := fault(line, ScoreLine):
            raise BadInput(f"{file}, line {number}: {found.lstrip('. ')}")
    return first, _scores(file, lines)


def _scores(file: Path, lines: list[Any]) -> list[Any]:
    seen = set()
    for line in lines:
        _check_names(file, line["scores"])
        view = line["row"], line["camera"], line["frame"]
        if view in seen:
            raise BadInput(f"{file}: camera {line['camera']}, frame {line['frame']} stands twice in {line['row']}")
        seen.add(view)
    return lines


def curve_points(file: Path) -> list[Any]:
    """Quality-time points, step by step. Raises `BadInput` as `read_lines` does."""
    points = read_lines(file, CurvePoint)
    for point in points:
        _check_names(file, point["scores"])
    return points


def record_fault(record: Any) -> str:
    """Where a run record of this schema version is not what it should be; "" where it is."""
    if found := fault(record, Record):
        return found.lstrip(". ")
    for name in ("load_average", "load_average_end"):
        if (record.get("machine") or {}).get(name) == []:
            return f"machine.{name} is empty"
    return ""


def outcome_fault(record: Mapping[str, Any]) -> str:
    """What a run record lacks of what every run says, and every finished one; "" where nothing does."""
    expected = ["standin", "variant"]
    if record["status"] == "done":
        expected += ["headline", "changed", "left_out", "fit_seconds", "total_seconds", "peak_mb"]
    return next((f"about.{name} is missing" for name in expected if name not in record["about"]), "")


def _content(file: Path, largest: int) -> str:
    """The text of a plain file that is no link: a pipe would be waited for, a link leads elsewhere."""
    if file.is_symlink():
        raise BadInput(f"{file}: is a link; expected a plain file")
    try:
        return read_bytes(file, "a file of a run", largest).decode("utf-8")
    except UnicodeDecodeError as error:
        raise BadInput(f"{file}: not UTF-8 text at byte {error.start}") from error


def _parsed(file: Path, text: str, where: str = "") -> Any:
    try:
        value = json.loads(text, object_pairs_hook=_once, parse_constant=_refused)
        return atomic.decode(value)
    except RecursionError as error:
        raise BadInput(f"{file}{where}: not valid JSON (nested too deeply)") from error
    except ValueError as error:
        raise BadInput(f"{file}{where}: not valid JSON ({str(error)[:200]})") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) != len(pairs):
        raise ValueError("a key stands twice in one object")
    return made


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is no JSON")


def _check_names(file: Path, scores: Iterable[str]) -> None:
    for name in scores:
        if not _is_metric(name):
            raise BadInput(f"{file}: {name[:80]!a} is no metric's identity, such as psnr/pooled/range1/full/v1")


@lru_cache(10_000)
def _is_metric(name: str) -> bool:
    try:
        MetricIdentity.parse(name)
    except ValueError:
        return False
    return True
