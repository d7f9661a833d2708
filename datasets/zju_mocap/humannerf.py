"""The layout that HumanNeRF's and OccNeRF's preparation scripts write, read and written.

    377/images/frame_000000.png                of one camera; images/camera_01_frame_000000.png of several, from 1
    377/masks/…                                the same names, three channels, 0 or 255
    377/cameras.pkl                            name -> intrinsics [3, 3], extrinsics [4, 4] m, distortions [5]
    377/mesh_infos.pkl                         name -> Rh, Th, poses [72] with a zero root, (tpose_)joints [24, 3]
    377/canonical_joints.pkl                   joints [24, 3], and avg_betas [10] in some copies

Source: tiangexiang/OccNeRF tools/prepare_zju_mocap/prepare_dataset_eval.py:95-219. The root is ZJU-MoCap's (Rh, Th).
Not every copy holds betas: then they follow from tpose_joints, which are linear in them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body, from_zju_root, zju_root
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.reading.capture_folder import CaptureFolder
from ihbench.datasets.reading.pickles import write_pickle
from ihbench.datasets.reading.stored_numbers import described, extrinsic, numbers
from ihbench.datasets.reading.subject_folders import SubjectFolders, View, count_files
from ihbench.errors import BadInput
from ihbench.files.pictures import read_mask, size_of, write_picture
from ihbench.files.safe_pickle import load_pickle
from ihbench.scene.copy_report import SubjectReport

NAME = re.compile(r"(?:camera_(\d+)_)?frame_(\d+)")
FILES = ("cameras.pkl", "mesh_infos.pkl")
MONOCULAR = "camera"  # the id of the only camera of a copy whose names hold none
BETAS = 10  # found from joints where a copy holds none


class HumanNerfFormat(SubjectFolders["HumanNerfCapture"]):
    """A folder that holds subjects' folders, or one of those folders itself."""

    dataset, layout = "zju_mocap", "humannerf"
    content = f"HumanNeRF-style folders (images, masks, {', '.join(FILES)}), as its preparation script writes them"
    samples = 4

    @staticmethod
    def holds(folder: Path) -> bool:
        return (folder / "images").is_dir() and all((folder / name).is_file() for name in FILES)

    def capture(self, subject: str, body: Body | None) -> HumanNerfCapture:
        return HumanNerfCapture(self._folders[subject], body)

    def inspect(self, capture: HumanNerfCapture, report: SubjectReport) -> list[View]:
        views = capture.views
        report.views = len(views)
        kinds = {kind: {view: capture.picture(kind, *view) for view in views} for kind in ("images", "masks")}
        there = count_files(report, kinds)
        return sorted(there["images"] & there["masks"])


