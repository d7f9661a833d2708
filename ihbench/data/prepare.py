"""Handing out a protocol's occluded training set in a layout that other people's released code reads.

What is written is what a method of the bench is given, pixel for pixel: undistorted, resampled images with hidden
pixels painted, masks of visible person pixels, the cameras and body poses of the training views; and the cameras and
poses of the test views, without which nobody could draw them. Nothing that the protocol hides is in any file. The
body poses are those that the data set ships, which were fitted to un-occluded images, as in every released protocol.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from glob import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.clock.progress import Progress
from ihbench.config_fields import as_json, read
from ihbench.errors import BadInput
from ihbench.files import atomic, locks, removal
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.views import OccludedScene
from ihbench.version import __version__

MANIFEST = "manifest.json"
TEST_VIEWS = "test_views.json"
PIXEL_CENTER = 0.0  # of K in test_views.json, as OpenCV
CONVENTIONS = (  # of every row of test_views.json
    "K: px, the centre of the first pixel at (pixel_center, pixel_center); where yours is at (0.5, 0.5) add 0.5 to "
    "cx and cy. distortion: OpenCV's k1 k2 p1 p2 k3. x_camera = R x_world + t, metres, x right, y down, z forward. "
    "pose: axis-angle, radians, root first. The root is SMPL's own (pose, transl) or ZJU-MoCap's (Rh, Th): "
    "v = R(Rh) v0 + Th, v0 with a zero root. Draw width x height px, sRGB, on background (RGB in [0, 1]), or "
    "transparent."
)
UNKNOWN_FOLDER = "unknown"  # masks of what the occluder hides, beside the layout's own files


@dataclass(frozen=True)
class HandedView:
    """One training view as it is handed out. Views are numbered from 0; the manifest says which frame each is."""

    number: int
    image: NDArray[np.uint8]  # [H, W, 3] RGB, hidden pixels painted with the protocol's background
    visible: NDArray[np.bool_]  # [H, W] visible person
    camera: Camera  # without lens distortion
    body_pose: BodyPose


@dataclass(frozen=True)
class Handout:
    """What a training layout's writer gets; it looks at the views once, in order."""

    folder: Path  # to write into
    name: str  # the scene's
    n_views: int
    views: Callable[[], Iterator[HandedView]]
    cameras: list[Camera]  # of the views
    body_poses: list[BodyPose]  # of the views
    body: Body


@dataclass(frozen=True)
class ManifestView:
    """What the manifest says of a training view."""

    number: int
    frame: int
    camera: str
    covered: bool
    camera_sha256: str
    pose_sha256: str
    mask_sha256: str


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """manifest.json: what a folder holds, and everything that decides which numbers drawings of it get."""

    made_by: str
    protocol: str  # with version and changes
    protocol_digest: str
    profile: str
    content: Mapping[str, Any] = field(default_factory=dict)  # the protocol's
    dataset: str
    variant: str
    standin: str  # "" for real data
    scene: str
    layout: str
    body: str  # hash of the body model
    data: str | None  # where the user's copy lies and their body file, as seen from the folder
    body_file: str | None
    occlusion: Mapping[str, Any]  # its rule, and what that has drawn
    masks: str  # what they show
    body_poses: str  # what they were fitted to
    train: tuple[ManifestView, ...]
    test: str  # file of the test views
    files: Mapping[str, str]  # path in the folder -> SHA-256, of all but the manifest


def read_manifest(path: Path) -> Manifest:
    """Raises `BadInput` for a file that `prepare` has not written."""
    content = atomic.read_json(path)
    try:
        manifest: Manifest = read(Manifest, content, "", strict=False)
        if not manifest.made_by.startswith("ihbench "):
            raise BadInput(f"made by {manifest.made_by[:60]!r}")
    except BadInput as error:
        raise BadInput(
            f"{path}: is no manifest of `ihbench prepare` ({error}); name the folder that it has written"
        ) from error
    return manifest


TrainingLayout = Callable[[Handout], Path]  # writes the files and returns the subject's folder


