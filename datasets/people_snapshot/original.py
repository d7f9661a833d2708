"""PeopleSnapshot as it was released: read, check and write one folder a subject, e.g. `male-3-casual`.

    <subject>.mp4                the video of the one camera, lens distortion in
    camera.pkl                   camera_f, camera_c (2), camera_k (5, OpenCV), camera_t, camera_rt (3), width, height
    masks.hdf5                   masks [N, H, W], 1 = person
    reconstructed_poses.hdf5     pose [M, 72] rad, trans [M, 3] m, betas [10], standard SMPL root
    consensus.pkl                betas [10], v_personal [6890, 3] m; not used here
    keypoints.hdf5               keypoints [N, 54], 18 OpenPose joints of (x px, y px, confidence); not used here

Sources: thmoa/videoavatars prepare_data/ and step1_pose.py, zju3dv/neuralbody tools/process_snapshot.py,
tijiang13/InstantAvatar scripts/peoplesnapshot/. The poses belong to the gendered SMPL models. There may be more poses
than masks: NeuralBody pairs the masks with the last poses, InstantAvatar with the first. Where a body model is at
hand the silhouettes decide (`PeopleSnapshotCapture.alignment`).
"""

from __future__ import annotations

import hashlib
import re
import tempfile
import threading
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, lru_cache
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera
from ihbench.datasets.reading.capture_folder import BY_OPTIONS, CaptureFolder
from ihbench.datasets.reading.pickles import write_pickle
from ihbench.datasets.reading.plausibility import share_inside, some
from ihbench.datasets.reading.stored_numbers import check_calibration, numbers
from ihbench.datasets.reading.subject_folders import SubjectFolders, View
from ihbench.errors import BadInput
from ihbench.files import atomic, npz
from ihbench.files.pictures import above_half, one_line
from ihbench.files.safe_pickle import load_pickle
from ihbench.files.spelling import missing_file
from ihbench.scene.copy_report import SubjectReport

if TYPE_CHECKING:
    import h5py

CAMERA_FILE, MASKS_FILE, POSES_FILE = "camera.pkl", "masks.hdf5", "reconstructed_poses.hdf5"
CONSENSUS_FILE, KEYPOINTS_FILE = "consensus.pkl", "keypoints.hdf5"
CAMERA_SIZES = {"camera_f": 2, "camera_c": 2, "camera_k": 5, "camera_t": 3, "camera_rt": 3, "width": 1, "height": 1}
N_KEYPOINTS = 18
KEPT_PICTURES = 4
CHUNK_CACHE = 64 << 20  # bytes; the released masks are stored in chunks of many frames
COMPARED_FRAMES = 5
CLEARLY_BETTER = 0.002  # share of vertices by which the last poses must beat the first

Poses = tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]
]  # pose [N, 72] rad, trans [N, 3] m, betas [10]


class PeopleSnapshotRaw(SubjectFolders["PeopleSnapshotCapture"]):
    """A folder that holds subjects' folders of the released layout, or one of those folders itself."""

    dataset, layout = "people_snapshot", "raw"
    content = f"the released PeopleSnapshot layout ({CAMERA_FILE}, {MASKS_FILE}, {POSES_FILE})"

    @staticmethod
    def holds(folder: Path) -> bool:
        return sum((folder / name).is_file() for name in (CAMERA_FILE, MASKS_FILE, POSES_FILE)) >= 2

    def capture(self, subject: str, body: Body | None) -> PeopleSnapshotCapture:
        return PeopleSnapshotCapture(self._folders[subject], body)

    def inspect(self, capture: PeopleSnapshotCapture, report: SubjectReport) -> list[View]:
        """Decodes the video up to the last of the frames that are looked at."""
        report.gender = capture.gender
        counts = {"video": capture.video.n_frames, "masks": capture.n_masks, "poses": capture.n_poses}
        report.files = dict(counts)
        report.missing = {name: max(0, capture.n_masks - counts[name]) for name in ("video", "poses")}
        if len(set(counts.values())) > 1:
            report.warn(
                f"{counts['video']} frames of video, {counts['masks']} masks, {counts['poses']} poses: what goes "
                f"beyond the {capture.n_frames} that all have is not used; right if the same first frames were kept "
                f"of each"
            )
        shares = capture.alignment_shares
        overlaps = {name: round(shares[name], 4) if shares else None for name in ("first", "last")}
        report.alignment = {"chosen": capture.alignment, **overlaps}
        pose, trans, betas = capture._poses
        report_spoiled_rows(report, capture.folder / POSES_FILE, pose, trans)
        if (consensus := capture.folder / CONSENSUS_FILE).is_file():
            report.files["consensus"] = 1
            try:
                report.consensus_betas = round(float(np.abs(read_consensus(consensus)[0] - betas).max()), 4)
            except BadInput as error:
                report.problem(str(error))
        if (keypoints := capture.folder / KEYPOINTS_FILE).is_file():
            try:
                report.files["keypoints"] = len(read_keypoints(keypoints))
            except BadInput as error:
                report.problem(str(error))
        return [(0, frame) for frame in range(capture.n_frames)]