class HumanNerfCapture(CaptureFolder):
    """One subject, read lazily; see `scene.contracts.Capture`. Keeps no images.

    A frame is the number in the names; a frame without a file is missing, and said so when it is read.
    """

    dataset, variant = "zju_mocap", "humannerf"
    image_hint = "cameras.pkl lists it"

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name, body)
        self._cameras = _dictionary(folder / "cameras.pkl")
        self._infos = _dictionary(folder / "mesh_infos.pkl")
        self._names: dict[tuple[str, int], str] = {}
        for name in self._cameras:
            match = NAME.fullmatch(str(name))
            if match is None:
                raise BadInput(
                    f"{folder / 'cameras.pkl'}: name {name!r}; expected frame_000000 or camera_01_frame_000000"
                )
            key = match[1] or MONOCULAR, int(match[2])
            if key in self._names:
                raise BadInput(f"{folder / 'cameras.pkl'}: frame {key[1]} is there twice; move one of the two away")
            self._names[key] = str(name)
        ids = {camera for camera, _ in self._names}
        self.camera_ids = tuple(sorted(ids, key=lambda camera: -1 if camera == MONOCULAR else int(camera)))
        self.n_frames = max(frame for _, frame in self._names) + 1
        self._sizes: dict[int, tuple[int, int]] = {}
        self._fitted_betas: dict[bytes, NDArray[np.float64]] = {}

    def camera(self, camera: int) -> Camera:
        """The camera of its first frame, with its lens distortion; all frames of one share it."""
        self.check_index(camera, 0)
        own = self.camera_ids[camera]
        first = min(frame for other, frame in self._names if other == own)
        name = self._names[own, first]
        entry, path = self._cameras[name], self.folder / "cameras.pkl"
        K = numbers(entry, "intrinsics", (3, 3), f"{path}: {name}")
        E = numbers(entry, "extrinsics", (4, 4), f"{path}: {name}")
        D = numbers(entry, "distortions", (5,), f"{path}: {name}") if "distortions" in entry else None
        if camera not in self._sizes:
            self._sizes[camera] = size_of(self.picture("images", camera, first))
        return Camera.from_opencv(K, E[:3, :3], E[:3, 3], *self._sizes[camera], D)

    def body_pose(self, frame: int) -> BodyPose:
        self.check_index(0, frame)
        name = next((n for (_, f), n in self._names.items() if f == frame and n in self._infos), None)
        path = self.folder / "mesh_infos.pkl"
        if name is None:
            raise BadInput(f"{path}: no pose of frame {frame}; expected one for every frame of cameras.pkl")
        info = self._infos[name]
        poses, Rh, Th = (numbers(info, k, (n,), f"{path}: {name}") for k, n in (("poses", 72), ("Rh", 3), ("Th", 3)))
        try:
            return from_zju_root(poses, self._betas(info, path, name), Rh, Th, self.model)
        except BadInput as error:
            raise BadInput(f"{path}: {name}: {error}") from error

    def _betas(self, info: Mapping[str, Any], path: Path, name: str) -> NDArray[np.float64]:
        if "betas" in info:
            return numbers(info, "betas", (-1,), f"{path}: {name}")
        if self._average_betas is not None:
            return self._average_betas
        joints = numbers(info, "tpose_joints", (24, 3), f"{path}: {name}")
        key = joints.tobytes()
        if key not in self._fitted_betas:
            self._fitted_betas[key] = betas_of_joints(joints, self.model)
        return self._fitted_betas[key]

    @cached_property
    def _average_betas(self) -> NDArray[np.float64] | None:
        path = self.folder / "canonical_joints.pkl"
        content = _dictionary(path) if path.is_file() else {}
        return numbers(content, "avg_betas", (-1,), path) if "avg_betas" in content else None

    @property
    def views(self) -> list[View]:
        """(camera, frame) of the views that the copy lists, sorted."""
        return sorted((self.camera_ids.index(camera), frame) for camera, frame in self._names)

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W]. The preparation has joined the original's masks: "mask" and "union" are the same here."""
        if source not in ("mask", "union"):
            raise BadInput(f"{self.folder}: silhouette source {source!r}: this layout has joined masks only")
        self.check_index(camera, frame)
        path = self.picture("masks", camera, frame)
        return self.read_picture(path, camera, lambda path: read_mask(path, "half"), self.image_hint)

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        return self.picture("images", camera, frame), self.picture("masks", camera, frame)

    def picture(self, kind: str, camera: int, frame: int) -> Path:
        """The file of a view in images/ or masks/. Raises `BadInput` for a view that the copy does not list."""
        name = self._names.get((self.camera_ids[camera], frame))
        if name is None:
            raise BadInput(f"{self.folder}: no frame {frame} of camera {self.camera_ids[camera]} in cameras.pkl")
        png = self.folder / kind / f"{name}.png"
        jpg = png.with_suffix(".jpg")
        return jpg if kind == "images" and not png.is_file() and jpg.is_file() else png


def betas_of_joints(joints: NDArray[np.float64], body: Body) -> NDArray[np.float64]:
    """[10] shape coefficients whose rest-pose joints are `joints` [24, 3] m, in the sense of least squares."""
    zero = body.shaped(np.zeros(BETAS))[1]
    columns = [(body.shaped(np.eye(BETAS)[k])[1] - zero).ravel() for k in range(BETAS)]
    solution = np.linalg.lstsq(np.stack(columns, 1), (joints - zero).ravel(), rcond=None)[0]
    return solution.astype(np.float64)


def _dictionary(path: Path) -> dict[str, Any]:
    content = load_pickle(path)
    if not isinstance(content, dict) or not content:
        raise BadInput(f"{path}: expected a dictionary with entries, found {described(content)}")
    return content


# ----------------------------------------------------------------------------------------------- write


def write_pickles(
    folder: Path,
    views: Mapping[str, tuple[Camera, BodyPose]],  # name -> camera and pose of that view
    body: Body,
) -> None:
    """cameras.pkl, mesh_infos.pkl and canonical_joints.pkl; the reader undoes them to 1e-12."""
    cameras, infos = {}, {}
    for name, (camera, body_pose) in views.items():
        lens = np.zeros(5) if camera.distortion is None else camera.distortion.copy()
        cameras[name] = {"intrinsics": camera.K_opencv, "extrinsics": extrinsic(camera), "distortions": lens}
        Rh, Th = zju_root(body_pose, body)
        poses = body_pose.pose.copy()
        poses[0] = 0
        unturned = BodyPose(poses, body_pose.betas, np.zeros(3))
        infos[name] = {
            "Rh": Rh,
            "Th": Th,
            "poses": poses.reshape(72),
            "joints": body.posed_joints(unturned),
            "tpose_joints": body.shaped(body_pose.betas)[1],
            "betas": body_pose.betas.copy(),
        }
    mean = np.mean([pose.betas for _, pose in views.values()], 0)
    write_pickle(folder / "cameras.pkl", cameras)
    write_pickle(folder / "mesh_infos.pkl", infos)
    write_pickle(folder / "canonical_joints.pkl", {"joints": body.shaped(mean)[1], "avg_betas": mean})


def write_view(folder: Path, name: str, image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> None:
    """The PNG files of one view: image [H, W, 3] RGB, mask [H, W] in three channels of 0 or 255. Lossless."""
    write_picture(folder / "images" / f"{name}.png", image)
    write_picture(folder / "masks" / f"{name}.png", np.repeat(mask[..., None] * np.uint8(255), 3, 2))
