"""ZJU-MoCap in its original layout: read, check and write `CoreView_<subject>` folders.

    CoreView_377/annots.npy               cameras (OpenCV, T in millimetres) and the image paths of every frame
    CoreView_377/Camera_B1/000000.jpg     1024×1024, lens distortion in
    CoreView_377/mask/Camera_B1/…png      non-zero = person; mask_cihp/ the same with CIHP part labels
    CoreView_377/new_params/0.npy         poses, shapes, Rh, Th of the newer fit; params/ is the older fit
    CoreView_377/new_vertices/0.npy       [V, 3] m, world, what those parameters give

Sources: zju3dv/neuralbody lib/datasets/light_stage/multi_view_dataset.py and zju_smpl/, tiangexiang/OccNeRF
tools/prepare_zju_mocap. Parameter files are numbered as the images are, which is from 1 for subjects 313 and 315.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body, from_zju_root, zju_root
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, check_rotation
from ihbench.datasets.reading.capture_folder import CaptureFolder
from ihbench.datasets.reading.pickles import write_object
from ihbench.datasets.reading.plausibility import Outline
from ihbench.datasets.reading.stored_numbers import described, numbers
from ihbench.datasets.reading.subject_folders import SubjectFolders, View, count_files
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.pictures import read_mask, write_picture
from ihbench.files.safe_pickle import load_npy
from ihbench.files.spelling import missing_file
from ihbench.scene.copy_report import SubjectReport

FOLDER_PREFIX = "CoreView_"
FITS = ("new_params", "params")  # the newer one first: HumanNeRF and OccNeRF use it
SILHOUETTES = {"mask": ("mask",), "mask_cihp": ("mask_cihp",), "union": ("mask", "mask_cihp")}
CAMERA_SHAPES = {"K": (3, 3), "D": (5,), "R": (3, 3), "T": (3,)}


class ZjuMocap(SubjectFolders["ZjuCapture"]):
    """A folder that holds `CoreView_*` folders, or one of those folders itself. Names are without `CoreView_`."""

    dataset, layout = "zju_mocap", "original"
    content = f"{FOLDER_PREFIX}* folders"

    @staticmethod
    def holds(folder: Path) -> bool:
        return folder.name.startswith(FOLDER_PREFIX)

    def name_of(self, folder: Path) -> str:
        return folder.name.removeprefix(FOLDER_PREFIX)

    def subjects(self) -> list[str]:
        """Names in natural order."""
        return sorted(self._folders, key=_natural)

    def capture(self, subject: str, body: Body | None) -> ZjuCapture:
        return ZjuCapture(self._folders[subject], body)

    def inspect(self, capture: ZjuCapture, report: SubjectReport) -> list[View]:
        views = [(camera, frame) for camera in range(len(capture.camera_ids)) for frame in range(capture.n_frames)]
        kinds = {kind: {view: capture.mask_path(*view, kind) for view in views} for kind in capture.mask_kinds}
        kinds = {"image": {view: capture.image_path(*view) for view in views}, **kinds}
        for part in (capture.fit, vertex_folder(capture.fit)):
            numbers = ((frame, capture.number(frame)) for frame in range(capture.n_frames))
            kinds[part] = {(0, frame): capture.folder / part / f"{number}.npy" for frame, number in numbers}
        there = count_files(report, kinds, may_lack=("mask_cihp",))
        report.files = {kind: count for kind, count in report.files.items() if kind in ("image", *capture.mask_kinds)}
        return sorted(there["image"] & there["mask"])

    def bodies(self, capture: ZjuCapture, report: SubjectReport) -> tuple[Callable[[int], Outline], bool]:
        """The posed model where it is at hand, else the stored vertices."""

        def outline(frame: int) -> Outline:
            read_params(capture.params_path(frame))
            if capture.has_model:
                return Outline(capture.model.pose(capture.body_pose(frame)), capture.model.faces)
            return Outline(capture.vertices(frame))

        return outline, True


class ZjuCapture(CaptureFolder):
    """One subject, read lazily; see `scene.contracts.Capture`. Keeps no images."""

    dataset = "zju_mocap"
    layout, prefix = "original", FOLDER_PREFIX
    fits = FITS  # parameter folders, the preferred one first
    silhouettes = tuple(SILHOUETTES)
    image_hint = "annots.npy lists it"
    mask_kinds: tuple[str, ...] = ("mask", "mask_cihp")

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name.removeprefix(self.prefix), body)
        self._annots = read_annots(folder / "annots.npy")
        fit = next((name for name in self.fits if (folder / name).is_dir()), None)
        if fit is None:
            raise BadInput(
                f"{folder}: neither {' nor '.join(self.fits)} in it; expected SMPL parameters, one file a frame"
            )
        self.fit, self.variant = fit, f"{self.layout}/{fit}"
        self.n_frames = len(self._annots.image_paths)
        self.camera_ids = self._annots.camera_ids
        self._sizes: dict[int, tuple[int, int]] = {}

    def camera(self, camera: int) -> Camera:
        """The calibrated view with its lens distortion; its size comes from the header of one of its images."""
        self.check_index(camera, 0)
        width, height = self.image_size(camera)
        K, D, R, T = (self._annots.cameras[key][camera] for key in CAMERA_SHAPES)
        return Camera.from_opencv(K, R, T / 1000, width, height, D)

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters in the standard root convention."""
        path = self.params_path(frame)
        poses, shapes, Rh, Th = read_params(path)
        body = self.model
        try:
            return from_zju_root(poses, shapes, Rh, Th, body)
        except BadInput as error:
            raise BadInput(f"{path}: {error}") from error

    def vertices(self, frame: int) -> NDArray[np.float64]:
        """[V, 3] m, world: the fitted body mesh as stored."""
        path = self.folder / vertex_folder(self.fit) / f"{self.number(frame)}.npy"
        if not path.is_file():
            raise missing_file(path, f"expected the body's vertices at frame {frame}")
        vertices = load_npy(path)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind != "f":
            raise BadInput(f"{path}: expected numbers of shape [V, 3] in metres, found {described(vertices)}")
        if not np.isfinite(vertices).all():
            raise BadInput(f"{path}: NaN or infinite vertices; expected finite metres")
        return vertices.astype(np.float64)

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W]. `source` is "mask", "mask_cihp" or "union" (either of the two, as HumanNeRF and OccNeRF)."""
        self.check_source(source)
        person = None
        for kind in SILHOUETTES[source]:
            path = self.mask_path(camera, frame, kind)
            here = self.read_picture(path, camera, lambda path: read_mask(path, "non-zero"), self.image_hint)
            person = here if person is None else person | here
        assert person is not None
        return person

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        masks = (self.mask_path(camera, frame, kind) for kind in SILHOUETTES.get(source, ()))
        return (self.image_path(camera, frame), *masks)

    def stored_pose(self, frame: int) -> BodyPose:
        poses, shapes, Rh, Th = read_params(self.params_path(frame))
        return BodyPose(np.concatenate([Rh, poses[-69:]]).reshape(24, 3), shapes, Th)

    def label(self, frame: int) -> str:
        return str(self.number(frame))

    def number(self, frame: int) -> int:
        """The number that the frame's parameter and vertex files carry; 313 and 315 count from 1."""
        self.check_index(0, frame)
        return _frame_number(self._annots.image_paths[frame][0], self.folder)

    def image_path(self, camera: int, frame: int) -> Path:
        self.check_index(camera, frame)
        return self.folder / self._annots.image_paths[frame][camera]

    def mask_path(self, camera: int, frame: int, kind: str = "mask") -> Path:
        self.check_index(camera, frame)
        return self.folder / kind / PurePosixPath(self._annots.image_paths[frame][camera]).with_suffix(".png")

    def params_path(self, frame: int) -> Path:
        return self.folder / self.fit / f"{self.number(frame)}.npy"

    def image_size(self, camera: int) -> tuple[int, int]:
        """(width, height) px of the camera's first image on disk."""
        if camera not in self._sizes:
            paths = (self.image_path(camera, frame) for frame in range(self.n_frames))
            self._sizes[camera] = self.size_of_first(paths, camera)
        return self._sizes[camera]


