"""OcMotion as its authors released it: read and check the folder with `annot/`.

    annot/train.pkl, annot/test.pkl     [sequence][camera][frame] = {img_path, h_w, "0": person, "1": person, …}
    images/0011/02/00001.jpg            whatever img_path says, relative to the folder that holds annot/
    masks/0011/02/00001.png             not part of the release: the visible person, made by the user

A person is {bbox [2, 2], lsp_joints_2d [n, 2+], pose 72, betas 10, trans 3, intri [3, 3], extri [4, 4]}. The camera
is OpenCV's (integer pixel centres, world to camera, metres) without distortion; vertices are
SMPL(betas, pose) + trans in the world, standard root. Masks lie at masks/ + img_path without a leading images/ and
with the suffix .png, non-zero (channel 0 of several) where the person is visible; for further people of an image the
name ends in _p1, _p2, ….

Source: boycehbz/CHOMP vis_OcMotion.py. What the `_w2a` sequences share with this layout is here, too.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.reading.capture_folder import CaptureFolder
from ihbench.datasets.reading.plausibility import readable
from ihbench.datasets.reading.stored_numbers import FARTHEST, check_calibration, described, numbers
from ihbench.datasets.reading.subject_folders import SubjectFolders, View, count_files
from ihbench.errors import BadInput
from ihbench.files.paths import user_path
from ihbench.files.pictures import read_mask
from ihbench.files.safe_pickle import load_pickle
from ihbench.scene.copy_report import SubjectReport

Array = NDArray[np.float64]
OneCapture = TypeVar("OneCapture", bound="OneCameraCapture")

SPLITS = ("train", "test")
SAME_CAMERA = 1e-4  # largest difference between frames, relative to the largest entry of K, R and t
LARGEST_ROTATION = 4 * np.pi  # rad of one joint; a fit may wind once around, degrees go further


class OneCameraCapture(CaptureFolder):
    """A person before one fixed camera, one image and one visible mask a frame. Keeps no images."""

    dataset = "ocmotion"
    visible_masks = True
    silhouettes = ("visible", "mask")  # two names of one thing
    frame_names: tuple[str, ...]
    _K: Array  # [3, 3] px, OpenCV's
    _E: Array  # [4, 4] world to camera, m
    _images: tuple[Path, ...]
    _masks: tuple[Path, ...]
    _annotated_size: tuple[int, int] | None = None  # px, width and height, where the format has them

    def camera(self, camera: int) -> Camera:
        """The calibrated view; no distortion."""
        self.check_index(camera, 0)
        return Camera.from_opencv(self._K, self._E[:3, :3], self._E[:3, 3], *self._image_size)

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W] the visible person: what furniture hides is False. `source` is "visible" or, the same, "mask"."""
        self.check_source(source)
        path = self.mask_path(camera, frame)
        # OccFusion reads a palette's red
        return self.read_picture(path, camera, lambda path: read_mask(path, "first channel"), self._mask_hint)

    @staticmethod
    def digest_prefix(size: int) -> bytes:
        return f"{size} ".encode()

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        return self.image_path(camera, frame), self.mask_path(camera, frame)

    def label(self, frame: int) -> str:
        return self.frame_names[frame]

    def image_path(self, camera: int, frame: int) -> Path:
        self.check_index(camera, frame)
        return self._images[frame]

    def mask_path(self, camera: int, frame: int) -> Path:
        self.check_index(camera, frame)
        return self._masks[frame]

    _mask_hint = "expected the visible mask, non-zero where the person is seen"

    def image_size(self, camera: int) -> tuple[int, int]:
        """(width, height) px, as annotated, else of the first image on disk."""
        return self._image_size

    @cached_property
    def _image_size(self) -> tuple[int, int]:
        return self._annotated_size or self.size_of_first(self._images, 0)


class Sequences(SubjectFolders[OneCapture], Generic[OneCapture]):
    """What the two layouts report of a sequence: its files, and the poses that cannot be used."""

    dataset = "ocmotion"
    whole = False  # furniture hides parts of the person

    def inspect(self, capture: OneCapture, report: SubjectReport) -> list[View]:
        frames = range(capture.n_frames)
        images, masks = ({f: path(0, f) for f in frames} for path in (capture.image_path, capture.mask_path))
        there = count_files(report, {"image": images, "mask": masks})
        posed = readable(frames, capture.body_pose, lambda frame: f"frame {frame}", report).keys()
        return sorted((0, frame) for frame in there["image"] & there["mask"] & posed)


# ---------------------------------------------------------------------------------- the original layout


