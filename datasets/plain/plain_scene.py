"""A documented folder for people's own videos: read, check and write. `plain_scene.md` beside this file describes it.

images/000000.png              one camera; images/<camera>/000000.png with several; .png, .jpg or .jpeg
masks/…                        the same paths as .png, non-zero = person
cameras.json                   K, R, t (metres, world -> camera, OpenCV axes), size, distortion of every camera
poses.npz                      SMPL poses, shapes and translations, one row a frame
body.npz                       optional: the body they belong to, as `ihbench.body.write_body` writes it
scene.json                     optional: {"name": …, "about": …}
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body, from_zju_root, load_body, zju_root
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import pose_hint
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, check_intrinsics, check_rotation
from ihbench.datasets.reading.capture_folder import PICTURES, CaptureFolder, Picture, picture_files
from ihbench.datasets.reading.plausibility import SOFT_VALUES, Outline
from ihbench.datasets.reading.standin_mark import STANDIN_FILE
from ihbench.datasets.reading.stored_numbers import numbers
from ihbench.datasets.reading.subject_folders import SubjectFolders, View
from ihbench.errors import BadInput, BadValue
from ihbench.files import atomic
from ihbench.files.npz import read_npz, write_npz
from ihbench.files.pictures import read_mask, read_rgb, write_picture
from ihbench.files.spelling import as_stored, missing_file, same_name
from ihbench.registry import nearest
from ihbench.scene.copy_report import SubjectReport

Array = NDArray[np.float64]

CAMERAS_FILE, POSES_FILE, BODY_FILE, SCENE_FILE = "cameras.json", "poses.npz", "body.npz", "scene.json"
CAMERA_KEYS = ("K", "R", "t", "width", "height", "distortion", "pixel_center")
POSE_KEYS = ("frames", "pose", "betas", "transl", "root")
ROOTS = ("smpl", "zju")
LARGEST_POSES = 2**28  # bytes of one array in poses.npz: 460 000 frames
SMPL_PELVIS = (0.0, -0.24, 0.03)  # m, about, in SMPL's rest pose; only `check` uses it


class PlainScene(SubjectFolders["PlainCapture"]):
    """A scene folder, or a folder that holds several. A subject is named by scene.json, else by its folder.

    Without the SMPL model of the poses and body.npz, `check` takes the bench's own body in mean shape ("body_used"):
    good for units, axes and flips. An occluded person has few of the body's vertices in the mask; wrong cameras,
    units or poses also leave little of the mask on the body. A person who stands upright in the middle of a picture
    has no mirror image to tell apart.
    """

    dataset, layout = "custom", "plain"
    content = f"a scene ({CAMERAS_FILE} and {POSES_FILE}), or several"
    whole = None  # nobody says whether something hides parts of the person

    @staticmethod
    def holds(folder: Path) -> bool:
        return any(as_stored(folder / name).is_file() for name in (CAMERAS_FILE, POSES_FILE))

    def name_of(self, folder: Path) -> str:
        return read_about(folder)["name"]

    def capture(self, subject: str, body: Body | None) -> PlainCapture:
        return PlainCapture(self._folders[subject], subject, body)

    def inspect(self, capture: PlainCapture, report: SubjectReport) -> list[View]:
        _check_files(capture, report)
        cameras, frames = range(len(capture.camera_ids)), range(capture.n_frames)
        return [(camera, frame) for camera in cameras for frame in frames if not capture.lacks(camera, frame)]

    def bodies(self, capture: PlainCapture, report: SubjectReport) -> tuple[Callable[[int], Outline] | None, bool]:
        """The bench's body stands in SMPL's place where that is not at hand."""
        try:
            report.body_used = capture.model.name
            return super().bodies(capture, report)
        except BadInput:
            if capture.body != "smpl":
                raise
        report.body_used = "procedural, in SMPL's place"
        model = load_body()
        return lambda frame: Outline(model.pose(_like_smpl(capture, frame, model)), model.faces), False


class PlainCapture(CaptureFolder):
    """One scene, read lazily; see `scene.contracts.Capture`.

    Frames are the rows of poses.npz by frame number, but for rows whose number no image has (`without_image`).
    """

    dataset = "custom"
    variant = "plain"
    size_source = f"{CAMERAS_FILE} says"

    def __init__(self, folder: Path, name: str, body: Body | None = None):
        has_own_body = as_stored(folder / BODY_FILE).is_file()
        root = folder if (folder / STANDIN_FILE).is_file() else folder.parent
        super().__init__(folder, name, None if has_own_body else body, root)
        self.about: str = read_about(folder)["about"]
        self._cameras = read_cameras(as_stored(folder / CAMERAS_FILE))
        self._poses = read_poses(as_stored(folder / POSES_FILE))
        self.camera_ids = tuple(self._cameras)
        self._listings: dict[tuple[str, int], dict[int, list[Path]]] = {}
        numbers = [int(number) for number in self._poses.frames]
        self.n_frames = len(numbers)
        pictured = {*chain(*(self.files("images", camera) for camera in range(len(self.camera_ids))))}
        kept = [row for row, number in enumerate(numbers) if number in pictured]
        if self.standin or not kept:  # a stand-in lacks images that were not asked for
            kept = list(range(len(numbers)))
        self.without_image = [number for number in numbers if number not in pictured]
        self._poses = self._poses.rows(kept)
        self.n_frames = len(kept)
        if has_own_body:
            self.body = "own"
            if body is not None and body.content_sha() != self.model.content_sha():
                raise BadInput(
                    f"{folder / BODY_FILE}: the scene has its own body, but another ({body.name}) was given; "
                    f"give no body file, or move {BODY_FILE} away"
                )

    @cached_property
    def model(self) -> Body:
        """body.npz where there is one, else as in other captures. Raises `BadInput`."""
        if self.body != "own":
            return super().model
        return replace(load_body(as_stored(self.folder / BODY_FILE)), name="own")

    @property
    def has_model(self) -> bool:
        return self.body == "own" or super().has_model

    def camera(self, camera: int) -> Camera:
        self.check_index(camera, 0)
        return self._cameras[self.camera_ids[camera]]

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters in the standard root convention."""
        self.check_index(0, frame)
        stored = self.stored_pose(frame)
        if self._poses.root == "smpl":
            return stored
        pose = stored.pose.copy()
        pose[0] = 0
        model = self.model
        try:
            return from_zju_root(pose, stored.betas, stored.pose[0], stored.transl, model)
        except BadInput as error:
            raise BadInput(f"{self.folder / POSES_FILE}: {error}") from error

    def image(self, camera: int, frame: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB, as stored; an alpha channel is dropped."""
        return self._read("images", camera, frame, read_rgb)

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W] non-zero in masks/. `source` is "mask", there is no other."""
        self.check_source(source)
        return self._read("masks", camera, frame, lambda path: read_mask(path, "non-zero"))

    def content_digest(self, camera: int, frame: int, source: str = "mask") -> bytes:
        """Hash of the bytes of one view's image and mask file; a missing file counts as empty."""
        number, digest = self.number(frame), hashlib.sha256()
        for kind in ("images", "masks") if source == "mask" else ("images",):
            for path in self.files(kind, camera).get(number, []):
                digest.update(path.read_bytes() if path.is_file() else b"")
            digest.update(kind.encode())
        return digest.digest()

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        number = self.number(frame)
        listings = [self.files(kind, camera).get(number, []) for kind in ("images", "masks")]
        if not all(listings):
            raise BadInput(f"{self.folder}: no image or mask of frame {number}")
        return tuple(path for paths in listings for path in paths)

    def stored_pose(self, frame: int) -> BodyPose:
        self.check_index(0, frame)
        return BodyPose(self._poses.pose[frame], self._poses.betas[frame], self._poses.transl[frame])

    def label(self, frame: int) -> str:
        return str(self.number(frame))

    def number(self, frame: int) -> int:
        """The number that the frame's files carry."""
        self.check_index(0, frame)
        return int(self._poses.frames[frame])

    def picture_folder(self, kind: str, camera: int) -> Path:
        """Where a camera's files of a kind ("images", "masks") lie: a lone camera needs no folder of its own."""
        folder = as_stored(self.folder / kind)
        own = as_stored(folder / self.camera_ids[camera])
        return own if len(self.camera_ids) > 1 or own.is_dir() else folder

    def files(self, kind: str, camera: int) -> dict[int, list[Path]]:
        """Frame number -> files of that number (one, unless something is wrong), listed once."""
        self.check_index(camera, 0)
        key = kind, camera
        if key not in self._listings:
            listing: dict[int, list[Path]] = {}
            endings = PICTURES if kind == "images" else (".png",)
            for path in picture_files(self.picture_folder(kind, camera), endings):
                if _is_number(path.stem):
                    listing.setdefault(int(path.stem), []).append(path)
            self._listings[key] = listing
        return self._listings[key]

    def _read(self, kind: str, camera: int, frame: int, read: Callable[[Path], Picture]) -> Picture:
        number = self.number(frame)
        paths = self.files(kind, camera).get(number, [])
        if len(paths) > 1:
            names = " and ".join(path.name for path in paths)
            raise BadInput(f"{paths[0].parent}: {names} are both frame {number}; keep one of them")
        if not paths:
            path = self.picture_folder(kind, camera) / f"{number:06d}.png"
            or_else = " or .jpg" if kind == "images" else ""
            raise BadInput(f"{path}{or_else}: no such file; {POSES_FILE} has frame {number}{self.standin_hint}")
        return self.check_size(paths[0], read(paths[0]), camera)


def _is_number(stem: str) -> bool:
    return re.fullmatch(r"[0-9]{1,18}", stem) is not None


def read_about(folder: Path) -> dict[str, str]:
    """{"name", "about"} of scene.json; the folder's name and "" where it says nothing. Raises `BadInput`."""
    path = as_stored(folder / SCENE_FILE)
    content = atomic.read_json(path) if path.is_file() else {}
    if not isinstance(content, dict) or not all(isinstance(content.get(key, ""), str) for key in ("name", "about")):
        raise BadInput(f'{path}: expected {{"name": text, "about": text}}, found other contents')
    name = unicodedata.normalize("NFC", content.get("name", folder.absolute().name))
    if not re.fullmatch(r"[^/\\\x00-\x1f.][^/\\\x00-\x1f]{0,79}", name):
        raise BadInput(f"{path}: name {name!r}: expected 1 to 80 characters, no slash, no dot in front; rename it")
    return {"name": name, "about": content.get("about", "")}


# --------------------------------------------------------------------------------------------- cameras


def read_cameras(path: Path) -> dict[str, Camera]:
    """The views by camera id, in the file's order. Raises `BadInput` naming the camera and key that is wrong."""
    if not path.is_file():
        raise missing_file(path, "expected the K, R, t, width and height of every camera in it")
    content = atomic.read_json(path)
    cameras = content.get("cameras") if isinstance(content, dict) else None
    if not isinstance(cameras, dict) or not cameras:
        raise BadInput(f'{path}: expected {{"cameras": {{"<id>": {{"K": …, "R": …, "t": …}}}}}}, found no camera')
    for key in content:
        if key != "cameras":
            raise BadInput(f"{path}: unknown key {key!r} beside 'cameras'; remove it or move it into each camera")
    return {name: _camera(name, entry, path) for name, entry in cameras.items()}


def _camera(name: str, entry: Any, path: Path) -> Camera:
    if not re.fullmatch(r"[^/\\\x00-\x1f.][^/\\\x00-\x1f]*", name):
        raise BadInput(f"{path}: camera id {name!r}: expected a folder's name, no slash, no dot in front")
    where = f"{path}: camera {name!r}"
    if not isinstance(entry, dict):
        raise BadInput(f"{where}: expected a dictionary with {', '.join(CAMERA_KEYS[:5])}")
    for key in entry:
        if key not in CAMERA_KEYS:
            raise BadInput(f"{where}: unknown key {key!r}: {nearest(key, list(CAMERA_KEYS))}")
    width, height = (_pixels(entry, key, where) for key in ("width", "height"))
    K, R, t = (numbers(entry, key, shape, where) for key, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))))
    check_intrinsics(K, f"{where}: K")
    check_rotation(R, f"{where}: R", 1e-3)
    lens = None if entry.get("distortion") is None else numbers(entry, "distortion", (5,), where)
    center = entry.get("pixel_center", 0.0)
    if isinstance(center, bool) or center not in (0, 0.5):
        raise BadInput(f"{where}: pixel_center: expected 0.0 or 0.5, the centre of the first pixel; found {center!r}")
    K[:2, 2] += 0.5 - center
    return Camera(K, R, t, width, height, lens if lens is not None and lens.any() else None)