def prepare(
    scene: OccludedScene,
    body: Body,
    out: Path,
    layout: str,
    progress: Progress,
    force: bool = False,
    sources: Sequence[Path] = (),
    data: Path | None = None,  # the user's own copy, and their body file: where `score` will look for the truth
    body_file: Path | None = None,
) -> Path:
    """Write one scene's training set below `out` and return its folder `out`/NAME, with manifest and test views.

    The folder appears when it is complete. `force` replaces a folder that holds what an earlier call wrote and
    nothing else; `sources` are places that are only read, such as the data. Raises `BadInput` as `check_target` does,
    and for an unknown layout.
    """
    write: TrainingLayout = registry.load("training layout", layout)
    check_target(out, scene.capture.name, force, sources)
    target = out / scene.capture.name
    partial = out / f".{scene.capture.name}.{secrets.token_hex(4)}.partial"
    before, lock = partial.with_suffix(".before"), partial.with_suffix(".lock")
    try:
        with locks.locked(lock, "name another folder with --out"):
            _remove_leftovers(out, scene.capture.name)
            lies = _from(target, data), _from(target, body_file)
            _write(scene, body, partial, layout, write, progress, *lies)
            if target.exists():
                check_target(out, scene.capture.name, force, sources)  # again: meanwhile anything may have come there
                os.rename(target, before)
            os.rename(partial, target)
            if before.exists():
                removal.remove_written(before, _written_there(before))
                before.rmdir()
    except OSError as error:
        raise BadInput(f"{target}: cannot be written ({error.strerror or error}); name another folder") from error
    finally:
        removal.discard(partial)
        removal.discard_file(lock)
        if before.exists() and not target.exists():
            os.rename(before, target)
    return target


def _remove_leftovers(out: Path, name: str) -> None:
    """Remove what earlier calls left that were killed; what is being written now is locked."""
    for left in out.glob(f".{escape(name)}.{8 * '[0-9a-f]'}.*"):
        lock = left.with_suffix(".lock")
        if left.suffix not in (".partial", ".before", ".lock") or locks.is_held(lock):
            continue
        if left.suffix == ".partial":
            removal.discard(left)
        elif left.suffix == ".before" and not _not_ours(left):
            removal.remove_written(left, _written_there(left))
            removal.discard(left)
        elif left.suffix == ".lock":
            removal.discard_file(lock)


def check_target(out: Path, name: str, force: bool, sources: Sequence[Path]) -> None:
    """Raise `BadInput` where `prepare` may not write `out`/NAME: in the data or around them; and where something is,
    unless `force` is given and it is what an earlier call wrote, every file as its manifest has it."""
    target = out / name
    removal.check_apart(target, sources, "the training set")
    if not os.path.lexists(target):
        return
    try:
        problem = _not_ours(target)
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
    if problem:
        raise BadInput(
            f"{target}: is there already and not just what ihbench prepare wrote ({problem}); "
            f"name another folder with --out"
        )
    if not force:
        raise BadInput(f"{target}: is there already; name another folder with --out, or --force to replace it")
    removal.check_no_home(target)


def _not_ours(target: Path) -> str:
    """What speaks against a folder's being what an earlier call wrote, and empty where nothing does."""
    if target.is_symlink() or not target.is_dir():
        return "it is no folder" if target.exists() and not target.is_dir() else "it is a link"
    try:
        ours = _written_there(target)
    except BadInput as error:
        return str(error)
    stranger = removal.foreign(target, ours)
    return "" if stranger is None else f"{stranger.relative_to(target)} is not as its manifest has it"


def _written_there(folder: Path) -> removal.Ours:
    """Whether a file in a folder is the one that an earlier call wrote there, to the last bit. Raises `BadInput`
    where no earlier call wrote the folder."""
    path = folder / MANIFEST
    if path.is_symlink() or not path.is_file():
        raise BadInput(f"it has no {MANIFEST}")
    files = read_manifest(path).files
    folders = {parent for file in files for parent in Path(file).parents}

    def ours(file: Path) -> bool:
        if file.as_posix() == MANIFEST:
            return True
        if (folder / file).is_dir():
            return file in folders
        sha = files.get(file.as_posix())
        return sha is not None and sha == hashlib.sha256((folder / file).read_bytes()).hexdigest()

    return ours


