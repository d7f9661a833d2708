"""GaussianAvatar's copy of PeopleSnapshot: read, check and write folders of two splits.

    <subject>/train/images/*.png|jpg     undistorted pictures; test/ holds the same files
    <subject>/train/masks/*.png          128 and more = person
    <subject>/train/cam_parms.npz        intrinsic [3, 3] (OpenCV), extrinsic [4, 4] world to camera, m
    <subject>/train/cam_parms/*.npz      the same, a file for each image
    <subject>/train/smpl_parms.pth       beta [1, 10], body_pose [N, 72] rad, root first, trans [N, 3] m

Source: aipixel/GaussianAvatar scene/dataset_mono.py and scripts/sample_romp2gsavatar.py. The rows of smpl_parms.pth
follow the images' names in sorted order.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.people_snapshot.original import (
    PeopleSnapshotRaw,
    Poses,
    SnapshotPictures,
    finite_pose,
    read_npz,
    report_spoiled_rows,
    stacked,
    stored_pinhole,
    stored_poses,
)
from ihbench.datasets.reading.capture_folder import picture_files
from ihbench.datasets.reading.stored_numbers import stored_camera
from ihbench.datasets.reading.subject_folders import SubjectFolders, View, count_files
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.npz import write_npz
from ihbench.files.pictures import read_mask, size_of, write_picture
from ihbench.files.spelling import missing_file
from ihbench.files.tensors import read_tensors
from ihbench.scene.copy_report import SubjectReport

SPLITS = ("train", "test")
IMAGES, MASKS, CAMERA, POSES = "images", "masks", "cam_parms", "smpl_parms.pth"
LARGEST_FRAME = 1_000_000  # stems above are no frame numbers (dates, …)


class GaussianAvatarFolder(SubjectFolders["GaussianAvatarCapture"]):
    """A folder that holds subjects' folders of GaussianAvatar's layout, or one of those folders itself."""

    dataset, layout = "people_snapshot", "gaussianavatar"
    content = f"GaussianAvatar's layout (train/ and test/ with {IMAGES}/, {MASKS}/, {CAMERA}.npz, {POSES})"

    @staticmethod
    def holds(folder: Path) -> bool:
        return not PeopleSnapshotRaw.holds(folder) and any(_holds_split(folder / split) for split in SPLITS)

    def capture(self, subject: str, body: Body | None) -> GaussianAvatarCapture:
        return GaussianAvatarCapture(self._folders[subject], body)

    def inspect(self, capture: GaussianAvatarCapture, report: SubjectReport) -> list[View]:
        report.gender, report.numbered = capture.gender, capture.numbered
        paths = {"image": capture.image_path, "mask": capture.mask_path}
        there = count_files(report, {kind: {f: of(f) for f in capture.frames} for kind, of in paths.items()})
        counts = {split: sum(capture.split_of(frame) == split for frame in capture.frames) for split in SPLITS}
        report.files |= counts
        report.missing = {"mask": len(capture.frames) - len(there["mask"])}
        for split, count in counts.items():
            if not count:
                report.problem(f"no image in {split}/{IMAGES}")
                continue
            try:
                report_spoiled_rows(report, capture.folder / split / POSES, *capture._poses(split)[:2])
            except BadInput as error:
                report.problem(str(error))
        return [(0, frame) for frame in sorted(there["mask"])]


@dataclass(frozen=True)
class Stored:
    """Where one frame lies."""

    split: str
    row: int  # of the split's smpl_parms.pth
    image: Path


class GaussianAvatarCapture(SnapshotPictures):
    """One subject, read lazily; see `scene.contracts.Capture`. Keeps no images.

    Frames are numbered as the images are named when all names are numbers and none occurs twice, else consecutively:
    those of train, then those of test. `frames` lists the numbers that exist, `split_of` says where they lie.
    """

    variant = "gaussianavatar"

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name, body)
        stored = [
            Stored(split, row, image)
            for split in SPLITS
            for row, image in enumerate(picture_files(folder / split / IMAGES))  # in the order of the poses
        ]
        if not stored:
            raise BadInput(f"{folder}: no image in train/{IMAGES} or test/{IMAGES}; expected .png or .jpg files")
        stems = [entry.image.stem for entry in stored]
        numbers = [int(stem) for stem in stems if stem.isascii() and stem.isdecimal() and len(stem) < 20]
        self.numbered = len(set(numbers)) == len(stored) and max(numbers) <= LARGEST_FRAME
        self._stored = dict(zip(numbers if self.numbered else range(len(stored)), stored, strict=True))
        self.n_frames = max(self._stored) + 1
        self._rows: dict[str, Poses] = {}

    @property
    def frames(self) -> list[int]:
        """The numbers of the frames that exist, ascending."""
        return sorted(self._stored)

    def split_of(self, frame: int) -> str:
        """ "train" or "test". Raises `BadInput` for a frame without an image."""
        return self._where(frame).split

    def camera(self, camera: int) -> Camera:
        """The one camera, without distortion; its size comes from the header of the first image.

        Raises `BadInput` when the images' own cameras differ: a moving camera is no fixed one.
        """
        self.check_index(camera, 0)
        return self._camera

    @cached_property
    def _camera(self) -> Camera:
        first: tuple[Path, NDArray, NDArray] | None = None
        for path in dict.fromkeys(self.camera_path(frame) for frame in self.frames):
            K, E = stored_pinhole(read_npz(path, "intrinsic and extrinsic"), path)
            if first is None:
                first = path, K, E
            elif not (np.allclose(K, first[1], rtol=1e-6) and np.allclose(E, first[2], atol=1e-6)):
                raise BadInput(f"{path}: another camera than {first[0]}; expected one fixed camera for all images")
        assert first is not None
        width, height = size_of(self._stored[self.frames[0]].image)
        return Camera.from_opencv(first[1], first[2][:3, :3], first[2][:3, 3], width, height)

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters, standard root convention."""
        entry = self._where(frame)
        return finite_pose(self.folder / entry.split / POSES, entry.row, *self._poses(entry.split))

    def image_path(self, frame: int) -> Path:
        return self._where(frame).image

    def mask_path(self, frame: int) -> Path:
        entry = self._where(frame)
        return self.folder / entry.split / MASKS / f"{entry.image.stem}.png"

    @staticmethod
    def read_mask(path: Path) -> NDArray[np.bool_]:
        return read_mask(path, "half")

    def camera_path(self, frame: int) -> Path:
        """cam_parms.npz of the frame's split, else the image's own file in cam_parms/."""
        entry = self._where(frame)
        shared = self.folder / entry.split / f"{CAMERA}.npz"
        own = self.folder / entry.split / CAMERA / f"{entry.image.stem}.npz"
        return own if not shared.is_file() and own.parent.is_dir() else shared

    def _where(self, frame: int) -> Stored:
        self.check_index(0, frame)
        if frame not in self._stored:
            raise BadInput(
                f"{self.folder}: no image of frame {frame} in train/{IMAGES} or test/{IMAGES}; "
                f"ask for one of the {len(self._stored)} frames that are there{self.standin_hint}"
            )
        return self._stored[frame]

    def _poses(self, split: str) -> Poses:
        if split not in self._rows:
            path = self.folder / split / POSES
            rows = read_poses(path)
            n_images = sum(entry.split == split for entry in self._stored.values())
            if len(rows[0]) != n_images:
                raise BadInput(
                    f"{path}: {len(rows[0])} poses, but {split}/{IMAGES} holds {n_images} images; "
                    f"expected a pose for each image"
                )
            self._rows[split] = rows
        return self._rows[split]


