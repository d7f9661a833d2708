"""The OcMotion sequences of Wild2Avatar (`0011_02_1_w2a`, …), as OccFusion and OccNeRF read them: read, check, write.

    images/NNNNN.png        sorted, these are the frames; the first five characters are the frame of the original
    masks/NNNNN.png         channel 0 non-zero = visible person
    metadata.json           {NNNNN: {cam_intrinsics [3, 3], cam_extrinsics [4, 4], poses 72, betas 10, trans 3}}
    mesh_infos.pkl          optional, HumanNeRF's; its Rh replaces the root in poses
    all_cameras.pkl         optional, {NNNNN: {intrinsics [6, 3, 3], extrinsics [6, 4, 4]}}

The camera is OpenCV's (integer pixel centres, world to camera, metres) without distortion, and fixed; vertices are
SMPL(poses, betas) + trans in the world, standard root. Anything else in the folder is left alone.

Sources: tiangexiang/OccFusion scene/dataset_readers.py, tiangexiang/OccNeRF tools/prepare_wild/prepare_dataset.py.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.ocmotion.original import (
    OneCameraCapture,
    Sequences,
    metric_pose,
    one_camera,
    ten_betas,
    three_channels,
)
from ihbench.datasets.reading.capture_folder import picture_files
from ihbench.datasets.reading.pickles import write_pickle
from ihbench.datasets.reading.stored_numbers import check_calibration, described, numbers, stored_camera
from ihbench.datasets.reading.subject_folders import View
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.pictures import one_line, write_picture
from ihbench.files.regular import read_text
from ihbench.files.safe_pickle import load_pickle
from ihbench.files.spelling import missing_file
from ihbench.scene.copy_report import SubjectReport

Array = NDArray[np.float64]

METADATA = "metadata.json"
NAME_END = "_w2a"
NOT_SEQUENCES = ("truth",)  # what a stand-in keeps beside the sequences
SAME_EXTRINSICS = 1e-3  # files keep float32, and fold the translation in at that precision


class OcMotionW2a(Sequences["W2aCapture"]):
    """A folder that holds `*_w2a` sequence folders, or one of those folders itself."""

    layout = "w2a"
    content = f"*{NAME_END} sequences, with images/ and {METADATA}"

    @staticmethod
    def holds(folder: Path) -> bool:
        if folder.name in NOT_SEQUENCES or not folder.is_dir():
            return False
        named = folder.name.endswith(NAME_END) and not (folder / "annot").is_dir()
        pictures = any((folder / name).is_dir() for name in ("images", "masks"))
        return (named and pictures) or ((folder / METADATA).is_file() and (named or pictures))

    def capture(self, subject: str, body: Body | None) -> W2aCapture:
        return W2aCapture(self._folders[subject], body)

    def inspect(self, capture: W2aCapture, report: SubjectReport) -> list[View]:
        """Entries of metadata.json outside the range of the images count as missing images, too."""
        views = super().inspect(capture, report)
        outside = len(capture._metadata) - capture.n_frames
        if outside and not capture.standin:
            report.missing["image"] += outside
            report.warn(f"{METADATA} has {outside} frames before or after the images; they are not used")
        if (capture.folder / "all_cameras.pkl").is_file() and report.files["image"]:
            try:
                capture.novel_cameras(0)
            except BadInput as error:
                report.problem(str(error))
        return views


class W2aCapture(OneCameraCapture):
    """One sequence, read lazily; see `scene.contracts.Capture`. `frame_names[k]` is the stem of frame k's files.

    Frames are the sorted images, as OccFusion counts them; for a stand-in, which may lack images, those of
    metadata.json.
    """

    variant = "w2a"

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name, body)
        self._metadata = read_metadata(folder / METADATA)
        files = _image_files(folder / "images", may_lack=bool(self.standin))
        self.frame_names = _frame_names(files, self._metadata, folder, bool(self.standin))
        self.n_frames = len(self.frame_names)
        self.camera_ids = (camera_id(folder.name),)
        self._images = tuple(files.get(name, folder / "images" / f"{name}.png") for name in self.frame_names)
        self._masks = tuple(folder / "masks" / f"{name}.png" for name in self.frame_names)
        entries = [(self._metadata[name], self._where(name)) for name in self.frame_names]
        self._K, self._E = one_camera(entries, "cam_intrinsics", "cam_extrinsics")

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters: standard root (of mesh_infos.pkl, when it is there), world, metres."""
        self.check_index(0, frame)
        name = self.frame_names[frame]
        entry, where = self._metadata[name], self._where(name)
        pose = numbers(entry, "poses", (24, 3), where).copy()
        betas, trans = numbers(entry, "betas", (10,), where), numbers(entry, "trans", (3,), where)
        if self._mesh_infos is not None:
            pose[0] = numbers(self._mesh_infos[name], "Rh", (3,), f"{self.folder / 'mesh_infos.pkl'}: frame {name}")
        return metric_pose(pose, betas, trans, where)

    def novel_cameras(self, frame: int) -> list[Camera]:
        """The cameras of all_cameras.pkl at a frame, the sequence's own among them, in the world of `body_pose`.

        Their size is taken to be that of this sequence's images. OccNeRF's preparation folds the body's translation
        into extrinsics, E [I | trans]; where that was done here it is taken out again. Raises `BadInput` when the
        file is missing or damaged, or when none of its cameras is this sequence's own.
        """
        self.check_index(0, frame)
        name = self.frame_names[frame]
        path = self.folder / "all_cameras.pkl"
        if not path.is_file():
            raise missing_file(path, "expected the cameras of the other views in it")
        entry, where = self._all_cameras[name], f"{path}: frame {name}"
        K = numbers(entry, "intrinsics", (-1, 3, 3), where)
        E = numbers(entry, "extrinsics", (len(K), 4, 4), where).copy()
        trans = numbers(self._metadata[name], "trans", (3,), self._where(name))
        if not _holds(E, self._E):
            E[:, :3, 3] -= E[:, :3, :3] @ trans
            if not _holds(E, self._E):
                raise BadInput(
                    f"{where}: none of its cameras is that of {METADATA}; expected the same world and metres in both"
                )
        for one_K, one_E in zip(K, E, strict=True):
            check_calibration(one_K, one_E, where)
        size = self.image_size(0)
        return [Camera.from_opencv(one_K, e[:3, :3], e[:3, 3], *size) for one_K, e in zip(K, E, strict=True)]

    def _where(self, name: str) -> str:
        return f"{self.folder / METADATA}: frame {name}"

    @cached_property
    def _mesh_infos(self) -> dict[str, dict] | None:
        path = self.folder / "mesh_infos.pkl"
        return _read_frames(path, self.frame_names) if path.is_file() else None

    @cached_property
    def _all_cameras(self) -> dict[str, dict]:
        return _read_frames(self.folder / "all_cameras.pkl", self.frame_names)