def vertex_folder(fit: str) -> str:
    """The folder of the vertices that a parameter folder gives: new_params -> new_vertices."""
    return fit.replace("params", "vertices")


@dataclass(frozen=True)
class Annots:
    """annots.npy, checked."""

    cameras: dict[str, NDArray[np.float64]]  # K [N, 3, 3], D [N, 5], R [N, 3, 3], T [N, 3] mm
    image_paths: list[tuple[str, ...]]  # per frame, one path a camera, relative to the subject's folder
    camera_ids: tuple[str, ...]  # the folders of the images


def read_annots(path: Path) -> Annots:
    """Cameras and image paths of one subject. Raises `BadInput` naming the field that is not as expected."""
    if not path.is_file():
        raise missing_file(path, "expected this subject's cameras and image paths")
    content = load_npy(path)
    content = content.item() if content.shape == () and content.dtype == object else None
    if not isinstance(content, dict) or not {"cams", "ims"} <= content.keys():
        raise BadInput(f"{path}: expected a dictionary with 'cams' and 'ims', found {described(content)}")
    if not isinstance(content["cams"], dict):
        raise BadInput(f"{path}: expected 'cams' to be a dictionary, found {described(content['cams'])}")
    cameras = {key: _camera_field(content["cams"], key, path) for key in CAMERA_SHAPES}
    counts = {key: len(value) for key, value in cameras.items()}
    n_cameras = counts["K"]
    if len(set(counts.values())) != 1 or n_cameras == 0:
        counted = ", ".join(f"{n} {key}" for key, n in counts.items())
        raise BadInput(f"{path}: expected as many K, D, R and T as cameras, found {counted}")
    _check_calibration(cameras, path)
    image_paths = _image_paths(content["ims"], n_cameras, path)
    camera_ids = tuple(PurePosixPath(image).parent.as_posix() for image in image_paths[0])
    return Annots(cameras, image_paths, camera_ids)