def _pixels(entry: Mapping[str, object], key: str, where: str) -> int:
    value = entry.get(key)
    if type(value) is not int or not 0 < value <= 2**16:
        raise BadInput(f"{where}: {key}: expected a whole number of pixels, found {_shown(value)}")
    return value


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"


# ----------------------------------------------------------------------------------------------- poses


@dataclass(frozen=True)
class Poses:
    """poses.npz, checked and sorted by frame number."""

    frames: NDArray[np.int64]  # [N] numbers of the image files
    pose: Array  # [N, 24, 3] rad
    betas: Array  # [N, B]
    transl: Array  # [N, 3] m
    root: str  # "smpl", or "zju": pose[:, 0] and transl are ZJU-MoCap's Rh and Th
    numbered: bool  # the file says the numbers; else they count from 0

    def rows(self, kept: list[int]) -> Poses:
        """Some of the rows."""
        frames, pose, betas, transl = (a[kept] for a in (self.frames, self.pose, self.betas, self.transl))
        return replace(self, frames=frames, pose=pose, betas=betas, transl=transl)


def read_poses(path: Path) -> Poses:
    """The SMPL parameters of every frame. Raises `BadInput` naming the array that is not as expected."""
    if not path.is_file():
        raise missing_file(path, "expected the poses of every frame in it")
    arrays = read_npz(path, largest=LARGEST_POSES)
    for key in arrays:
        if key not in POSE_KEYS:
            raise BadInput(f"{path}: unknown array {key!r}: {nearest(key, list(POSE_KEYS))}")
    for key in ("pose", "betas", "transl"):
        if key not in arrays:
            raise BadInput(f"{path}: no array {key!r}; expected pose [N, 72], betas [B] and transl [N, 3]")
    pose, betas, transl = (_floats(arrays, key, path) for key in ("pose", "betas", "transl"))
    n = len(pose) if pose.ndim else 0
    if n == 0 or pose.shape not in ((n, 72), (n, 24, 3)):
        raise BadInput(
            f"{path}: pose: expected shape [N, 72] or [N, 24, 3], found {list(pose.shape)}{pose_hint(pose.shape[1:])}"
        )
    if transl.shape != (n, 3):
        raise BadInput(f"{path}: transl: expected shape [{n}, 3], a row for each pose, found {list(transl.shape)}")
    if betas.ndim == 1:
        betas = betas[None]
    if betas.ndim != 2 or len(betas) not in (1, n) or betas.shape[1] == 0:
        raise BadInput(f"{path}: betas: expected shape [B] or [{n}, B], found {list(arrays['betas'].shape)}")
    largest = np.abs(pose).max()
    if largest > 20:
        raise BadInput(f"{path}: pose: expected radians, found {largest:.3g}; multiply by π/180 if it is in degrees")
    root = arrays.get("root", np.array("smpl"))
    if root.shape != () or root.dtype.kind != "U" or str(root) not in ROOTS:
        raise BadInput(f"{path}: root: expected one text, {' or '.join(ROOTS)}, found {_shown(root.tolist())}")
    frames = _frame_numbers(arrays.get("frames"), n, path)
    order = np.argsort(frames)
    betas = np.broadcast_to(betas, (n, betas.shape[1]))
    return Poses(
        frames[order], pose.reshape(n, 24, 3)[order], betas[order], transl[order], str(root), "frames" in arrays
    )


