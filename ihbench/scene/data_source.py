"""Where a protocol's captures come from: the user's own copy, or the stand-in that is made once and kept."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench import registry
from ihbench.body import Body, load_body
from ihbench.clock.progress import Progress
from ihbench.config_fields import LARGEST_CAST, refuse_repeated
from ihbench.errors import BadInput
from ihbench.files.paths import cache_folder, path_from, user_path
from ihbench.scene.contracts import Capture, Dataset
from ihbench.scene.protocol import Protocol

if TYPE_CHECKING:
    from ihbench.scene.views import TestViewKey

STANDIN_SEED = 0
NEARBY = 200  # folders that are looked into for data that were not where they were said to be


def own_data(data: Path | None) -> Path | None:
    """The user's copy: `--data`, else `IHBENCH_DATA`, else None. Raises `BadInput` when it is not a folder."""
    named = user_path(data, "data folder") if data is not None else path_from("IHBENCH_DATA")
    if named is not None and not named.is_dir():
        state = "is a file" if named.is_file() else "does not exist"
        raise BadInput(f"data folder {named}: {state}; give the folder of your copy with --data or IHBENCH_DATA")
    return named


def own_body(body: Path | None) -> Path | None:
    """The user's SMPL file: `--body`, else `IHBENCH_BODY`, else None."""
    return user_path(body, "body file") if body is not None else path_from("IHBENCH_BODY")


@dataclass(frozen=True)
class DataSource:
    """The captures a protocol runs on."""

    protocol: Protocol
    root: Path  # where they lie, or will lie
    is_standin: bool  # made by the bench for this protocol
    scenes: tuple[str, ...]

    def open(self, scene: str, body: Path | None, progress: Progress) -> tuple[Capture, Body]:
        """One capture and the body model of its poses. Makes the stand-in's missing images first.

        Raises `BadInput` where the capture does not have the views that the protocol asks for.
        """
        if self.is_standin:
            standin = registry.load("stand-in", self.protocol.dataset)
            self.protocol.check_views(scene, standin.n_frames, standin.n_cameras, f"stand-in {scene}")
            standin.ensure(self.root, STANDIN_SEED, [scene], wanted_frames(self.protocol, standin), progress)
        capture, model = open_capture(self.protocol.dataset, self.root, scene, body)
        where = f"{capture.dataset} {capture.name}"
        self.protocol.check_views(capture.name, capture.n_frames, len(capture.camera_ids), where)
        return capture, model

    def test_keys(self, scene: str) -> tuple[TestViewKey, ...]:
        """The test views of a scene. No image is read, and none made of a stand-in. Raises `BadInput` as `open`."""
        from ihbench.scene.views import test_view_keys

        if self.is_standin:
            standin = registry.load("stand-in", self.protocol.dataset)
            n_frames, camera_ids = standin.n_frames, standin.camera_ids(scene)
        else:
            capture = registry.load("dataset", self.protocol.dataset)(self.root).open(scene)
            n_frames, camera_ids = capture.n_frames, capture.camera_ids
        self.protocol.check_views(scene, n_frames, len(camera_ids), f"{self.protocol.dataset} {scene}")
        return test_view_keys(self.protocol, scene, n_frames, camera_ids)

    def exists(self, scene: str) -> bool:
        """Whether the capture is on disk (for a stand-in: whether a run has made it before)."""
        try:
            return scene in registry.load("dataset", self.protocol.dataset)(self.root).subjects()
        except BadInput:
            return False


def open_dataset(name: str, root: Path) -> Dataset:
    """A data set in a folder. Raises `BadInput` for a folder without it, naming one nearby that has it."""
    try:
        return registry.load("dataset", name)(root)
    except BadInput as error:
        known = "give that folder" in str(error) or is_about_a_file(error, root)
        other = None if known else folder_nearby(root, (name,))
        if other is None:
            raise
        raise BadInput(f"{error}; did you mean {other}?") from error


def is_about_a_file(error: BadInput, root: Path) -> bool:
    """Whether a data set's complaint is about something in its folder, and not that the folder is none of its own."""
    return str(error).startswith((f"{root}/", f"{root.absolute()}/"))


def folder_nearby(root: Path, datasets: Iterable[str]) -> Path | None:
    """The folder above or below that holds one of these data sets: one level too high or too low is soon given."""
    here = root.absolute()
    try:
        below = [folder for pattern in ("*", "*/*") for folder in sorted(here.glob(pattern)) if folder.is_dir()]
    except OSError:
        below = []
    for folder in (*below[:NEARBY], *list(here.parents)[:2]):
        for name in () if folder.name.startswith((".", "__MACOSX")) else datasets:
            with suppress(BadInput):
                registry.load("dataset", name)(folder)
                return folder
    return None


