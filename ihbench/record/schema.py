"""What the files of a run folder hold, checked once where they are read: after that the code may rely on it.

Every number that is read here is a number within bounds, every list a list. Fields that an earlier version of the
bench did not write may be missing; fields that nobody reads may hold any JSON.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

from ihbench.clock.events import Event
from ihbench.clock.ledger import LedgerState, Megabytes, Seconds
from ihbench.clock.machine import Machine
from ihbench.config_fields import TextRule, Values, Within, as_json, read
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.regular import read_bytes
from ihbench.metrics.identity import Identity
from ihbench.record.provenance import Provenance
from ihbench.scene.plan import Omission

SCHEMA_VERSION = 2
LARGEST_RECORD = 32 * 2**20  # bytes; no honest run.json comes near
LARGEST_TABLE = 256 * 2**20  # bytes; nor do scores
HASH_LENGTH = 10

Status = Literal["running", "done", "diverged", "failed", "interrupted", "skipped", "timeout"]


def _is_time(text: str) -> bool:
    """Whether it is a moment with its time zone, as ISO 8601 has it."""
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except ValueError:
        return False


Count = Annotated[int, Within(0, 2**63 - 1)]
Moment = Annotated[str, TextRule("a time such as 2025-01-31T12:00:00+00:00", _is_time)]
Words = Annotated[str, TextRule("a name of 1 to 1000 letters", lambda text: 1 <= len(text) <= 1000)]
Scores = Mapping[Identity, Annotated[float, Within(-1e12, 1e12, nan=True, infinite=True)]]
Json = Mapping[str, Any]


@dataclass(frozen=True)
class Outcome:
    """How far a run came, and why no further."""

    status: Status
    reason: str
    created: Moment
    updated: Moment | None = None
    step: Count | None = None  # of the fit, at which it diverged


@dataclass(frozen=True)
class RunIdentity:
    """Everything that affects the answer of a run, and nothing else."""

    protocol: Words  # id@version
    protocol_digest: Words  # hash of the protocol's content
    dataset: Words
    scene: Words
    data: str  # which copy of the data: variant, or the stand-in's version and seed
    method: Words
    config: Json  # every switch of the method; JSON-able
    profile: Words
    seed: Count
    body: str  # hash of the body model
    code: str  # version, hash of the method's code, hash of the bench's: see `source_digest`
    more: Json = field(default_factory=dict)  # what another version of the bench says besides

    @property
    def digest(self) -> str:
        """Hex digits that name this identity; equal for equal identities in any process and on any machine."""
        parts = atomic.encode(atomic.encode(as_json(self)))  # twice, as ever: old runs keep their names
        canonical = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
        return sha256(canonical.encode()).hexdigest()[:HASH_LENGTH]

    @property
    def folder_name(self) -> str:
        """A file name that cannot leave its folder, whatever the parts are called; the digest keeps it unique."""
        parts = (self.protocol, self.scene, self.method, self.profile, f"s{self.seed}", self.digest)
        return "__".join(plain_name(part) for part in parts)

    @property
    def protocol_id(self) -> str:
        """Its name without version."""
        return self.protocol.partition("@")[0]

    @property
    def changes(self) -> dict[str, str]:
        """What of the protocol was changed for this run: "size" -> "128"."""
        return {name: value for name, _, value in (part.partition("=") for part in self.protocol.split("+")[1:])}

    def protocol_without(self, change: str) -> str:
        """The protocol's name but for one of its changes."""
        return "+".join(part for part in self.protocol.split("+") if not part.startswith(f"{change}="))

    @property
    def switches(self) -> Values:
        """Dotted name -> value of every switch of the method; lists are tuples."""
        return dict(_flat({name: value for name, value in self.config.items() if name not in ("keep", "outside")}))


@dataclass(frozen=True)
class Subjects:
    names: tuple[str, ...] = ()
    standin: tuple[str, ...] = ()


