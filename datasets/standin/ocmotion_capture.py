"""Stand-ins in the layout of OcMotion's `_w2a` sequences: a person walks and reaches behind furniture.

One hundred frames from one of six calibrated cameras; the masks are of visible pixels, decided by depth. Beside each
sequence's files lies `truth/`, which no loader reads: the complete silhouettes, and the images without the furniture
before the person (everything behind them stays).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ihbench.camera import Camera, look_at
from ihbench.clock.progress import Progress
from ihbench.datasets.ocmotion import wild2avatar as ocmotion_w2a
from ihbench.datasets.standin import motion
from ihbench.datasets.standin.cast import StandIn, in_threads
from ihbench.datasets.standin.furniture import furnish, furniture_view
from ihbench.datasets.standin.studio import empty_studio
from ihbench.datasets.standin.subject import Subject
from ihbench.files import atomic
from ihbench.files.pictures import encoded, write_picture

N_FRAMES = 100
N_CAMERAS = 6  # of the rig; the images are of the first
WIDTH, HEIGHT = 960, 720  # px
REACH = 0.75  # m to either side that the person walks


class OcMotionStandIn(StandIn):
    """A sequence is made whole, whatever is wanted of it."""

    version = 1
    protocol = "ocmotion_visible"
    n_frames = N_FRAMES

    @staticmethod
    def camera_ids(subject: str) -> tuple[str, ...]:
        return (ocmotion_w2a.camera_id(subject),)

    @staticmethod
    def missing(folder: Path, frames_of: dict[int, list[int]]) -> list[int]:
        """Frames, by the file that is written last of each."""
        last = (folder / "truth" / "masks" / f"{frame:05d}.png" for frame in range(N_FRAMES))
        return [frame for frame, path in enumerate(last) if not path.is_file()]

    @staticmethod
    def make(folder: Path, name: str, subject: Subject, missing: list[int], progress: Progress) -> None:
        names = [f"{frame:05d}" for frame in range(N_FRAMES)]
        show = motion.stroll(subject.rng("stroll"), N_FRAMES, REACH)
        poses = motion.body_poses(show, subject.betas, subject.body)
        cameras = room_cameras(subject.rng("room"))
        if not (folder / ocmotion_w2a.METADATA).is_file():
            ocmotion_w2a.write_mesh_infos(folder, names, poses, subject.body)
            ocmotion_w2a.write_all_cameras(folder, names, cameras)
            ocmotion_w2a.write_sequence_metadata(folder, names, cameras[0], poses)  # is last: it stands for all three
        room = empty_studio(cameras[0], subject.studio_seed)
        furniture = furniture_view(furnish(subject.rng("furniture")), subject.lighting, cameras[0], room)

        def write(k: int) -> None:
            surface = subject.body.pose(poses[k], offsets=subject.offsets)
            shot = subject.photograph(surface, cameras[0], furniture.image)
            before = furniture.depth < shot.depth
            image = np.where(before[..., None], furniture.image, shot.image)
            ocmotion_w2a.write_frame(folder, names[k], image, shot.mask & ~before)
            write_picture(folder / "truth" / "images" / f"{names[k]}.jpg", shot.image)
            silhouette = encoded(shot.mask.astype(np.uint8) * 255, "PNG")
            atomic.write_bytes(folder / "truth" / "masks" / f"{names[k]}.png", silhouette, durable=False)  # is last

        in_threads(write, missing, f"filming {name}", progress)


def room_cameras(rng: np.random.Generator) -> list[Camera]:
    """Six cameras without lens distortion around the room, world z up; the first looks across the furniture."""
    cameras = []
    for k in range(N_CAMERAS):
        azimuth = -np.pi / 2 + 2 * np.pi * k / N_CAMERAS + np.deg2rad(rng.uniform(-4, 4))
        radius = rng.uniform(3.3, 3.6)
        eye = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(1.25, 1.45)])
        R, t = look_at(eye, np.array([0.0, 0.0, rng.uniform(0.88, 0.95)]), up=np.array([0.0, 0.0, 1.0]))
        focal = rng.uniform(0.83, 0.87) * WIDTH
        centre = np.array([WIDTH, HEIGHT]) / 2 + rng.uniform(-8, 8, 2)
        K = np.array([[focal, 0, centre[0]], [0, focal, centre[1]], [0, 0, 1]])
        cameras.append(Camera(K, R, t, WIDTH, HEIGHT))
    return cameras
