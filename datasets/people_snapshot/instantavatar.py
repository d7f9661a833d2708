"""InstantAvatar's copy of PeopleSnapshot, images undistorted: read, check and write one folder a subject.

    images/image_0000.png              numbered from 0, as the video's frames
    masks/mask_0000.npy                [H, W], 0 to 1 or 0 to 255; may be soft, more than half = person
    cameras.npz                        intrinsic [3, 3] (OpenCV), extrinsic [4, 4] world to camera m, height, width
    poses.npz                          betas [10], thetas [N, 72] rad, root first, transl [N, 3] m
    poses/anim_nerf_train.npz          Anim-NeRF's poses of the training frames, and …_test.npz of the test frames

Source: tijiang13/InstantAvatar scripts/peoplesnapshot/ and instant_avatar/datasets/peoplesnapshot.py. Anim-NeRF's
files replace the poses of their frames. They do not say which frames these are; for the four subjects that
InstantAvatar uses the subject's name tells; they may say it in `frames`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.people_snapshot.gaussianavatar import GaussianAvatarFolder
from ihbench.datasets.people_snapshot.original import (
    PeopleSnapshotRaw,
    Poses,
    SnapshotPictures,
    finite_pose,
    read_npz,
    report_spoiled_rows,
    soft_mask,
    stacked,
    stored_pinhole,
    stored_poses,
)
from ihbench.datasets.reading.stored_numbers import described, numbers, stored_camera
from ihbench.datasets.reading.subject_folders import SubjectFolders, View, count_files
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.npz import write_npz
from ihbench.files.pictures import write_picture
from ihbench.files.safe_pickle import load_npy
from ihbench.scene.copy_report import SubjectReport

CAMERA_FILE, POSES_FILE = "cameras.npz", "poses.npz"
REFINED = {"train": "poses/anim_nerf_train.npz", "test": "poses/anim_nerf_test.npz"}
IMAGE_NAME = re.compile(r"image_(\d{4,9})\.png")
# confs/dataset/peoplesnapshot/*.yaml; their ends are inclusive
OFFICIAL_FRAMES = {
    "female-3-casual": {"train": range(0, 446, 4), "test": range(446, 648, 4)},
    "female-4-casual": {"train": range(0, 336, 4), "test": range(335, 524, 4)},
    "male-3-casual": {"train": range(0, 456, 4), "test": range(456, 676, 4)},
    "male-4-casual": {"train": range(0, 660, 6), "test": range(660, 873, 6)},
}


class InstantAvatarFolder(SubjectFolders["InstantAvatarCapture"]):
    """A folder that holds subjects' folders of InstantAvatar's layout, or one of those folders itself."""

    dataset, layout = "people_snapshot", "instantavatar"
    content = f"InstantAvatar's layout (images/image_0000.png, masks/, {CAMERA_FILE}, {POSES_FILE})"

    @staticmethod
    def holds(folder: Path) -> bool:
        """GaussianAvatar's copies, made beside cameras.npz and images/ of their source, are GaussianAvatar's."""
        parts = (folder / CAMERA_FILE).is_file(), (folder / POSES_FILE).is_file()
        if not any(parts) or PeopleSnapshotRaw.holds(folder) or GaussianAvatarFolder.holds(folder):
            return False
        return all(parts) or any((folder / "images").glob("image_*.png"))

    def capture(self, subject: str, body: Body | None) -> InstantAvatarCapture:
        return InstantAvatarCapture(self._folders[subject], body)

    def inspect(self, capture: InstantAvatarCapture, report: SubjectReport) -> list[View]:
        report.gender = capture.gender
        n_poses = len(capture._poses[0])
        paths = {"image": capture.image_path, "mask": capture.mask_path}
        frames = range(capture.n_frames)
        there = count_files(report, {kind: {f: path_of(f) for f in frames} for kind, path_of in paths.items()})
        refined = {f"anim_nerf_{split}": len(frames) for split, (frames, _) in capture.refined.items()}
        report.files |= {"poses": n_poses, **refined}
        if surplus := sum(frame >= n_poses for frame in capture.images):
            report.warn(f"{surplus} images have no pose in {POSES_FILE} and are not used")
        if not capture.standin and (surplus := n_poses - capture.n_frames) > 0:
            report.warn(f"{surplus} poses after the last image are not used")
        report_spoiled_rows(report, capture.folder / POSES_FILE, *capture._poses[:2])
        for split, (_, poses) in capture.refined.items():
            report_spoiled_rows(report, capture.folder / REFINED[split], *poses[:2])
        return [(0, frame) for frame in sorted(there["image"] & there["mask"])]


class InstantAvatarCapture(SnapshotPictures):
    """One subject, read lazily; see `scene.contracts.Capture`. Keeps no images.

    There are as many frames as poses; images that real data lack at the end shorten it.
    """

    def __init__(self, folder: Path, body: Body | None = None):
        super().__init__(folder, folder.name, body)
        self._camera = read_camera(folder / CAMERA_FILE)
        self._poses = read_poses(folder / POSES_FILE)
        self.images = _numbered_images(folder / "images")
        n_poses = len(self._poses[0])
        if not self.images:
            raise BadInput(f"{folder / 'images'}: no image_NNNN.png in it; expected the subject's frames")
        # a stand-in holds only the images it was asked for
        self.n_frames = n_poses if self.standin else min(n_poses, self.images[-1] + 1)
        self.refined = {
            split: read_refined(folder / name, split, self.name, n_poses)
            for split, name in REFINED.items()
            if (folder / name).is_file()
        }
        self._row_of: dict[int, tuple[str, int]] = {}
        for split, (frames, _) in self.refined.items():
            for row, frame in enumerate(frames):
                if frame in self._row_of:
                    other = self._row_of[frame][0]
                    raise BadInput(
                        f"{folder / REFINED[split]}: frame {frame} has refined poses in {REFINED[other]}, too; "
                        f"expected each frame once, move one of the files away"
                    )
                self._row_of[frame] = split, row
        self.variant = "instantavatar/anim_nerf" if self.refined else "instantavatar"

    def camera(self, camera: int) -> Camera:
        """The one camera; without distortion, since the images are undistorted."""
        self.check_index(camera, 0)
        return self._camera

    def body_pose(self, frame: int) -> BodyPose:
        """The frame's SMPL parameters, standard root convention: Anim-NeRF's where there are any."""
        self.check_index(0, frame)
        if frame not in self._row_of:
            return finite_pose(self.folder / POSES_FILE, frame, *self._poses)
        split, row = self._row_of[frame]
        return finite_pose(self.folder / REFINED[split], row, *self.refined[split][1])

    def image_path(self, frame: int) -> Path:
        return self.folder / "images" / f"image_{frame:04d}.png"

    def mask_path(self, frame: int) -> Path:
        return self.folder / "masks" / f"mask_{frame:04d}.npy"

    @staticmethod
    def read_mask(path: Path) -> NDArray[np.bool_]:
        mask = load_npy(path)
        mask = mask[..., 0] if mask.ndim == 3 and mask.shape[2] == 1 else mask
        if mask.ndim != 2 or not mask.size or mask.dtype.kind not in "biuf":
            raise BadInput(f"{path}: expected numbers of shape [H, W], found {described(mask)}")
        return soft_mask(mask, path)


def _numbered_images(folder: Path) -> list[int]:
    if not folder.is_dir():
        return []
    matches = (IMAGE_NAME.fullmatch(path.name) for path in folder.iterdir())
    return sorted(int(match[1]) for match in matches if match)


def read_camera(path: Path) -> Camera:
    """The camera of cameras.npz. Raises `BadInput` naming the entry that is not as expected."""
    stored = read_npz(path, "intrinsic, extrinsic, height and width")
    K, E = stored_pinhole(stored, path)
    width, height = (float(numbers(stored, key, (1,), path)[0]) for key in ("width", "height"))
    if not (width.is_integer() and height.is_integer() and 1 <= width <= 65535 and 1 <= height <= 65535):
        raise BadInput(f"{path}: expected width and height in whole pixels, found {width:g} and {height:g}")
    return Camera.from_opencv(K, E[:3, :3], E[:3, 3], int(width), int(height))


def read_poses(path: Path) -> Poses:
    """(thetas [N, 72] rad, transl [N, 3] m, betas [10]); poses may hold NaN. Raises `BadInput` for other shapes.

    Accepts `global_orient` [N, 3] and `body_pose` [N, 69] in place of thetas, as InstantAvatar does.
    """
    stored = read_npz(path, "betas, thetas and transl")
    if "thetas" not in stored and {"global_orient", "body_pose"} <= stored.keys():
        root, others = (
            numbers(stored, *part, path, False) for part in (("global_orient", (-1, 3)), ("body_pose", (-1, 69)))
        )
        if len(root) != len(others):
            raise BadInput(f"{path}: expected as many global_orient as body_pose, found others")
        stored["thetas"] = np.concatenate([root, others], 1)
    return stored_poses(stored, path, "thetas", "transl", "betas")


def read_refined(path: Path, split: str, subject: str, n_frames: int) -> tuple[list[int], Poses]:
    """The frames of one of Anim-NeRF's files, and their poses.

    Raises `BadInput` when the file does not say its frames and the subject's official split has another count.
    """
    poses = read_poses(path)
    count = len(poses[0])
    stored = read_npz(path, "frames").get("frames")
    if stored is not None:
        if stored.dtype.kind not in "iu" or stored.shape != (count,) or len(np.unique(stored)) != count:
            raise BadInput(f"{path}: expected {count} different frame numbers in 'frames', found others")
        frames = stored.tolist()
    else:
        official = OFFICIAL_FRAMES.get(subject, {}).get(split)
        if official is None or len(official) != count:
            known = f"its {split} split has {len(official)}" if official else "it has no official split"
            raise BadInput(
                f"{path}: {count} poses, but no 'frames' says whose, and of {subject!r} is known that {known}; "
                f"add the frame numbers as 'frames', or move the file away"
            )
        frames = list(official)
    if min(frames) < 0 or max(frames) >= n_frames:
        raise BadInput(
            f"{path}: refines frames {min(frames)} to {max(frames)}, but {POSES_FILE} has {n_frames} poses; "
            f"expected frames of this subject"
        )
    return frames, poses


# ----------------------------------------------------------------------------------------------- write


def write_camera(folder: Path, camera: Camera) -> None:
    """cameras.npz. Lossless, but for distortion, which this layout lacks: `ValueError`."""
    K, E = stored_camera(camera, "InstantAvatar")
    size = {"height": np.array(camera.height), "width": np.array(camera.width)}
    write_npz(folder / CAMERA_FILE, {"intrinsic": K, "extrinsic": E, **size}, durable=False)


def write_poses(folder: Path, poses: Sequence[BodyPose]) -> None:
    """poses.npz, float32 (1e-6 rad and m): a pose for each frame from 0. `ValueError` when the betas differ."""
    thetas, transl, betas = stacked(poses)
    write_npz(folder / POSES_FILE, {"betas": betas, "thetas": thetas, "transl": transl}, durable=False)


def write_frame(
    folder: Path,
    frame: int,
    image: NDArray[np.uint8] | None = None,  # [H, W, 3] RGB
    mask: NDArray | None = None,  # [H, W] non-zero = person
) -> None:
    """The frame's image as PNG and its mask as uint8 0/1. Lossless. None is not written."""
    if image is not None:
        write_picture(folder / "images" / f"image_{frame:04d}.png", image)
    if mask is not None:
        buffer = io.BytesIO()
        np.save(buffer, (mask != 0).astype(np.uint8))
        atomic.write_bytes(folder / "masks" / f"mask_{frame:04d}.npy", buffer.getvalue(), durable=False)