def _frame_numbers(frames: NDArray | None, n: int, path: Path) -> NDArray[np.int64]:
    if frames is None:
        return np.arange(n)
    if frames.shape != (n,) or frames.dtype.kind not in "iu":
        raise BadInput(
            f"{path}: frames: expected {n} whole numbers, one a pose, found {frames.dtype} {list(frames.shape)}"
        )
    if int(frames.min()) < 0 or int(frames.max()) >= 10**18:
        raise BadInput(f"{path}: frames: expected numbers of image files, found {frames.min()} to {frames.max()}")
    numbers, counts = np.unique(frames, return_counts=True)
    if (counts > 1).any():
        raise BadInput(f"{path}: frames: number {numbers[counts > 1][0]} appears twice; give each frame one pose")
    return frames.astype(np.int64)


def _floats(arrays: dict[str, NDArray], key: str, path: Path) -> Array:
    value = arrays[key]
    if value.dtype.kind not in "iuf":
        raise BadInput(f"{path}: {key}: expected numbers, found {value.dtype}")
    bad = np.argwhere(~np.isfinite(value))
    if len(bad):
        row = f" in row {bad[0][0]}" if value.ndim else ""
        raise BadInput(
            f"{path}: {key}: NaN or infinity{row}; expected finite numbers; leave "
            f"such rows out and write the frame numbers of the others as 'frames'"
        )
    return value.astype(np.float64)