@dataclass(frozen=True)
class Image:
    size: Annotated[int, Within(1, 100_000)] = 0  # px; 0 where the record does not say


@dataclass(frozen=True)
class _ConfigShape:
    """What is read of a recorded configuration without making the method's own of it."""

    keep: tuple[str, ...] = ()


@dataclass(frozen=True)
class _ProtocolShape:
    """What is read of a recorded protocol without making a `Protocol` of it."""

    subjects: Subjects = Subjects()
    image: Image = Image()


@dataclass(frozen=True)
class PredictionFiles:
    """Images that were made elsewhere and scored here."""

    missing: tuple[str, ...]
    surplus: tuple[str, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    folder: str = ""
    pattern: str | None = None
    alpha: str = ""
    views: Count = 0  # test views that there should be images of; 0 where the record does not say


@dataclass(frozen=True)
class About:
    """What a reader of the result should know. A run that failed early knows little."""

    standin: str | None = None  # "" for real data
    variant: str | None = None
    body: str | None = None
    headline: Words | None = None
    protocol: Json | None = None  # the whole content
    device: str = "cpu"
    command: tuple[str, ...] = ()
    label: str | None = None  # what somebody has named the row
    predictions: PredictionFiles | None = None  # None for a run of a method
    changed: Json | None = None  # switch -> value, of those that differ from the profile's; "keep" -> what stayed
    left_out: tuple[Omission, ...] | None = None
    measure: Json | None = None  # what `SceneMeasure` was then
    hidden_share: float | None = None
    avatar_files: tuple[str, ...] | None = None
    fit_seconds: Seconds | None = None
    total_seconds: Seconds | None = None
    peak_mb: Megabytes | None = None
    render_ms: Annotated[float, Within(0)] | None = None  # of one test view, the median; see `RenderClock`
    more: Json = field(default_factory=dict)

    @property
    def differences(self) -> list[str]:
        """What sets the run apart from its profile, in words: "steps=300"."""
        return [f"{name}={value_text(name, value)}" for name, value in (self.changed or {}).items()]

    @property
    def subjects(self) -> Subjects:
        return read(Subjects, (self.protocol or {}).get("subjects", {}), "", strict=False)

    @property
    def image_size(self) -> int:
        """px; 0 where the record does not say."""
        return read(Image, (self.protocol or {}).get("image", {}), "", strict=False).size


def value_text(name: str, value: Any) -> str:
    """A switch's value as rows are named by it."""
    if name == "keep":
        return ",".join(map(str, value))
    return str(tuple(value) if isinstance(value, list) else value)


@dataclass(frozen=True)
class RunRecord:
    """run.json"""

    digest: Words
    outcome: Outcome
    identity: RunIdentity
    about: About
    machine: Machine
    provenance: Provenance
    ledger: LedgerState | None = None
    warnings: tuple[str, ...] = ()
    schema_version: int = SCHEMA_VERSION
    more: Json = field(default_factory=dict)

    @property
    def events(self) -> tuple[Event, ...]:
        return () if self.ledger is None else self.ledger.events


@dataclass(frozen=True)
class ScoreLine:
    """One test view of one row of scores.jsonl, calibration.jsonl or a preset's file."""

    row: Words
    camera: str | int
    frame: Count
    scores: Scores
    absent: Mapping[str, str]  # identity -> reason


@dataclass(frozen=True)
class PresetHead:
    """The first line of a preset's file."""

    lacking: tuple[str, ...]  # metrics that could not be computed
    code: str = ""


@dataclass(frozen=True)
class CurvePoint:
    """One point of curve.jsonl: the quality of some test views at a moment of the fit clock."""

    step: Count
    seconds: Seconds
    scores: Scores
    views: Count = 0  # test views that it stands on; 0 where the file does not say
    of: Count = 0  # of how many
    on: tuple[str, ...] = ()  # which


def _flat(config: Json, before: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{before}{name}.")
        else:
            yield before + name, tuple(value) if isinstance(value, list) else value


def plain_name(text: str) -> str:
    """Letters, digits and . _ + - @ only, not hidden, 48 at most."""
    return re.sub(r"[^A-Za-z0-9._+@-]+", "-", text).strip(".-_")[:48].rstrip(".") or "unnamed"


def read_json(file: Path, largest: int = LARGEST_RECORD) -> Any:
    """The JSON of one file of a run folder. Raises `BadInput` for what is no plain file, is larger than any record,
    or no strict JSON: an object with a key twice, NaN, a number of 400 digits, values nested without end."""
    return _parsed(file, _content(file, largest))


def read_lines(file: Path, kind: Any, first: Any = None) -> list[Any]:
    """The lines of one file of a run folder, each as the dataclass `kind`; the first one as `first`, if that is
    given. Raises `BadInput` as `read_json` does, and for a line of another shape."""
    lines: list[Any] = []
    for number, text in enumerate(_content(file, LARGEST_TABLE).split("\n"), 1):
        if text.strip():
            where = f", line {number}"
            own = kind if lines or first is None else first
            lines.append(read(own, _parsed(file, text, where), f"{file}{where}", strict=False))
    return lines


def score_lines(file: Path) -> list[ScoreLine]:
    """Per-view scores in the order of the file. Raises `BadInput` as `read_lines` does, and for a view that stands
    there twice."""
    return _each_view_once(file, read_lines(file, ScoreLine))


def preset_lines(file: Path) -> tuple[PresetHead, list[ScoreLine]]:
    """What a preset's file of scores begins with, and its score lines. Raises `BadInput` as `score_lines` does."""
    head, *lines = read_lines(file, ScoreLine, first=PresetHead) or [None]
    if head is None:
        raise BadInput(f"{file}: is empty")
    return head, _each_view_once(file, lines)


def curve_points(file: Path) -> list[CurvePoint]:
    """Quality-time points, step by step. Raises `BadInput` as `read_lines` does."""
    return read_lines(file, CurvePoint)


def _each_view_once(file: Path, lines: list[ScoreLine]) -> list[ScoreLine]:
    seen = set()
    for line in lines:
        view = line.row, line.camera, line.frame
        if view in seen:
            raise BadInput(f"{file}: camera {line.camera}, frame {line.frame} stands twice in {line.row}")
        seen.add(view)
    return lines


def read_record(record: Any, where: str) -> RunRecord:
    """run.json of this schema version. Raises `BadInput` where it is not what it should be."""
    made: RunRecord = read(RunRecord, record, where, strict=False)
    read(_ConfigShape, made.identity.config, where, "identity.config", strict=False)
    read(_ProtocolShape, made.about.protocol or {}, where, "about.protocol", strict=False)
    return made


def outcome_fault(record: RunRecord) -> str:
    """What a run record lacks of what every run says, and every finished one; "" where nothing does."""
    about, expected = record.about, ["standin", "variant"]
    if record.outcome.status == "done":
        expected += ["headline", "changed", "left_out", "total_seconds", "peak_mb"]
        expected += ["fit_seconds"] if about.predictions is None else []
    return next((f"about.{name} is missing" for name in expected if getattr(about, name) is None), "")


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
        value = json.loads(text, object_pairs_hook=atomic.unique_keys, parse_constant=_refused, parse_int=_whole)
        return atomic.decode(value)
    except RecursionError as error:
        raise BadInput(f"{file}{where}: not valid JSON (nested too deeply)") from error
    except ValueError as error:
        raise BadInput(f"{file}{where}: not valid JSON ({str(error)[:200]})") from error


def _refused(word: str) -> Any:
    raise ValueError(f"{word} is no JSON")


def _whole(digits: str) -> int:
    if not -(2**63) <= (number := int(digits)) < 2**63:
        raise ValueError("a whole number of more than 64 bits")
    return number