class OcMotionOriginal(Sequences["OcMotionCapture"]):
    """The folder that holds `annot/train.pkl` or `annot/test.pkl`.

    A subject is one person before one camera, named after the folders of the images: "0011_02", and "0011_02_p1" for
    a further person of the same images. The annotations of the whole release (300,000 images) take minutes to read;
    they are read once a process, when the first subject is asked for.
    """

    layout = "original"

    def __init__(self, root: Path):
        """Raises `BadInput` when there is no annotation file; does not read them."""
        self.root = user_path(root)
        if not self.holds(self.root):
            below = next((path.parent.parent for path in sorted(self.root.glob("*/annot/*.pkl"))), None)
            where = f"there is one in {below}, give that folder" if below else "expected the original release"
            raise BadInput(f"{self.root}: no annot/train.pkl or annot/test.pkl in it; {where}")

    @staticmethod
    def holds(folder: Path) -> bool:
        return any((folder / "annot" / f"{split}.pkl").is_file() for split in SPLITS)

    def subjects(self) -> list[str]:
        """Sorted names. Raises `BadInput` for annotations of another structure."""
        return sorted(self._subjects)

    def capture(self, subject: str, body: Body | None) -> OcMotionCapture:
        return OcMotionCapture(self.root, subject, self._subjects[subject], body)

    @cached_property
    def _subjects(self) -> dict[str, _Track]:
        tracks: dict[str, _Track] = {}
        paths = [path for path in (self.root / "annot" / f"{split}.pkl" for split in SPLITS) if path.is_file()]
        for path in paths:
            file = path.stat()
            for name, track in _tracks(path, (file.st_ino, file.st_mtime_ns, file.st_size)).items():
                tracks[f"{name}_{path.stem}" if name in tracks else name] = track
        if not tracks:
            raise BadInput(f"{paths[0]}: no person in any frame; expected the annotations of OcMotion")
        return tracks


class OcMotionCapture(OneCameraCapture):
    """One person before one camera of the original release, read lazily; see `scene.contracts.Capture`.

    Its frames are those that annotate the person, in the order of the annotations.
    """

    variant = "original"
    _mask_hint = (
        "the OcMotion release has no visible masks: make them and put each one here, 8-bit, non-zero where the "
        "person is seen"
    )

    def __init__(self, root: Path, name: str, track: _Track, body: Body | None = None):
        super().__init__(root, name, body, root)
        self.person = track.person
        paths = [_image_name(frame, where) for frame, where in track.frames]
        image, times = Counter(paths).most_common(1)[0]
        if times > 1:
            raise BadInput(
                f"{track.path}: image {image} is listed {times} times for {name}; expected each frame once"
            )
        self.frame_names = tuple(PurePosixPath(path).stem for path in paths)
        self.n_frames = len(paths)
        self.camera_ids = (PurePosixPath(paths[0]).parent.name or "camera",)
        self._images = tuple(root / path for path in paths)
        self._masks = tuple(root / mask_file(path, track.suffix) for path in paths)
        self._annotated_size = _one_size(track)
        self._people = [({str(k): frame[k] for k in frame}[track.person], where) for frame, where in track.frames]
        self._K, self._E = one_camera(self._people, "intri", "extri")

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters: standard root, world, metres."""
        self.check_index(0, frame)
        person, where = self._people[frame]
        return metric_pose(
            numbers(person, "pose", (24, 3), where),
            numbers(person, "betas", (10,), where),
            numbers(person, "trans", (3,), where),
            where,
        )


@dataclass(frozen=True)
class _Track:
    """The frames of one person before one camera as they stand in an annotation file, their contents unchecked."""

    path: Path
    person: str  # its key in the frames
    suffix: str  # of its mask files: "" for the first person of the images
    frames: list[tuple[dict, str]]  # with the place, for messages: "annot/train.pkl: sequence 0, camera 1, frame 2"


@lru_cache(maxsize=len(SPLITS))  # a run asks for the same folder several times
def _tracks(path: Path, _version: tuple[int, int, int]) -> dict[str, _Track]:
    """Subjects of one annotation file; another version of the file is another call."""
    content = load_pickle(path)
    tracks: dict[str, _Track] = {}
    for s, cameras in enumerate(_listed(content, f"{path}", "a list of sequences")):
        for c, frames in enumerate(_listed(cameras, f"{path}: sequence {s}", "a list of cameras")):
            where = f"{path}: sequence {s}, camera {c}"
            frames = _listed(frames, where, "a list of frames")
            for f, frame in enumerate(frames):
                if not isinstance(frame, dict) or not {"img_path", "h_w"} <= frame.keys():
                    raise BadInput(
                        f"{where}, frame {f}: expected a dictionary with img_path, h_w and one entry a person, "
                        f"found {described(frame)}"
                    )
            people = {str(key) for frame in frames for key in frame} - {"img_path", "h_w"}
            people = sorted(people, key=lambda key: (not key.isdecimal(), len(key), key))  # 10 after 9
            for k, person in enumerate(people):
                own = [(frame, f"{where}, frame {f}") for f, frame in enumerate(frames) if person in map(str, frame)]
                suffix = f"_p{person}" if k else ""
                folder = PurePosixPath(_image_name(*own[0])).parent
                name = "_".join(_without_images(folder).parts) or f"{s:04d}_{c:02d}"
                if name + suffix in tracks:
                    raise BadInput(
                        f"{where}: its images lie in {folder}, as do those of another camera of this file; "
                        f"expected one folder for each camera"
                    )
                tracks[name + suffix] = _Track(path, person, suffix, own)
    return tracks


def _listed(value: Any, where: str, expected: str) -> list:
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if not isinstance(value, list | tuple):
        raise BadInput(f"{where}: expected {expected}, found {described(value)}; get OcMotion's annot/ again")
    return list(value)


def _image_name(frame: dict, where: str) -> str:
    """The image's path below the root. Raises `BadInput` when it leads out of it."""
    path = frame["img_path"]
    if not isinstance(path, str) or not path.strip():
        raise BadInput(f"{where}: expected the image's path in 'img_path', found {described(path)}")
    path = path.replace("\\", "/")  # annotations were made on Windows, too
    if path.startswith("/") or path[1:2] == ":" or "\0" in path or ".." in path.split("/"):
        raise BadInput(f"{where}: img_path {path!r} leads out of the data folder; expected a path below it")
    return PurePosixPath(path).as_posix()


