"""Stand-ins in PeopleSnapshot's raw layout: one and a half turns in an A-pose before a fixed camera.

The camera is the world, as in the real data. Frames 0 to 159 are the first turn, 160 to 239 the half turn after it.
Beside each subject's files lies `truth/`, which no loader reads: the texture and the surface that were photographed.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera, look_at
from ihbench.clock.progress import Progress
from ihbench.datasets.people_snapshot import original as people_snapshot
from ihbench.datasets.standin import motion
from ihbench.datasets.standin.cast import StandIn
from ihbench.datasets.standin.photograph import Photograph
from ihbench.datasets.standin.studio import empty_studio
from ihbench.datasets.standin.subject import Subject
from ihbench.files import atomic
from ihbench.files.pictures import encoded

TURN_FRAMES, TEST_FRAMES = 160, 80
N_FRAMES = TURN_FRAMES + TEST_FRAMES
TURNS = 1.5
SIZE = 1080  # px


class PeopleSnapshotStandIn(StandIn):
    """A subject is made whole, whatever is wanted of it."""

    version = 1
    protocol = "people_snapshot_occ"
    n_frames = N_FRAMES

    @staticmethod
    def camera_ids(subject: str) -> tuple[str, ...]:
        return people_snapshot.SnapshotFolder.camera_ids

    @staticmethod
    def missing(folder: Path, frames_of: dict[int, list[int]]) -> bool:
        return not (folder / people_snapshot.POSES_FILE).is_file()  # written last

    @staticmethod
    def make(folder: Path, name: str, subject: Subject, missing: bool, progress: Progress) -> None:
        show = motion.turntable(subject.rng("turntable"), N_FRAMES, TURNS)
        poses = motion.body_poses(show, subject.betas, subject.body)
        camera = studio_camera(subject.rng("camera"))
        background = empty_studio(camera, subject.studio_seed)
        masks: NDArray[np.bool_] = np.zeros((N_FRAMES, SIZE, SIZE), bool)

        def shoot(frame: int) -> Photograph:
            surface = subject.body.pose(poses[frame], offsets=subject.offsets)
            return subject.photograph(surface, camera, background)

        def frames(pool: ThreadPoolExecutor) -> Iterator[NDArray[np.uint8]]:
            with progress.task(f"filming {name}", total=N_FRAMES) as task:
                step = 8  # photographs in memory
                for start in range(0, N_FRAMES, step):
                    some = range(start, min(start + step, N_FRAMES))
                    for frame, shot in zip(some, pool.map(shoot, some), strict=True):
                        masks[frame] = shot.mask
                        yield shot.image
                        task.advance()

        shoot(0)  # computes what the threads share before they start
        with ThreadPoolExecutor((os.cpu_count() or 1) + 1) as pool:
            people_snapshot.write_video(folder / f"{folder.name}.mp4", frames(pool))
        own = Camera(camera.K, np.eye(3), np.zeros(3), SIZE, SIZE, camera.distortion)
        people_snapshot.write_camera(folder, own)
        people_snapshot.write_masks(folder, masks, masks.shape)
        people_snapshot.write_consensus(folder, subject.betas, subject.offsets)
        texture = np.rint(np.clip(subject.baked[0], 0, 1) * 255).astype(np.uint8)
        atomic.write_bytes(folder / "truth" / "texture.png", encoded(texture, "PNG"))
        pelvis = subject.body.shaped(subject.betas)[1][0]
        people_snapshot.write_poses(folder, [in_camera_space(pose, camera, pelvis) for pose in poses])


def studio_camera(rng: np.random.Generator) -> Camera:
    """A camera about 2.9 m before the person at hip height, in the studio's world (z up)."""
    eye = np.array([rng.uniform(-0.05, 0.05), -rng.uniform(2.85, 3.0), rng.uniform(0.85, 1.05)])
    R, t = look_at(eye, np.array([0.0, 0.0, rng.uniform(0.9, 0.95)]), up=np.array([0.0, 0.0, 1.0]))
    focal = rng.uniform(1280, 1340) * SIZE / 1080
    centre = SIZE / 2 + rng.uniform(-6, 6, 2)
    K = np.array([[focal, 0, centre[0]], [0, focal * rng.uniform(0.998, 1.002), centre[1]], [0, 0, 1]])
    k1 = rng.uniform(-0.12, -0.05)
    lens = np.array([k1, -0.4 * k1, *rng.uniform(-5e-4, 5e-4, 2), 0.0])
    return Camera(K, R, t, SIZE, SIZE, lens)


def in_camera_space(body_pose: BodyPose, camera: Camera, pelvis: NDArray[np.float64]) -> BodyPose:
    """The pose in a world whose axes and origin are the camera's; pelvis [3] m is the shaped body's joint 0."""
    from scipy.spatial.transform import Rotation

    pose = body_pose.pose.copy()
    pose[0] = Rotation.from_matrix(camera.R @ axis_angle_to_matrix(body_pose.pose[0])).as_rotvec()
    transl = camera.R @ (pelvis + body_pose.transl) + camera.t - pelvis
    return BodyPose(pose, body_pose.betas, transl)