class SnapshotFolder(CaptureFolder):
    """What the layouts of PeopleSnapshot share: one camera, one kind of silhouette, a gender in the name."""

    dataset = "people_snapshot"
    camera_ids = ("camera",)

    @property
    def gender(self) -> str:
        """ "female" or "male" by the folder's name, else "neutral": the SMPL model that the poses belong to."""
        words = re.split(r"[^a-z]+", self.name.lower())
        return next((word for word in words if word in ("female", "male")), "neutral")


class SnapshotPictures(SnapshotFolder):
    """A layout with an image and a mask file for each frame."""

    @abstractmethod
    def image_path(self, frame: int) -> Path:
        """Raises `BadInput` for a frame that the copy does not list."""

    @abstractmethod
    def mask_path(self, frame: int) -> Path: ...

    @staticmethod
    @abstractmethod
    def read_mask(path: Path) -> NDArray[np.bool_]:
        """[H, W], True = person. Raises `BadInput`."""

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W], True where the stored mask is above one half. `source` is "mask"."""
        self.check_index(camera, frame)
        self.check_source(source)
        return self.read_picture(self.mask_path(frame), camera, self.read_mask, f"expected the mask of frame {frame}")

    @staticmethod
    def digest_prefix(size: int) -> bytes:
        return size.to_bytes(8, "little")

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        return self.image_path(frame), self.mask_path(frame)


class PeopleSnapshotCapture(SnapshotFolder):
    """One subject, read lazily; see `scene.contracts.Capture`. Keeps the last few decoded frames."""

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name, body)
        self._camera = read_camera(folder / CAMERA_FILE)
        self._masks = MaskFile(folder / MASKS_FILE)
        self._poses = read_poses(folder / POSES_FILE)
        self.video = Video(video_path(folder))
        expected = self._camera.height, self._camera.width
        for path, size in ((self._masks.path, self._masks.shape[1:]), (self.video.path, self.video.size)):
            if size != expected:
                raise BadInput(
                    f"{path}: {size[1]}×{size[0]} px, but {CAMERA_FILE} says {expected[1]}×{expected[0]} px; "
                    f"expected one size, copy both files again"
                )
        self.n_masks, self.n_poses = self._masks.shape[0], len(self._poses[0])
        self.n_frames = min(self.video.n_frames, self.n_masks, self.n_poses)

    @property
    def variant(self) -> str:
        return f"{PeopleSnapshotRaw.layout}/{self.alignment}"

    @property
    def alignment(self) -> str:
        """Which poses belong to the masks: "equal" (as many), or the "first" or "last" of more poses.

        With a body model the overlap of its vertices with the silhouettes decides; without one it is "first".
        """
        if self.n_poses == self.n_masks:
            return "equal"
        shares = self.alignment_shares
        return "last" if shares and shares["last"] > shares["first"] + CLEARLY_BETTER else "first"

    @cached_property
    def alignment_shares(self) -> dict[str, float]:
        """The share of vertices in the silhouettes under both alignments; empty without a choice or a body model.

        Taken over the frames where the two differ most, since a body that stands still fits either way.
        """
        surplus = self.n_poses - self.n_masks
        if surplus <= 0 or not self.has_model:
            return {}
        pose, trans, _ = self._poses
        candidates = np.unique(np.linspace(0, self.n_frames - 1, 64).astype(int))
        change = np.abs(pose[candidates] - pose[candidates + surplus]).sum(1)
        change += 10 * np.abs(trans[candidates] - trans[candidates + surplus]).sum(1)
        candidates, change = candidates[np.isfinite(change)], change[np.isfinite(change)]
        frames = candidates[np.argsort(-change, kind="stable")[:COMPARED_FRAMES]].tolist()
        if not frames:
            return {}
        shares = {}
        for name, offset in (("first", 0), ("last", surplus)):
            points = [self._camera.project(self.model.pose(self._stored_pose(frame + offset))) for frame in frames]
            inside = [share_inside(p, self.silhouette(0, f)) for p, f in zip(points, frames, strict=True)]
            shares[name] = float(np.mean(inside))
        return shares

    def camera(self, camera: int) -> Camera:
        """The one camera, with its lens distortion."""
        self.check_index(camera, 0)
        return self._camera

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters (standard root convention), by `alignment`."""
        self.check_index(0, frame)
        return self._stored_pose(frame + (self.n_poses - self.n_masks if self.alignment == "last" else 0))

    def _stored_pose(self, index: int) -> BodyPose:
        return finite_pose(self.folder / POSES_FILE, index, *self._poses)

    def image(self, camera: int, frame: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB, decoded from the video. Fast when frames are asked for in order."""
        self.check_index(camera, frame)
        return self.check_size(self.video.path, self.video.frame(frame))

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W]. `source` is "mask"."""
        self.check_index(camera, frame)
        self.check_source(source)
        return self._masks.frame(frame)

    def content_digest(self, camera: int, frame: int, source: str = "mask") -> bytes:
        """Hash of the video file, the mask file and the frame number: frames have no bytes of their own in either."""
        self.check_index(camera, frame)
        digest = hashlib.sha256(f"{source} {frame}".encode())
        for path in (self.video.path, self._masks.path):
            with suppress(OSError):
                state = path.stat()
                digest.update(_file_digest(path, state.st_size, state.st_mtime_ns))
        return digest.digest()


@lru_cache(maxsize=64)
def _file_digest(path: Path, _size: int, _mtime: int) -> bytes:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def video_path(folder: Path) -> Path:
    """`<subject>.mp4`, or the only .mp4 of a folder that was renamed. Raises `BadInput` when there is none."""
    path = folder / f"{folder.name}.mp4"
    if path.is_file():
        return path
    others = [other for other in sorted(folder.iterdir()) if other.suffix.lower() == ".mp4" and other.name[0] != "."]
    if len(others) == 1:
        return others[0]
    instead = f"{len(others)} other .mp4 files, none of this name" if others else "no .mp4 file"
    raise missing_file(path, f"expected the subject's video, found {instead}; copy it here")


def report_spoiled_rows(report: SubjectReport, path: Path, *arrays: NDArray) -> None:
    """Name the rows of a file's arrays [N, …] that hold NaN or infinity, if there are any."""
    bad = [~np.isfinite(array.reshape(len(array), -1)).all(1) for array in arrays]
    rows = np.flatnonzero(np.any(bad, axis=0)).tolist()
    if rows:
        state = f"NaN or infinity in {len(rows)} row{'s' * (len(rows) > 1)} ({some([str(row) for row in rows])})"
        report.problem(f"{path}: {state}; leave these out {BY_OPTIONS}")


# ---------------------------------------------------------------------------------------------- the files


def read_camera(path: Path) -> Camera:
    """The camera of camera.pkl with its lens distortion. Raises `BadInput` naming the entry that is not as expected.

    `camera_t` m and `camera_rt` rad (world to camera) are zeros in the release, and when they are missing.
    """
    if not path.is_file():
        raise missing_file(path, "expected the camera's parameters in it")
    content = load_pickle(path)
    if not isinstance(content, dict):
        raise BadInput(f"{path}: expected a dictionary with camera_f, camera_c, …, found a {type(content).__name__}")
    content = {"camera_t": np.zeros(3), "camera_rt": np.zeros(3)} | content
    values = {key: numbers(content, key, (size,), path) for key, size in CAMERA_SIZES.items()}
    width, height = float(values["width"][0]), float(values["height"][0])
    if not (width.is_integer() and height.is_integer() and 1 <= width <= 65535 and 1 <= height <= 65535):
        raise BadInput(f"{path}: expected width and height in whole pixels, found {width:g} and {height:g}")
    focal, centre = values["camera_f"], values["camera_c"]
    if (focal <= 0).any():
        raise BadInput(f"{path}: expected positive focal lengths in 'camera_f', found {focal.tolist()}")
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    R = axis_angle_to_matrix(values["camera_rt"])
    return Camera.from_opencv(K, R, values["camera_t"], int(width), int(height), values["camera_k"])


def read_poses(path: Path) -> Poses:
    """The poses of the release; they may hold NaN. Raises `BadInput` for other shapes."""
    names = ("pose", "trans", "betas")
    with _hdf5(path) as file:
        return stored_poses({name: _dataset(file, name, path)[()] for name in names}, path, *names)


def stored_poses(content: Mapping[str, Any], path: Path, pose: str, trans: str, betas: str) -> Poses:
    """(pose [N, 72] rad, trans [N, 3] m, betas [10]) under these names; poses may hold NaN. Raises `BadInput`."""
    poses, places = numbers(content, pose, (-1, 72), path, False), numbers(content, trans, (-1, 3), path, False)
    if len(poses) != len(places):
        raise BadInput(f"{path}: expected one {trans!r} for each {pose!r}, found {len(places)} and {len(poses)}")
    return poses, places, numbers(content, betas, (10,), path)


def finite_pose(path: Path, index: int, pose: NDArray, trans: NDArray, betas: NDArray) -> BodyPose:
    """Row `index` of pose [M, 72] and trans [M, 3]. Raises `BadInput` when it holds NaN or infinity."""
    for name, value in (("pose", pose[index]), ("trans", trans[index])):
        if not np.isfinite(value).all():
            raise BadInput(f"{path}: NaN or infinity in the {name} of row {index}; leave this frame out {BY_OPTIONS}")
    return BodyPose(pose[index].reshape(24, 3), betas, trans[index])


def read_consensus(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(betas [10], v_personal [V, 3] m: offsets of the template's vertices). Raises `BadInput`."""
    content = load_pickle(path)
    return numbers(content, "betas", (10,), path), numbers(content, "v_personal", (-1, 3), path)


def read_keypoints(path: Path) -> NDArray[np.float64]:
    """[N, 18, 3]: x px, y px (OpenCV's integer pixel centres), confidence. Raises `BadInput`."""
    with _hdf5(path) as file:
        content = {"keypoints": _dataset(file, "keypoints", path)[()]}
        return numbers(content, "keypoints", (-1, 3 * N_KEYPOINTS), path, False).reshape(-1, N_KEYPOINTS, 3)


def read_npz(path: Path, expected: str) -> dict[str, NDArray]:
    """The arrays by name. Raises `BadInput` for a missing or damaged file."""
    if not path.is_file():
        raise missing_file(path, f"expected {expected} in it")
    return npz.read_npz(path)


def stored_pinhole(stored: Mapping[str, Any], path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K [3, 3] px and E [4, 4] world to camera of a cameras.npz, whose extrinsic may lack its last row. Raises
    `BadInput`."""
    K = numbers(stored, "intrinsic", (3, 3), path)
    short = np.shape(stored.get("extrinsic", ())) == (3, 4)
    E = numbers(stored, "extrinsic", (3, 4) if short else (4, 4), path)
    E = np.concatenate([E[:3], [[0, 0, 0, 1]]]) if short else E
    check_calibration(K, E, path)
    return K, E


def soft_mask(values: NDArray, where: object) -> NDArray[np.bool_]:
    """Where a mask [H, W] of 0 to 1 or of 0 to 255 is above one half. Raises `BadInput` for other numbers."""
    lowest, highest = float(values.min()), float(values.max())
    if not (np.isfinite([lowest, highest]).all() and lowest >= -0.01 and highest <= 255):
        raise BadInput(f"{where}: expected 0 to 1, or 0 to 255, found {lowest:g} to {highest:g}")
    # a soft mask of 0 to 1 may overshoot a little where it was resampled
    return above_half(values, 1 if highest <= 1.5 else 255)


@contextmanager
def _hdf5(path: Path) -> Iterator[h5py.File]:
    with _damage_named(path), _opened_hdf5(path) as file:
        yield file


def _opened_hdf5(path: Path) -> h5py.File:
    import h5py

    if not path.is_file():
        raise missing_file(path, "expected an HDF5 file of the PeopleSnapshot release")
    return h5py.File(path, "r", locking=False, rdcc_nbytes=CHUNK_CACHE)  # locks fail on read-only network disks


@contextmanager
def _damage_named(what: object) -> Iterator[None]:
    """What h5py raises of damaged files becomes `BadInput`."""
    try:
        with np.errstate(invalid="ignore"):  # NaN of other kinds; whoever asks looks for NaN
            yield
    except (OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise BadInput(f"{what} is damaged or cut short ({one_line(error)}); copy the file again") from error


def _dataset(file: h5py.File, name: str, path: Path) -> h5py.Dataset:
    import h5py

    own = isinstance(file.get(name, getlink=True), h5py.HardLink)  # a link may lead into other files
    dataset = file.get(name) if own else None
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        names = ", ".join(sorted(file)) or "nothing"
        raise BadInput(f"{path}: expected a data set {name!r} in it, found {names}; copy the file again")
    return dataset


class MaskFile:
    """The masks of an HDF5 file, read one frame at a time through one handle. Threads may share it."""

    def __init__(self, path: Path):
        """Reads the header. Raises `BadInput` when the file is damaged or its `masks` are not [N, H, W] numbers."""
        self.path = path
        self._lock = threading.Lock()
        self._file: h5py.File | None = None
        with _hdf5(path) as file:
            masks = _dataset(file, "masks", path)
            self.shape: tuple[int, int, int] = masks.shape
            if masks.dtype.kind not in "biuf" or len(self.shape) != 3 or 0 in self.shape:
                found = f"{masks.dtype} {list(self.shape)}"
                raise BadInput(f"{path}: expected 'masks' to be numbers of shape [N, H, W], found {found}")

    def __reduce__(self) -> tuple:
        return type(self), (self.path,)  # a handle stays with its process

    def frame(self, number: int) -> NDArray[np.bool_]:
        """[H, W], True = person. Raises `BadInput` when the frame's data are damaged."""
        with self._lock, _damage_named(f"{self.path}: mask {number}"):
            self._file = self._file or _opened_hdf5(self.path)
            mask = np.asarray(_dataset(self._file, "masks", self.path)[number])
        return soft_mask(mask, f"{self.path}: mask {number}") if mask.dtype.kind == "f" else mask != 0


class Video:
    """The frames of a video by number, counted by decoding, since seeking is inexact with many codecs.

    Going forward decodes what lies between; going back starts over. The last `KEPT_PICTURES` frames that were asked
    for are kept. Threads may share it.
    """

    def __init__(self, path: Path):
        """Reads the header. Raises `BadInput` when it is missing, damaged, or names no frames."""
        self.path = path
        self._lock = threading.Lock()
        self._decoded = lru_cache(maxsize=KEPT_PICTURES)(self._decode)
        self._next = 0  # the frame that the stream decodes next
        self._stream = self._opened()
        import cv2

        self.n_frames = int(self._stream.get(cv2.CAP_PROP_FRAME_COUNT))  # by the header
        width, height = (int(self._stream.get(p)) for p in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        self.size = (height, width)  # px
        if self.n_frames < 1:
            raise BadInput(f"{path}: its header names no frames; expected a complete video, copy the file again")

    def __reduce__(self) -> tuple:
        return type(self), (self.path,)  # a decoder stays with its process

    def frame(self, number: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB. Raises `BadInput` when the video ends before this frame."""
        with self._lock:
            return self._decoded(number).copy()

    def _decode(self, number: int) -> NDArray[np.uint8]:
        import cv2

        if number < self._next:
            self._stream.release()
            self._stream, self._next = self._opened(), 0
        while self._next < number:
            self._step(self._stream.grab(), number)
        ok, picture = self._stream.read()
        self._step(ok, number)
        return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)

    def _step(self, decoded: bool, number: int) -> None:
        if decoded:
            self._next += 1
            return
        ended, self._next = self._next, 1 << 62  # the stream is spent: start over at the next call
        raise BadInput(
            f"{self.path}: ends after {ended} frames, but frame {number} was asked for and its header promises "
            f"{self.n_frames}; copy the file again"
        )

    def _opened(self) -> Any:
        import cv2

        if not self.path.is_file():
            raise missing_file(self.path, "expected the subject's video")
        stream = cv2.VideoCapture(str(self.path.absolute()), cv2.CAP_FFMPEG)
        if not stream.isOpened():
            raise BadInput(f"{self.path}: cut short, or not a video that OpenCV reads; copy the file again")
        if turned := int(stream.get(cv2.CAP_PROP_ORIENTATION_META)):
            raise BadInput(
                f"{self.path}: shown turned by {turned}°, says its header; write it anew without that, its frames "
                f"turned as the camera and the masks have them"
            )
        return stream


# ----------------------------------------------------------------------------------------------- write


def write_camera(folder: Path, camera: Camera) -> None:
    """camera.pkl; `read_camera` undoes it to 1e-12. Raises `ValueError` for a skewed camera, which has no place."""
    import cv2

    K = camera.K_opencv
    if K[0, 1]:
        raise ValueError("camera.pkl: expected a camera without skew")
    write_pickle(
        folder / CAMERA_FILE,
        {
            "camera_t": camera.t.copy(),
            "camera_rt": cv2.Rodrigues(camera.R)[0].reshape(3),
            "camera_f": np.array([K[0, 0], K[1, 1]]),
            "camera_c": K[:2, 2].copy(),
            "camera_k": np.zeros(5) if camera.distortion is None else camera.distortion.copy(),
            "width": camera.width,
            "height": camera.height,
        },
    )


def write_masks(folder: Path, masks: Iterable[NDArray], shape: tuple[int, int, int]) -> None:
    """masks.hdf5 from N masks [H, W], non-zero = person; `shape` is (N, H, W). Lossless.

    Raises `ValueError` for another number or size of masks.
    """
    with _new_hdf5(folder / MASKS_FILE) as file:
        stored = file.create_dataset("masks", shape, np.int8, compression="lzf", chunks=(1, *shape[1:]))
        n = 0
        for n, mask in enumerate(masks, 1):
            if n > shape[0] or mask.shape != shape[1:]:
                raise ValueError(f"masks: expected {shape[0]} of {shape[1:]}, got {mask.shape} as number {n}")
            stored[n - 1] = mask != 0
        if n != shape[0]:
            raise ValueError(f"masks: expected {shape[0]}, got {n}")


def write_poses(folder: Path, poses: Sequence[BodyPose]) -> None:
    """reconstructed_poses.hdf5, float32 (1e-6 rad and m). Raises `ValueError` when the betas differ: it holds one."""
    pose, trans, betas = stacked(poses)
    with _new_hdf5(folder / POSES_FILE) as file:
        for name, value in (("pose", pose), ("trans", trans), ("betas", betas)):
            file.create_dataset(name, data=value, compression="lzf")


def stacked(poses: Sequence[BodyPose]) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """(pose [N, 72], trans [N, 3], betas [B]), float32. Raises `ValueError` for none, or other betas in one."""
    if not poses:
        raise ValueError("poses: expected at least one")
    if any(not np.array_equal(pose.betas, poses[0].betas) for pose in poses):
        raise ValueError("poses: expected the same betas in every frame, the file holds them once")
    pose = np.stack([pose.pose.reshape(72) for pose in poses]).astype(np.float32)
    trans = np.stack([pose.transl for pose in poses]).astype(np.float32)
    return pose, trans, poses[0].betas.astype(np.float32)


def write_consensus(folder: Path, betas: NDArray, v_personal: NDArray) -> None:
    """consensus.pkl: betas [10] and the offsets of the template's vertices [V, 3] m. Lossless."""
    write_pickle(
        folder / CONSENSUS_FILE,
        {"betas": np.asarray(betas, np.float64), "v_personal": np.asarray(v_personal, np.float64)},
    )


def write_video(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float = 30.0) -> None:
    """An MPEG-4 (mp4v) video of frames [H, W, 3] RGB. Lossy: 32 dB PSNR or more on smooth pictures.

    Raises `ValueError` for no frames, odd or changing sizes, which the codec cannot hold, and `BadInput` when the
    disk does not take it.
    """
    import cv2

    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ValueError("video: expected at least one frame")
    shape, n = first.shape, 0
    if len(shape) != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2 or first.dtype != np.uint8:
        raise ValueError(f"video: expected uint8 RGB frames of even size, got {first.dtype} {shape}")
    with tempfile.TemporaryDirectory() as scratch:
        temporary = Path(scratch) / "video.mp4"
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, codec, fps, shape[1::-1])
        try:
            if not writer.isOpened():
                raise BadInput(f"{path}: OpenCV cannot write MPEG-4 video here; reinstall opencv-python")
            for frame in chain([first], frames):
                if frame.shape != shape:
                    raise ValueError(f"video: expected frames of one size, got {shape} and {frame.shape}")
                writer.write(cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_RGB2BGR))
                n += 1
        finally:
            writer.release()
        if not temporary.is_file() or (written := Video(temporary)).n_frames != n or written.size != shape[:2]:
            raise BadInput(f"{path}: the video came out incomplete; make room on the disk and try again")
        atomic.write_bytes(path, temporary.read_bytes(), durable=False)


@contextmanager
def _new_hdf5(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file in memory that takes its name on disk only when it is complete."""
    import h5py

    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        yield file
        file.flush()
        atomic.write_bytes(path, file.id.get_file_image(), durable=False)