def _holds(E: Array, own: Array) -> bool:
    """Whether one of the extrinsics [N, 4, 4] is `own` [4, 4]."""
    scale = max(1.0, float(np.abs(own).max()))
    return bool((np.abs(E - own).max((1, 2)) < SAME_EXTRINSICS * scale).any())


def camera_id(name: str) -> str:
    """0011_02_1_w2a -> 02: the second part, as OccFusion takes it."""
    parts = name.split("_")
    return parts[1] if len(parts) > 2 and parts[1].isdecimal() else "camera"


def read_metadata(path: Path) -> dict[str, dict]:
    """metadata.json: frame name -> its entry, not yet looked into. Raises `BadInput`."""
    try:
        content = json.loads(read_text(path, "camera and pose of every frame"), object_pairs_hook=atomic.unique_keys)
    except (ValueError, RecursionError) as error:
        detail = "nested too deeply" if isinstance(error, RecursionError) else one_line(error)
        raise BadInput(f"{path}: not valid JSON in UTF-8 ({detail}); copy the file again") from None
    if not isinstance(content, dict) or not all(isinstance(entry, dict) for entry in content.values()):
        raise BadInput(f"{path}: expected one dictionary for each frame name, found {described(content)}")
    return content


def _image_files(folder: Path, may_lack: bool) -> dict[str, Path]:
    """Frame name -> image file, sorted by name."""
    if not folder.is_dir() and not may_lack:
        raise BadInput(f"{folder}: no such folder; expected the images of the sequence, NNNNN.png")
    files: dict[str, Path] = {}
    for path in picture_files(folder):
        if path.stem in files:
            raise BadInput(f"{path}: frame {path.stem} is there twice, {files[path.stem].name} too; keep one of them")
        if not (path.stem[:5].isascii() and path.stem[:5].isdecimal()):
            raise BadInput(f"{path}: expected the frame's number in the first five characters of the name")
        files[path.stem] = path
    if not files and not may_lack:
        raise BadInput(f"{folder}: no image in it; expected those of the sequence, NNNNN.png")
    return files