# ----------------------------------------------------------------------------------------------- check


def _check_files(capture: PlainCapture, report: SubjectReport) -> None:
    _check_numbers(capture, report)
    posed = {capture.number(frame) for frame in range(capture.n_frames)}
    counts = {"image": 0, "mask": 0}
    missing = {"image": 0, "mask": 0, "pose": 0}
    for camera, name in enumerate(capture.camera_ids):
        images, masks = (capture.files(kind, camera) for kind in ("images", "masks"))
        here = "" if len(capture.camera_ids) == 1 else f" of camera {name!r}"
        counts["image"] += len(images)
        counts["mask"] += len(masks)
        missing["pose"] += len(images.keys() - posed)
        if poseless := images.keys() - posed:
            what = f"{len(poseless)} images{here} have no pose in {POSES_FILE} and are not used"
            report.warn(f"{what}; the first is frame {min(poseless)}")
        lacks = {
            "image": (posed - images.keys(), f"poses have no image{here}"),
            "mask": (images.keys() & posed - masks.keys(), f"images{here} have no mask"),
        }
        for what, (lacking, text) in lacks.items():
            missing[what] += len(lacking)
            if lacking and not (capture.standin and what == "image"):
                report.problem(
                    f"{len(lacking)} {text}; the first is frame {min(lacking)}: copy the files, or leave "
                    f"these frames out of {POSES_FILE}"
                )
        for kind, listing in (("images", images), ("masks", masks)):
            for number, paths in listing.items():
                if len(paths) > 1:
                    names = " and ".join(path.name for path in paths)
                    report.problem(f"{paths[0].parent}: {names} are both frame {number}; keep one of them")
            pictures = picture_files(capture.picture_folder(kind, camera))
            png_only = kind == "masks"
            odd = [p for p in pictures if not _is_number(p.stem) or (png_only and p.suffix.lower() != ".png")]
            if odd:
                ending = "png" if png_only else "png or .jpg"
                report.problem(f"{odd[0]}: {len(odd)} such names are ignored; expected <frame number>.{ending}")
    report.files, report.missing = counts, missing
    for kind in ("images", "masks"):
        folder = as_stored(capture.folder / kind)
        if not folder.is_dir():
            report.problem(f"{folder}: no such folder")
        elif len(capture.camera_ids) > 1:
            known = {same_name(name) for name in capture.camera_ids}
            strays = sorted(f.name for f in folder.iterdir() if f.is_dir() and same_name(f.name) not in known)
            for stray in strays:
                report.problem(f"{folder / stray}: {CAMERAS_FILE} has no camera of this name")