def _holds_split(folder: Path) -> bool:
    parts = (folder / POSES).is_file(), (folder / f"{CAMERA}.npz").is_file() or (folder / CAMERA).is_dir()
    return sum((*parts, (folder / IMAGES).is_dir())) >= 2


def read_poses(path: Path) -> Poses:
    """(body_pose [N, 72] rad, trans [N, 3] m, beta [10]) of smpl_parms.pth. Raises `BadInput`; runs nothing in it."""
    if not path.is_file():
        raise missing_file(path, "expected beta, body_pose and trans of the split's images")
    content = {}
    for key, value in read_tensors(path).items():
        try:
            content[key] = value.detach().double().numpy()
        except (AttributeError, RuntimeError, TypeError):  # no tensor, or a sparse or quantised one
            raise BadInput(
                f"{path}: expected a tensor of numbers in {key!r}, found a {type(value).__name__}"
            ) from None
    return stored_poses(content, path, "body_pose", "trans", "beta")


# ----------------------------------------------------------------------------------------------- write


def write_camera(folder: Path, split: str, camera: Camera) -> None:
    """The split's cam_parms.npz. Lossless, but for distortion, which this layout lacks: `ValueError`."""
    K, E = stored_camera(camera, "GaussianAvatar")
    write_npz(folder / split / f"{CAMERA}.npz", {"intrinsic": K, "extrinsic": E}, durable=False)


def write_frame(
    folder: Path,
    split: str,  # "train" or "test"
    frame: int,
    image: NDArray[np.uint8],  # [H, W, 3] RGB
    mask: NDArray,  # [H, W] non-zero = person
) -> None:
    """The frame's image and mask as PNG. Lossless."""
    label = np.where(mask != 0, 255, 0).astype(np.uint8)
    for kind, picture in ((IMAGES, image), (MASKS, label)):
        write_picture(folder / split / kind / f"{frame:06d}.png", picture)


def write_poses(folder: Path, split: str, poses: Sequence[BodyPose]) -> None:
    """The split's smpl_parms.pth, float32 (1e-6 rad and m): a pose for each of its frames, ascending.

    Raises `ValueError` when the betas differ, which the file holds once.
    """
    import torch

    pose, trans, betas = (torch.from_numpy(value) for value in stacked(poses))
    buffer = io.BytesIO()
    torch.save({"beta": betas[None].clone(), "body_pose": pose, "trans": trans}, buffer)
    atomic.write_bytes(folder / split / POSES, buffer.getvalue(), durable=False)