def _frame_names(files: dict[str, Path], metadata: dict, folder: Path, standin: bool) -> tuple[str, ...]:
    for name, path in files.items():
        if name not in metadata:
            raise BadInput(f"{path}: no entry {name!r} in {METADATA}; expected camera and pose of every image")
    if standin:
        if not metadata:
            raise BadInput(f"{folder / METADATA}: no frame in it; make the stand-in anew")
        return tuple(sorted(metadata))
    names = sorted(files)
    # frames outside the images' range are another part of the clip; one within it is a lost image
    lost = [name for name in sorted(metadata) if names[0] < name < names[-1] and name not in files]
    if lost:
        raise BadInput(
            f"{folder / 'images' / lost[0]}.png: no such file, one of {len(lost)} that {METADATA} has within the "
            f"sequence; frames are counted over the images: copy them again"
        )
    return tuple(names)


def _read_frames(path: Path, names: Iterable[str]) -> dict[str, dict]:
    """A pickle keyed by frame name, with an entry for each of `names`."""
    content = load_pickle(path)
    if not isinstance(content, dict):
        raise BadInput(f"{path}: expected one dictionary for each frame name, found {described(content)}")
    for name in names:
        if not isinstance(content.get(name), dict):
            raise BadInput(f"{path}: expected a dictionary for frame {name}, found {described(content.get(name))}")
    return content


# ----------------------------------------------------------------------------------------------- write


def write_sequence_metadata(
    folder: Path, names: Sequence[str], camera: Camera, body_poses: Sequence[BodyPose]
) -> None:
    """metadata.json: one fixed camera without distortion and the body of every frame, exactly."""
    K, E = stored_camera(camera, "OcMotion")
    content = {
        name: {
            "cam_intrinsics": K.tolist(),
            "cam_extrinsics": E.tolist(),
            "poses": body_pose.pose.reshape(72).tolist(),
            "betas": ten_betas(body_pose).tolist(),
            "trans": body_pose.transl.tolist(),
        }
        for name, body_pose in zip(names, body_poses, strict=True)
    }
    atomic.write_text(folder / METADATA, json.dumps(content, allow_nan=False) + "\n")


def write_frame(
    folder: Path,
    name: str,  # stem of the files, e.g. "00320"
    image: NDArray[np.uint8] | None = None,  # [H, W, 3] RGB
    visible_mask: NDArray | None = None,  # [H, W] non-zero = visible person
) -> None:
    """The picture files of one frame, both PNG, the mask with three equal channels of 0 and 255. None is not
    written."""
    if image is not None:
        write_picture(folder / "images" / f"{name}.png", image)
    if visible_mask is not None:
        write_picture(folder / "masks" / f"{name}.png", three_channels(visible_mask))


def write_mesh_infos(folder: Path, names: Sequence[str], body_poses: Sequence[BodyPose], body: Body) -> None:
    """mesh_infos.pkl as OccNeRF's preparation makes it; float32.

    Rh [3] is the root's rotation and poses [72] has zeros there; joints [24, 3] of that pose and tpose_joints [24, 3]
    are relative to the pelvis of the shaped T-pose; Th [3] is that pelvis, since the frame's translation goes into
    the extrinsics of its cameras.pkl, E [I | trans]. A point x of the pelvis-centred body is then R(Rh) x + Th in
    the world of cameras.pkl. Of all this `W2aCapture` reads Rh only.
    """
    frames = {}
    for name, body_pose in zip(names, body_poses, strict=True):
        rest = body.shaped(body_pose.betas)[1]
        pose = body_pose.pose.copy()
        pose[0] = 0
        joints = body.posed_joints(BodyPose(pose, body_pose.betas, np.zeros(3)))
        values = {
            "Rh": body_pose.pose[0],
            "Th": rest[0],
            "poses": pose.reshape(72),
            "betas": ten_betas(body_pose),
            "joints": joints - rest[0],
            "tpose_joints": rest - rest[0],
        }
        frames[name] = {key: value.astype(np.float32) for key, value in values.items()}
    write_pickle(folder / "mesh_infos.pkl", frames)


def write_all_cameras(folder: Path, names: Sequence[str], cameras: Sequence[Camera]) -> None:
    """all_cameras.pkl: at every frame the same cameras, translation not folded in, as OccFusion draws with them."""
    stored = [stored_camera(camera, "OcMotion") for camera in cameras]
    K, E = np.stack([K for K, _ in stored]), np.stack([E for _, E in stored])
    frames = {name: {"intrinsics": K.copy(), "extrinsics": E.copy()} for name in names}
    write_pickle(folder / "all_cameras.pkl", frames)