def _check_numbers(capture: PlainCapture, report: SubjectReport) -> None:
    """Whether the rows of poses.npz and the files of the images count the same frames."""
    pictured = sorted({*chain(*(capture.files("images", camera) for camera in range(len(capture.camera_ids))))})
    rows = sorted({*capture.without_image, *(capture.number(frame) for frame in range(capture.n_frames))})
    if not pictured or pictured == rows or capture.standin:
        return
    if not set(pictured) & set(rows) or (not capture._poses.numbered and len(pictured) == len(rows)):
        without = "" if capture._poses.numbered else ", since it has no array 'frames'"
        report.problem(
            f"{capture.folder / POSES_FILE}: its {len(rows)} rows are of frames {rows[0]} to {rows[-1]}{without}, "
            f"but the {len(pictured)} images are numbered {pictured[0]} to {pictured[-1]}; write the image's number "
            f"of each row as 'frames'"
        )
    elif capture.without_image:
        report.warn(
            f"{len(capture.without_image)} poses have no image and are not used; the first is frame "
            f"{capture.without_image[0]}"
        )


def _like_smpl(capture: PlainCapture, frame: int, model: Body) -> BodyPose:
    """The pose that puts the bench's mean body where SMPL's mean body is."""
    stored = capture.stored_pose(frame)
    pelvis = np.array(SMPL_PELVIS)
    if capture._poses.root == "zju":
        pelvis = axis_angle_to_matrix(stored.pose[0]) @ pelvis
    return BodyPose(stored.pose, np.zeros(1), stored.transl + pelvis - model.joints[0])


# ----------------------------------------------------------------------------------------------- write


