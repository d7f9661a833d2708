"""A run opened again, with what it was made on; and what finished runs tell about how long the next one will take."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from ihbench.body import load_body
from ihbench.errors import BadInput
from ihbench.record.results import Rows, read_result
from ihbench.record.schema import RunRecord, outcome_fault
from ihbench.record.store import RunFolder
from ihbench.scene.capture_digest import capture_digest
from ihbench.scene.contracts import Capture
from ihbench.scene.data_source import open_capture, own_body, own_data, standin_root
from ihbench.scene.protocol import Protocol, load_protocol, protocol_from
from ihbench.scene.views import OccludedScene, open_scene

if TYPE_CHECKING:
    from ihbench.body import Body


@dataclass(frozen=True)
class FinishedRun:
    """A run folder; each part is read when first asked for, and raises `BadInput` where it cannot be had."""

    folder: Path
    data: Path | None = None  # the user's copy of the data set, for a run on real data
    smpl: Path | None = None  # the user's SMPL file or folder of them, likewise

    @cached_property
    def record(self) -> RunRecord:
        """run.json, which says what the run was made on."""
        record = RunFolder.open(self.folder).record
        if lacking := outcome_fault(record):
            raise BadInput(f"{self.folder / 'run.json'}: {lacking}; run the same command with --force")
        return record

    @cached_property
    def rows(self) -> Rows:
        """Means over the test views, of the method and of the calibration rows."""
        return read_result(self.folder).rows

    @cached_property
    def protocol(self) -> Protocol:
        """As it was then; it must be on record, or still the same."""
        identity, content = self.record.identity, self.record.about.protocol
        name, _, version = identity.protocol.partition("@")
        if content is None:
            protocol = load_protocol(name, identity.profile)
        else:
            protocol = protocol_from(dict(content), identity.profile, version)
        if protocol.digest != identity.protocol_digest:
            raise BadInput(f"{self.folder}: its protocol {identity.protocol} is not on record and is another one now")
        return protocol

    @cached_property
    def capture(self) -> Capture:
        """Opened anew where the data lie now: they must be of the same kind."""
        identity, standin = self.record.identity, self.record.about.standin
        root = own_data(self.data)
        if root is None and not standin:
            raise BadInput(f"{self.folder}: was made on real data; name the folder of your copy with --data")
        root = root or standin_root(identity.dataset)
        capture = open_capture(identity.dataset, root, identity.scene, self.smpl)[0]
        if capture.standin != standin:
            raise BadInput(
                f"{root}: holds {capture.standin or 'real data'}, the run was made on {standin or 'real data'}; name "
                "its data with --data"
            )
        return capture

    @cached_property
    def body(self) -> Body:
        """The model of the run's poses."""
        about = self.record.about
        if about.standin:
            return load_body()
        named = None if about.body == "own" else own_body(self.smpl)
        if named is None and about.body != "own":
            raise BadInput(
                f"{self.folder}: was made on real data; name the SMPL model file with --body or IHBENCH_BODY"
            )
        return self.capture.model if named is None or named.is_dir() else load_body(named)

    @cached_property
    def scene(self) -> OccludedScene:
        """With its truth; the data must be those of the run."""
        capture, protocol = self.capture, self.protocol
        if capture_digest(capture, protocol) not in self.record.identity.data:
            raise BadInput(
                f"{self.folder}: the data of {capture.name} are not those that the run was made on; name its --data"
            )
        scene = open_scene(capture, protocol)
        if scene.hiding.in_scene != protocol.occlusion.in_scene:
            raise BadInput(
                f"{self.folder}: was scored as if its occluder, which stands in the scene, hid nothing of the test "
                "images; run it again"
            )
        return scene


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
    every = list(_timed(runs, (method, protocol, profile, cpu)))
    plain = [record for record in every if not record.about.changed]
    own_code = [record for record in plain or every if record.identity.code == code]
    records = own_code or plain or every
    if not records:
        return None
    stages: dict[str, list[float]] = {}
    whole = [r for r in records if all(o.value is None for o in r.about.left_out or ())]  # of no work left out
    for record in whole or records:
        for path, stage in record.ledger.stages.items() if record.ledger is not None else ():
            stages.setdefault(path, []).append(stage.seconds)
    seconds = median(record.about.total_seconds or 0.0 for record in records)
    medians = {path: median(values) for path, values in stages.items()}
    return EarlierRuns(len(records), bool(plain), bool(own_code), seconds, medians)


def _timed(runs: Path, expected: tuple[str, str, str, str]) -> Iterator[RunRecord]:
    """A damaged record tells nothing about time and is passed over."""
    for path in sorted(runs.glob("*/run.json")):
        try:
            record = RunFolder.open(path.parent).record
        except BadInput:
            continue
        own = record.identity.method, record.identity.protocol, record.identity.profile, record.machine.cpu
        known = record.ledger is not None and record.about.total_seconds is not None
        if own == expected and record.outcome.status == "done" and known:
            yield record
