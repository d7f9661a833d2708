"""Stand-ins in ZJU-MoCap's own layout, written where they are missing, so that the real loader reads them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.datasets.standin.cast import StandIn, in_threads
from ihbench.datasets.standin.motion import N_FRAMES, NOVEL_FRAMES
from ihbench.datasets.standin.rig import N_CAMERAS
from ihbench.datasets.standin.studio import empty_studio
from ihbench.datasets.standin.subject import Subject
from ihbench.datasets.zju_mocap import original as zju_mocap

ALL_FRAMES = N_FRAMES + NOVEL_FRAMES
PATHS = zju_mocap.standard_image_paths(N_CAMERAS, ALL_FRAMES)  # by frame and camera


class Missing(NamedTuple):
    """What is to be made of one subject."""

    annots: bool
    pictures: list[tuple[int, int]]  # camera, frame
    vertices: list[int]  # frames
    params: list[int]  # frames


class ZjuStandIn(StandIn):
    """annots.npy lists every frame and camera and the parameters cover every frame, as in the real data; images,
    masks and vertices are written for the wanted frames only."""

    version = 2
    protocol = "zju_occ"
    n_frames = ALL_FRAMES
    n_cameras = N_CAMERAS
    folder_prefix = zju_mocap.FOLDER_PREFIX

    @staticmethod
    def camera_ids(subject: str) -> tuple[str, ...]:
        return tuple(str(Path(image).parent) for image in PATHS[0])

    @staticmethod
    def missing(folder: Path, frames_of: dict[int, list[int]]) -> Missing | None:
        pairs = [(camera, frame) for camera, frames in frames_of.items() for frame in frames]
        frames = sorted({frame for _, frame in pairs})
        missing = Missing(
            annots=not (folder / "annots.npy").is_file(),
            pictures=[(camera, frame) for camera, frame in pairs if not _all_there(folder, PATHS[frame][camera])],
            vertices=[frame for frame in frames if not (folder / "new_vertices" / f"{frame}.npy").is_file()],
            params=[frame for frame in range(ALL_FRAMES) if not (folder / "new_params" / f"{frame}.npy").is_file()],
        )
        return missing if any(missing) else None

    @staticmethod
    def make(folder: Path, name: str, subject: Subject, missing: Missing, progress: Progress) -> None:
        @lru_cache(maxsize=128)
        def clothed(frame: int) -> NDArray[np.float64]:
            return subject.clothed_vertices(frame)

        @lru_cache(maxsize=3)  # pictures come camera by camera
        def studio(camera: int) -> NDArray[np.uint8]:
            return empty_studio(subject.cameras[camera], subject.studio_seed)

        def write_picture(pair: tuple[int, int]) -> None:
            camera, frame = pair
            shot = subject.photograph(clothed(frame), subject.cameras[camera], studio(camera))
            zju_mocap.write_frame(folder, PATHS[frame][camera], shot.image, shot.mask, shot.parts)

        if missing.annots:
            zju_mocap.write_annots(folder, subject.cameras, PATHS)
        for frame in missing.params:
            zju_mocap.write_params(folder, frame, subject.body_poses[frame], subject.body)
        for frame in missing.vertices:
            zju_mocap.write_vertices(folder, frame, subject.vertices(frame))
        if missing.pictures:
            in_threads(write_picture, missing.pictures, f"photographing {name}", progress)


def _all_there(folder: Path, image_path: str) -> bool:
    masks = [(folder / kind / image_path).with_suffix(".png") for kind in ("mask", "mask_cihp")]
    return all(path.is_file() for path in (folder / image_path, *masks))