def _camera_field(cams: dict, key: str, path: Path) -> NDArray[np.float64]:
    """[N, …]; vectors may be stored as columns or rows."""
    shape = CAMERA_SHAPES[key]
    expected = f"expected cams[{key!r}] to be one array of shape {list(shape)} for each camera"
    try:
        stacked = np.array([np.asarray(value, np.float64) for value in cams[key]])
    except (KeyError, TypeError, ValueError):
        raise BadInput(f"{path}: {expected}, found {described(cams.get(key))} of other contents") from None
    if len(shape) == 1 and stacked.ndim == 3 and 1 in stacked.shape[1:]:
        stacked = stacked.reshape(len(stacked), -1)
    if stacked.shape[1:] != shape:
        raise BadInput(f"{path}: {expected}, found {list(stacked.shape[1:])}")
    if not np.isfinite(stacked).all():
        raise BadInput(f"{path}: {expected}, found NaN or infinity in it")
    return stacked


def _check_calibration(cameras: dict[str, NDArray[np.float64]], path: Path) -> None:
    for number, R in enumerate(cameras["R"]):
        check_rotation(R, f"{path}: cams['R'] of camera {number}", 1e-3)
    furthest = np.linalg.norm(cameras["T"], axis=1).max()
    if furthest < 100:
        raise BadInput(
            f"{path}: expected cams['T'] in millimetres, found no camera further than {furthest:.3g} from the "
            f"origin; multiply T by 1000 if it is in metres"
        )


def _image_paths(ims: Any, n_cameras: int, path: Path) -> list[tuple[str, ...]]:
    expected = "expected 'ims' to be one {'ims': [image paths]} for each frame"
    try:
        frames = [tuple(str(image) for image in frame["ims"]) for frame in ims]
    except (TypeError, KeyError, IndexError):
        raise BadInput(f"{path}: {expected}, found {described(ims)} of other contents") from None
    if not frames:
        raise BadInput(f"{path}: {expected}, found no frame")
    for index, frame in enumerate(frames):
        if len(frame) != n_cameras:
            raise BadInput(
                f"{path}: expected {n_cameras} image paths a frame, as many as cameras, "
                f"found {len(frame)} in frame {index}"
            )
        for image in frame:
            if image.startswith("/") or "\\" in image or "\0" in image or ".." in image.split("/"):
                raise BadInput(f"{path}: image path {image!r} of frame {index} leads out of the subject's folder")
    return frames


