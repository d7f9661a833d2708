"""Stand-ins in ZJU-MoCap's own layout, written where they are missing, so that the real loader reads them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.datasets.standin.cast import alone_with, cast_names, open_cast
from ihbench.datasets.standin.motion import N_FRAMES, NOVEL_FRAMES
from ihbench.datasets.standin.photograph import photograph
from ihbench.datasets.standin.rig import N_CAMERAS
from ihbench.datasets.standin.studio import empty_studio
from ihbench.datasets.standin.subject import Subject
from ihbench.datasets.zju_mocap import original as zju_mocap
from ihbench.errors import BadInput

VERSION = 2  # of the generator; a change that moves a pixel raises it
ALL_FRAMES = N_FRAMES + NOVEL_FRAMES
WAITING_THREADS = 2  # beyond one a core: they wait for the disk while the others draw


class ZjuStandIn:
    """Makes captures of procedural people. A file depends on (VERSION, seed, subject, camera, frame) only."""

    version = VERSION
    protocol = "zju_occ"  # what it is made for
    n_frames = ALL_FRAMES
    n_cameras = N_CAMERAS

    @staticmethod
    def subjects(count: int = 6) -> list[str]:
        """The names of the first `count` people of a cast."""
        return cast_names(count)

    @staticmethod
    def camera_ids(subject: str) -> tuple[str, ...]:
        """The cameras of a subject as its capture will name them."""
        return tuple(str(Path(image).parent) for image in zju_mocap.standard_image_paths(N_CAMERAS, 1)[0])

    @staticmethod
    def ensure(
        root: Path,
        seed: int,
        subjects: list[str],
        wanted: Mapping[int, Iterable[int]],  # camera -> frames
        progress: Progress | None = None,
    ) -> Path:
        """Write what is wanted and not yet there below `root`, and return `root`.

        annots.npy lists every frame and camera and the parameters cover every frame, as in the real data; images,
        masks and vertices are written for the wanted frames only. Interrupted, the same call goes on where it
        stopped. Raises `BadInput` for an unknown subject, camera or frame, and when `root` holds something else.
        """
        frames_of = {camera: sorted(set(frames)) for camera, frames in sorted(wanted.items())}
        _check_wanted(frames_of)
        root, people = open_cast(root, VERSION, seed, subjects)
        progress = progress or Progress.silent()
        for name, person in zip(subjects, people, strict=True):
            folder = root / f"{zju_mocap.FOLDER_PREFIX}{name}"
            if _missing(folder, frames_of) is not None:
                with alone_with(root, name, progress):
                    _ensure_subject(folder, name, person, frames_of, progress)
        return root


def _check_wanted(frames_of: dict[int, list[int]]) -> None:
    for camera, frames in frames_of.items():
        if not 0 <= camera < N_CAMERAS:
            raise BadInput(f"stand-in camera {camera}: expected 0 to {N_CAMERAS - 1}")
        outside = next((frame for frame in frames if not 0 <= frame < ALL_FRAMES), None)
        if outside is not None:
            raise BadInput(f"stand-in frame {outside}: expected 0 to {ALL_FRAMES - 1}")


def _ensure_subject(
    folder: Path, name: str, subject: Subject, frames_of: dict[int, list[int]], progress: Progress
) -> None:
    missing = _missing(folder, frames_of)
    if missing is None:  # another process has made them meanwhile
        return
    paths, pictures, vertices, params = missing

    @lru_cache(maxsize=128)
    def clothed(frame: int) -> NDArray[np.float64]:
        return subject.clothed_vertices(frame)

    @lru_cache(maxsize=3)  # pictures come camera by camera
    def studio(camera: int) -> NDArray[np.uint8]:
        return empty_studio(subject.cameras[camera], subject.studio_seed)

    def write_picture(pair: tuple[int, int]) -> None:
        camera, frame = pair
        shot = photograph(
            clothed(frame),
            subject.body,
            subject.texture,
            subject.labels,
            subject.lighting,
            subject.cameras[camera],
            studio(camera),
        )
        zju_mocap.write_frame(folder, paths[frame][camera], shot.image, shot.mask, shot.parts)

    if not (folder / "annots.npy").is_file():
        zju_mocap.write_annots(folder, subject.cameras, paths)
    for frame in params:
        zju_mocap.write_params(folder, frame, subject.body_poses[frame], subject.body)
    for frame in vertices:
        zju_mocap.write_vertices(folder, frame, subject.vertices(frame))
    if not pictures:
        return
    with progress.task(f"photographing {name}", total=len(pictures)) as task:
        write_picture(pictures[0])  # computes what the threads share before they start
        task.advance()
        pool = ThreadPoolExecutor((os.cpu_count() or 1) + WAITING_THREADS)
        try:
            for _ in pool.map(write_picture, pictures[1:]):
                task.advance()
        finally:
            pool.shutdown(cancel_futures=True)


Missing = tuple[list[list[str]], list[tuple[int, int]], list[int], list[int]]


def _missing(folder: Path, frames_of: dict[int, list[int]]) -> Missing | None:
    """(image paths by frame and camera, pictures, frames of vertices, of parameters) to make; None for nothing."""
    paths = zju_mocap.standard_image_paths(N_CAMERAS, ALL_FRAMES)
    wanted_frames = sorted({frame for frames in frames_of.values() for frame in frames})
    pictures = [
        (camera, frame)
        for camera, frames in frames_of.items()
        for frame in frames
        if not _all_there(folder, paths[frame][camera])
    ]
    vertices = [frame for frame in wanted_frames if not (folder / "new_vertices" / f"{frame}.npy").is_file()]
    params = [frame for frame in range(ALL_FRAMES) if not (folder / "new_params" / f"{frame}.npy").is_file()]
    there = (folder / "annots.npy").is_file() and not (pictures or vertices or params)
    return None if there else (paths, pictures, vertices, params)


def _all_there(folder: Path, image_path: str) -> bool:
    masks = [(folder / kind / image_path).with_suffix(".png") for kind in ("mask", "mask_cihp")]
    return all(path.is_file() for path in (folder / image_path, *masks))