def _from(folder: Path, path: Path | None) -> str | None:
    """A path as seen from a folder, so that both may move together and neither tells where they lie."""
    return None if path is None else Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _write(
    scene: OccludedScene,
    body: Body,
    folder: Path,
    layout: str,
    write: TrainingLayout,
    progress: Progress,
    data: str | None,  # as the manifest has them
    body_file: str | None,
) -> None:
    views: list[TrainView] = scene.train  # type: ignore[assignment]
    folder.mkdir(parents=True)
    cameras, poses, rows = [], [], []
    for k, view in enumerate(views):
        cameras.append(view.camera)
        poses.append(view.body_pose)
        mask_sha = hashlib.sha256(np.ascontiguousarray(view.mask).tobytes()).hexdigest()
        hashes = _sha_of(_camera_words(view.camera)), _sha_of(_pose_words(view.body_pose)), mask_sha
        rows.append(ManifestView(k, view.frame, view.camera_id, scene.hiding.covered[k], *hashes))

    def handed() -> Iterator[HandedView]:
        with progress.task(f"handing out {scene.capture.name}", len(views)) as task:
            for number, view in enumerate(views):
                yield HandedView(number, view.image, view.mask == MaskState.PERSON, view.camera, view.body_pose)
                task.advance()

    try:
        own = write(Handout(folder, scene.capture.name, len(views), handed, cameras, poses, body))
    except ValueError as error:
        raise BadInput(
            f"layout {layout!r} cannot hold {scene.capture.name}: {error}; choose another --layout"
        ) from error
    from ihbench.files.images import write_png

    for number, view in enumerate(views):
        unknown = np.repeat(((view.mask == MaskState.UNKNOWN) * np.uint8(255))[..., None], 3, axis=2)
        write_png(own / UNKNOWN_FOLDER / f"{number:06d}.png", unknown)
    atomic.write_json(folder / TEST_VIEWS, list(_test_views(scene, body)))
    protocol, capture = scene.protocol, scene.capture
    fitted_to = "whatever they were fitted to" if scene.hiding.in_scene else "fitted to un-occluded images"
    files = {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }
    manifest = Manifest(
        made_by=f"ihbench {__version__}",
        protocol=protocol.name, protocol_digest=protocol.digest, profile=protocol.profile, content=protocol.content,
        dataset=capture.dataset, variant=capture.variant, standin=capture.standin, scene=capture.name,
        layout=layout, body=body.content_sha(), data=data, body_file=body_file,
        occlusion={"rule": scene.hiding.occlusion.rule, **scene.hiding.occlusion.record},
        masks=f"visible person; {UNKNOWN_FOLDER}/ shows what is hidden: person or background, nobody knows",
        body_poses=f"as the data set ships them, {fitted_to}",
        train=tuple(rows), test=TEST_VIEWS, files=files,
    )  # fmt: skip
    atomic.write_json(folder / MANIFEST, as_json(manifest))


def _test_views(scene: OccludedScene, body: Body) -> Iterator[dict[str, object]]:
    """The cameras and poses to draw, and the file names under which `ihbench score` looks for the drawings."""
    from ihbench.body import zju_root
    from ihbench.scene.views import straight_camera

    for key in scene.test_keys:
        camera = straight_camera(scene.capture.camera(key.camera), scene.protocol.image)
        pose = scene.capture.body_pose(key.frame)
        Rh, Th = zju_root(pose, body)
        yield {
            "prediction": f"{scene.capture.name}/{key.name}.png",
            "camera": key.camera_id,
            "frame": key.frame,
            **_camera_words(camera),
            **_pose_words(pose),
            "Rh": Rh.tolist(),
            "Th": Th.tolist(),
            "distortion": [0.0] * 5 if camera.distortion is None else camera.distortion.tolist(),
            "background": list(scene.protocol.image.background),
            "pixel_center": PIXEL_CENTER,
            "conventions": CONVENTIONS,
        }


def _camera_words(camera: Camera) -> dict[str, object]:
    """Plain numbers; K with OpenCV's pixel centres at integers."""
    return {
        "K": camera.K_opencv.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "width": camera.width,
        "height": camera.height,
    }


def _pose_words(pose: BodyPose) -> dict[str, object]:
    return {"pose": pose.pose.tolist(), "betas": pose.betas.tolist(), "transl": pose.transl.tolist()}


def _sha_of(words: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()