def read_params(path: Path) -> tuple[NDArray[np.float64], ...]:
    """(poses [72 or 69], shapes [B], Rh [3] rad, Th [3] m) of one parameter file. Raises `BadInput`."""
    if not path.is_file():
        raise missing_file(path, "expected the frame's poses, shapes, Rh and Th")
    content = load_npy(path)
    content = content.item() if content.shape == () and content.dtype == object else None
    sizes = {"poses": (72, 69), "shapes": (10, 300), "Rh": (3,), "Th": (3,)}
    if not isinstance(content, dict) or not sizes.keys() <= content.keys():
        raise BadInput(f"{path}: expected a dictionary with poses, shapes, Rh and Th, found {described(content)}")
    values = []
    for key, allowed in sizes.items():
        value = numbers(content, key, (-1,), path)
        if value.size not in allowed:
            raise BadInput(
                f"{path}: expected {' or '.join(str(n) for n in allowed)} numbers in {key!r}, found {value.size}"
            )
        values.append(value)
    return tuple(values)


def _frame_number(image: str, folder: Path) -> int:
    """000012.jpg -> 12; CoreView_313_Camera_(1)_0013_2019-….jpg -> 13, the fifth token, as NeuralBody reads it."""
    stem = PurePosixPath(image).stem
    tokens = stem.split("_")
    number = stem if stem.isdecimal() else tokens[4] if len(tokens) > 4 else ""
    if not number.isdecimal():
        raise BadInput(f"{folder / 'annots.npy'}: image path {image!r} holds no frame number; expected NNNNNN.jpg")
    return int(number)


def _natural(name: str) -> list[tuple[int, int | str]]:
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name) if part]


# ----------------------------------------------------------------------------------------------- write


def standard_image_paths(n_cameras: int, n_frames: int) -> list[list[str]]:
    """Per frame the paths of the original release: Camera_B1/000000.jpg for camera 0, frame 0."""
    return [[f"Camera_B{camera + 1}/{frame:06d}.jpg" for camera in range(n_cameras)] for frame in range(n_frames)]


def write_annots(folder: Path, cameras: Sequence[Camera], image_paths: Sequence[Sequence[str]]) -> None:
    """annots.npy for cameras and the image paths of every frame; `read_annots` and `ZjuCapture.camera` undo it."""
    if any(len(frame) != len(cameras) for frame in image_paths):
        raise ValueError(f"annots: expected {len(cameras)} image paths a frame, one for each camera")
    distortion = [np.zeros(5) if camera.distortion is None else camera.distortion for camera in cameras]
    cams = {
        "K": [camera.K_opencv for camera in cameras],
        "D": [d.reshape(5, 1) for d in distortion],
        "R": [camera.R.copy() for camera in cameras],
        "T": [1000 * camera.t.reshape(3, 1) for camera in cameras],
    }
    write_object(folder / "annots.npy", {"cams": cams, "ims": [{"ims": list(frame)} for frame in image_paths]})


def write_frame(
    folder: Path,
    image_path: str,  # as annots.npy lists it
    image: NDArray[np.uint8] | None = None,  # [H, W, 3] RGB
    mask: NDArray | None = None,  # [H, W] non-zero = person
    mask_cihp: NDArray[np.uint8] | None = None,  # [H, W] CIHP part labels
) -> None:
    """The pictures of one camera at one frame: the image by its ending, masks as 8-bit PNG. None is not written."""
    if image is not None:
        write_picture(folder / image_path, image)
    for kind, labels in (("mask", mask), ("mask_cihp", mask_cihp)):
        if labels is not None:
            write_picture((folder / kind / image_path).with_suffix(".png"), labels.astype(np.uint8))


def write_params(folder: Path, number: int, body_pose: BodyPose, body: Body, fit: str = "new_params") -> None:
    """The frame's parameter file with the root as ZJU-MoCap keeps it; `ZjuCapture.body_pose` undoes it."""
    Rh, Th = zju_root(body_pose, body)
    poses = body_pose.pose.copy()
    poses[0] = 0
    row = {"poses": poses.reshape(1, 72), "shapes": body_pose.betas[None].copy(), "Rh": Rh[None], "Th": Th[None]}
    write_object(folder / fit / f"{number}.npy", row)


def write_vertices(folder: Path, number: int, vertices: NDArray[np.floating], fit: str = "new_params") -> None:
    """The frame's vertex file: [V, 3] m, world, float32."""
    buffer = io.BytesIO()
    np.save(buffer, np.asarray(vertices, np.float32))
    atomic.write_bytes(folder / vertex_folder(fit) / f"{number}.npy", buffer.getvalue(), durable=False)
