"""Opening again what a finished run was made on: its body, its capture, its scene under its protocol."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ihbench.body import load_body
from ihbench.errors import BadInput
from ihbench.record.schema import RunRecord, outcome_fault
from ihbench.record.store import RunFolder
from ihbench.scene.capture_digest import capture_digest
from ihbench.scene.contracts import Capture
from ihbench.scene.data_source import open_capture, own_body, own_data, standin_root
from ihbench.scene.protocol import Protocol, load_protocol, protocol_from
from ihbench.scene.views import OccludedScene, open_scene

if TYPE_CHECKING:
    from ihbench.body import Body


def reopen_body(folder: Path, data: Path | None, body: Path | None) -> Body:
    """The body model of a run's poses. Raises `BadInput` when the run needs an SMPL file and none is named."""
    about = _record(folder).about
    if about.standin:
        return load_body()
    if about.body == "own":
        return reopen_capture(folder, data, body).model
    named = own_body(body)
    if named is None:
        raise BadInput(f"{folder}: was made on real data; name the SMPL model file with --body or IHBENCH_BODY")
    if named.is_dir():
        return reopen_capture(folder, data, body).model
    return load_body(named)


def reopen_capture(folder: Path, data: Path | None, body: Path | None) -> Capture:
    """The capture of a run. Raises `BadInput` when other data lie where it is looked for."""
    record = _record(folder)
    about, identity = record.about, record.identity
    root = own_data(data)
    if root is None and not about.standin:
        raise BadInput(f"{folder}: was made on real data; name the folder of your copy with --data")
    root = root or standin_root(identity.dataset)
    found = open_capture(identity.dataset, root, identity.scene, body)[0]
    if found.standin != about.standin:
        raise BadInput(
            f"{root}: holds {found.standin or 'real data'}, the run was made on "
            f"{about.standin or 'real data'}; name its data with --data"
        )
    return found


def reopen_protocol(folder: Path) -> Protocol:
    """The protocol of a run, as it was then. Raises `BadInput` when it is neither on record nor still the same."""
    record = RunFolder.open(folder).record
    identity, content = record.identity, record.about.protocol
    name, _, version = identity.protocol.partition("@")
    if content is None:
        protocol = load_protocol(name, identity.profile)
    else:
        protocol = protocol_from(dict(content), identity.profile, version)
    if protocol.digest != identity.protocol_digest:
        raise BadInput(f"{folder}: its protocol {identity.protocol} is not on record and is another one now")
    return protocol


def reopen_scene(folder: Path, data: Path | None, body: Path | None) -> tuple[OccludedScene, Body]:
    """The scene of a run, with its truth, and the body. Raises `BadInput` when the data are not those of the run."""
    protocol, capture = reopen_protocol(folder), reopen_capture(folder, data, body)
    on_record = RunFolder.open(folder).identity.data
    if capture_digest(capture, protocol) not in on_record:
        raise BadInput(
            f"{folder}: the data of {capture.name} are not those that the run was made on; name its --data"
        )
    scene = open_scene(capture, protocol)
    if scene.hiding.in_scene != protocol.occlusion.in_scene:
        raise BadInput(
            f"{folder}: was scored as if its occluder, which stands in the scene, hid nothing of the test images; "
            "run it again"
        )
    return scene, reopen_body(folder, data, body)


def _record(folder: Path) -> RunRecord:
    """The record of a run that says what it was made on. Raises `BadInput` for one that does not."""
    record = RunFolder.open(folder).record
    if found := outcome_fault(record):
        raise BadInput(f"{folder / 'run.json'}: {found}; run the same command with --force")
    return record