def locate(protocol: Protocol, data: Path | None, scenes: tuple[str, ...]) -> DataSource:
    """Find the data of a protocol. No `scenes` means all that the protocol names (of a user's copy: those present).

    Of a stand-in any person may be named: standin-1, standin-2, …

    Raises `BadInput` for unknown scenes, with the nearest known one.
    """
    root = own_data(data)
    if root is not None:
        names = open_dataset(protocol.dataset, root).subjects()
        scenes = tuple(unicodedata.normalize("NFC", scene) if scene not in names else scene for scene in scenes)
        known = [s for s in protocol.subjects.names if s in names] or names
        return DataSource(protocol, root, False, _chosen(scenes, known, names, f"in {root}"))
    if protocol.dataset not in registry.names("stand-in"):
        raise BadInput(
            f"protocol {protocol.name}: data set {protocol.dataset!r} has no stand-in; give your copy with --data"
        )
    known = list(protocol.subjects.standin)
    cast = registry.load("stand-in", protocol.dataset).subjects(LARGEST_CAST)
    names = [*known, *(scene for scene in scenes if scene in cast and scene not in known)]
    root = standin_root(protocol.dataset)
    return DataSource(protocol, root, True, _chosen(scenes, known, names, "of the stand-in (no --data given)"))


def standin_root(dataset: str) -> Path:
    """Where the stand-in of a data set lies, or will lie."""
    # a new generator or body makes other people: they get a folder of their own instead of a refusal
    made_by = f"v{registry.load('stand-in', dataset).version}-{load_body().content_sha()[:6]}"
    return cache_folder() / "standin" / f"{dataset}-{made_by}-seed{STANDIN_SEED}"


def open_capture(dataset: str, root: Path, scene: str, body: Path | None) -> tuple[Capture, Body]:
    """Open one capture with the body its poses belong to.

    The bench's own body for stand-ins, the capture's own where its folder holds one; else the SMPL file at `body` or
    `IHBENCH_BODY`, which may be a folder with a file for each gender. Raises `BadInput` when that is missing.
    """
    source = registry.load("dataset", dataset)(root)
    capture = source.open(scene)
    if capture.body in ("procedural", "own"):
        return capture, capture.model
    named = own_body(body)
    if named is None:
        raise BadInput(
            f"{dataset} {scene}: its poses need the SMPL model file (SMPL_NEUTRAL.pkl, from smpl.is.tue.mpg.de); "
            f"name it with --body or IHBENCH_BODY"
        )
    model = load_body(body_file(named, getattr(capture, "gender", "neutral")))
    return source.open(scene, body=model), model


def body_file(named: Path, gender: str) -> Path:
    """The SMPL file itself, or of a folder of them the one of this gender (neutral where there is no such file).

    Known names: SMPL_MALE.pkl and its like, basicModel_m_lbs_10_207_0_v1.0.0.pkl. Raises `BadInput` for a folder
    without either.
    """
    if not named.is_dir():
        return named
    for kind in (gender, "neutral"):
        for pattern in (f"smpl_{kind}.", f"basicmodel_{kind}_", f"basicmodel_{kind[0]}_"):
            for path in sorted(named.iterdir()):
                if path.name.lower().startswith(pattern) and path.suffix.lower() in (".pkl", ".npz"):
                    return path
    raise BadInput(f"{named}: no SMPL file for gender {gender!r} in it; expected SMPL_{gender.upper()}.pkl")


def wanted_frames(protocol: Protocol, standin: type) -> dict[int, list[int]]:
    """Camera index -> frames that a protocol reads of every stand-in subject."""
    n_frames, n_cameras = standin.n_frames, standin.n_cameras
    (subject,) = standin.subjects(1)  # all of a cast have the same frames
    frames_of: dict[int, set[int]] = {protocol.train.camera: set(protocol.training_frames(subject, n_frames))}
    for camera, frame, _ in protocol.test_views(subject, n_frames, n_cameras):
        frames_of.setdefault(camera, set()).add(frame)
    return {camera: sorted(frames) for camera, frames in frames_of.items()}


def _chosen(scenes: tuple[str, ...], known: list[str], found: list[str], where: str) -> tuple[str, ...]:
    refuse_repeated(scenes, "--scene")
    for scene in scenes:
        if scene not in found:
            raise BadInput(f"unknown scene {scene!r} {where}: {registry.nearest(scene, found)}")
    return scenes or tuple(known)