def write_cameras(folder: Path, cameras: Mapping[str, Camera], pixel_center: float = 0.0) -> None:
    """cameras.json; `read_cameras` undoes it. `pixel_center` is what the file's K calls it."""
    if pixel_center not in (0.0, 0.5):
        raise ValueError(f"pixel_center {pixel_center}: expected 0.0 or 0.5")
    entries = {}
    for name, camera in cameras.items():
        K = camera.K_opencv if pixel_center == 0 else camera.K
        entries[name] = {"K": K, "R": camera.R, "t": camera.t, "width": camera.width, "height": camera.height}
        entries[name]["pixel_center"] = pixel_center
        if camera.distortion is not None:
            entries[name]["distortion"] = camera.distortion
    atomic.write_json(Path(folder) / CAMERAS_FILE, {"cameras": entries})


def write_poses(
    folder: Path,
    body_poses: Sequence[BodyPose],
    frames: Sequence[int] | None = None,  # numbers of the image files, default 0, 1, …
    root: str = "smpl",
    body: Body | None = None,
) -> None:
    """poses.npz; `PlainCapture.body_pose` undoes it. `root="zju"` stores Rh and Th, which need the `body`."""
    if root not in ROOTS or (root == "zju" and body is None):
        raise ValueError(f"root {root!r}: expected 'smpl', or 'zju' with the body")
    pose = np.stack([p.pose for p in body_poses])
    transl = np.stack([p.transl for p in body_poses])
    if root == "zju":
        assert body is not None
        transl = np.stack([zju_root(p, body)[1] for p in body_poses])
    arrays: dict[str, NDArray] = {
        "frames": np.arange(len(pose)) if frames is None else np.asarray(frames, np.int64),
        "pose": pose,
        "betas": np.stack([p.betas for p in body_poses]),
        "transl": transl,
        "root": np.array(root),
    }
    if len(arrays["frames"]) != len(pose):
        raise ValueError(f"poses: expected {len(pose)} frame numbers, got {len(arrays['frames'])}")
    write_npz(Path(folder) / POSES_FILE, arrays)


def write_frame(
    folder: Path,
    number: int,
    image: NDArray[np.uint8] | None = None,  # [H, W, 3] RGB
    mask: NDArray | None = None,  # [H, W] non-zero = person
    camera_id: str | None = None,  # None: the only camera, without a folder of its own
    ending: str = "png",
) -> None:
    """The picture files of one camera at one frame: PNG, or JPEG with `ending="jpg"`. None is not written.

    Arrays, tensors and PIL pictures are taken. Raises `ValueError` for another layout or type, for a mask that is not
    of the image's size, and for a soft one: every pixel above 0 would be person.
    """
    place = Path(folder)
    image, mask = as_array(image), as_mask(mask)
    subfolder = camera_id or "."
    if image is not None:
        if mask is not None and mask.shape != image.shape[:2]:
            sizes = f"{list(image.shape[:2])} like the image, got {list(mask.shape)}"
            raise BadValue(f"frame {number}: expected a mask {sizes}")
        write_picture(place / "images" / subfolder / f"{number:06d}.{ending}", image)
    if mask is not None:
        write_picture(place / "masks" / subfolder / f"{number:06d}.png", (mask != 0) * np.uint8(255))


def as_array(picture: Any) -> NDArray | None:
    """A picture as numpy has it, of a tensor or PIL's too; None stays None."""
    if hasattr(picture, "detach"):  # a torch tensor; torch itself is not imported for this
        picture = picture.detach().cpu().numpy()
    return None if picture is None else np.asarray(picture)


def as_mask(mask: Any) -> NDArray | None:
    """[H, W] of labels, 0 where the person is not. Raises `ValueError` for another layout and for a soft mask."""
    array = as_array(mask)
    if array is None:
        return None
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[..., 0]
    if array.ndim == 3 and array.shape[2] == 3 and array.dtype.kind in "bui":
        array = array.max(2)
    if array.ndim != 2 or array.dtype.kind not in "buif":
        raise BadValue(f"mask: expected [H, W], non-zero for the person, got {array.dtype} {list(array.shape)}")
    values = np.unique(array)
    if (array.dtype.kind == "f" and (values != np.rint(values)).any()) or len(values) > SOFT_VALUES:
        word = "mask > 0.5" if values[-1] <= 1 else "mask > 127"
        raise BadValue(
            f"mask: soft, {len(values)} different values, and all above 0 are person; threshold it: {word}"
        )
    return array