def _one_size(track: _Track) -> tuple[int, int]:
    """(width, height) px of all frames."""
    sizes = np.stack([numbers(frame, "h_w", (2,), where) for frame, where in track.frames]).astype(int)
    for size, (_, where) in zip(sizes, track.frames, strict=True):
        if (size != sizes[0]).any() or size.min() < 1:
            raise BadInput(
                f"{where}: h_w is {tuple(size.tolist())}, {tuple(sizes[0].tolist())} at the first frame; expected "
                f"one (height, width) px for a camera"
            )
    return int(sizes[0, 1]), int(sizes[0, 0])


def mask_file(img_path: str, suffix: str = "") -> str:
    """Where the visible mask of an image belongs; `suffix` is "_p1" for a further person "1"."""
    path = _without_images(PurePosixPath(img_path))
    return (PurePosixPath("masks") / path.with_name(f"{path.stem}{suffix}.png")).as_posix()


def _without_images(path: PurePosixPath) -> PurePosixPath:
    return PurePosixPath(*path.parts[1:]) if path.parts[:1] == ("images",) else path


# ------------------------------------------------------------------------------- checked values of both


def metric_pose(pose: Array, betas: Array, trans: Array, where: str) -> BodyPose:
    """SMPL parameters in radians and metres. Raises `BadInput` for those that are in degrees or millimetres."""
    turn = np.linalg.norm(pose, axis=1).max()
    if turn > LARGEST_ROTATION:
        raise BadInput(
            f"{where}: a joint turned by {turn:.3g} rad; expected axis-angle rotations in radians, convert them if "
            f"these are degrees"
        )
    if np.abs(trans).max() > FARTHEST:
        raise BadInput(
            f"{where}: the body stands {np.abs(trans).max():.4g} from the origin; expected metres, divide 'trans' by "
            f"1000 if it is in millimetres"
        )
    return BodyPose(pose, betas, trans)


def one_camera(
    entries: Sequence[tuple[Mapping, str]],  # of the frames, with their places
    intrinsics: str,
    extrinsics: str,
) -> tuple[Array, Array]:
    """K [3, 3] and E [4, 4] under these keys, checked, when all frames have that camera. Raises `BadInput`."""
    K = np.stack([numbers(entry, intrinsics, (3, 3), where) for entry, where in entries])
    E = np.stack([numbers(entry, extrinsics, (4, 4), where) for entry, where in entries])
    check_calibration(K[0], E[0], entries[0][1])
    differences = np.zeros(len(K))
    for value in (K, E[:, :3, :3], E[:, :3, 3], E[:, 3]):
        value = value.reshape(len(K), -1)
        # t counts from 1 m: a camera at the origin has no size to compare with
        differences = np.maximum(differences, np.abs(value - value[0]).max(1) / max(1.0, np.abs(value[0]).max()))
    other = int(differences.argmax())
    if differences[other] > SAME_CAMERA:
        raise BadInput(
            f"{entries[other][1]}: its camera differs from the first frame's by {differences[other]:.2g} (relative); "
            f"expected one fixed camera for all frames"
        )
    return K[0], E[0]


def three_channels(
    mask: NDArray,  # [H, W]
) -> NDArray[np.uint8]:
    """[H, W, 3], 255 where the mask is non-zero: OccFusion takes channel 0."""
    return np.repeat((mask != 0)[..., None] * np.uint8(255), 3, 2)


def ten_betas(body_pose: BodyPose) -> Array:
    """[10] the shape coefficients, filled up with zeros. Raises `ValueError` when there are more."""
    if body_pose.betas[10:].any():
        raise ValueError(f"OcMotion: expected at most 10 shape coefficients, got {len(body_pose.betas)}")
    return np.concatenate([body_pose.betas, np.zeros(10)])[:10]
