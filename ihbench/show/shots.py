"""What is to be seen: a camera, a pose and, where the data set photographed just that, the truth, frame by frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.errors import BadInput
from ihbench.registry import nearest
from ihbench.scene.views import straight_camera
from ihbench.show.framing import ELEVATION, SIDES, Framing, orbit, some_of
from ihbench.show.motion import Motion, Stand, placed, stand_of, up_axis
from ihbench.show.subject import Subject
from ihbench.show.trajectory import read_trajectory

RATE = 25.0  # frames per second where nothing says otherwise
SIZE = 512  # px


@dataclass(frozen=True)
class Shot:
    """One frame of one run."""

    camera: Camera
    body_pose: BodyPose
    frame: int | None = None  # as `Avatar.render` takes it
    truth: Callable[[], NDArray[np.float32]] | None = None  # [H, W, 3]


@dataclass(frozen=True)
class View:
    """What somebody wants to see. One of `orbit` and `camera`; with neither the camera goes around once."""

    orbit: int | None = None  # frames of one turn
    camera: str | None = None  # a side (`SIDES`), a camera of the data set, or a file of a path
    pose: str | None = None  # see `Subject.pose`
    motion: str | None = None  # see `Subject.motion`
    size: tuple[int, ...] = ()  # px: width and height, or the side of a square; of given cameras the longer side
    fps: float | None = None
    elevation: float = ELEVATION  # degrees


@dataclass(frozen=True)
class Take:
    shots: list[Shot]
    fps: float
    as_scored: bool = False  # by a camera of the data set in the protocol's size


def take_of(subject: Subject, view: View) -> Take:
    """The shots of one run. Raises `BadInput` for what its data do not have."""
    if view.orbit is not None and view.camera is not None:
        raise BadInput("--orbit and --camera: expected one of them; a path in a file is a camera that moves, too")
    if view.camera is not None and view.camera not in SIDES:
        if Path(view.camera).suffix.lower() == ".json":
            return _along_path(subject, view, Path(view.camera))
        return _from_data_camera(subject, view, view.camera)
    return _around(subject, view)


def _around(subject: Subject, view: View) -> Take:
    """From cameras that are made for the body."""
    fps = view.fps or RATE
    frames = view.orbit if view.orbit is not None else None
    if frames is None and view.camera is None and view.motion is None:
        frames = 60
    poses = _poses(subject, view, fps, frames)
    stand = stand_of(subject.body, poses[0], up_axis(poses))
    seen = some_of(len(poses))
    pelvis = np.stack([subject.body.posed_joints(p)[0] for p in poses])
    vertices = [subject.body.pose(poses[k]) for k in seen]
    framing = Framing.of(vertices, seen, pelvis, stand)
    width, height = (*view.size, *view.size, SIZE, SIZE)[:2] if len(view.size) != 2 else view.size
    if frames is None:
        degrees = SIDES[view.camera or "front"]
        cameras = [framing.camera(k, degrees, width, height, view.elevation) for k in range(len(poses))]
    else:
        cameras = orbit(framing, frames, width, height, view.elevation)
        poses = poses * frames if len(poses) == 1 else poses
    return Take([Shot(camera, pose) for camera, pose in zip(cameras, poses, strict=True)], fps)


def _along_path(subject: Subject, view: View, file: Path) -> Take:
    path = read_trajectory(file)
    fps = view.fps or path.fps or RATE
    poses = _poses(subject, view, fps, len(path.cameras))
    poses = poses * len(path.cameras) if len(poses) == 1 else poses
    cameras = [_sized(camera, view.size) for camera in path.cameras]
    return Take([Shot(camera, pose) for camera, pose in zip(cameras, poses, strict=True)], fps)


def _from_data_camera(subject: Subject, view: View, name: str) -> Take:
    """From a camera of the data set: its test views, or a pose or motion before it."""
    run, fps = subject.run, view.fps or RATE
    capture, protocol = run.capture, run.protocol
    if name not in capture.camera_ids:
        known = [*SIDES, *map(str, capture.camera_ids)]
        raise BadInput(
            f"--camera {name}: neither a camera of {capture.name} nor a path's .json: {nearest(name, known)}"
        )
    number = capture.camera_ids.index(name)
    camera = _sized(straight_camera(capture.camera(number), protocol.image), view.size)
    keys = list(enumerate(run.scene.test_keys))
    tests = {key.frame: index for index, key in reversed(keys) if key.camera == number}
    if view.motion is not None:
        first = capture.body_pose(min(tests or subject.training_frames))
        stand = stand_of(subject.body, first, up_axis([first]))
        motion = placed(subject.motion(view.motion, fps), subject.body, subject.betas, stand)
        return Take([Shot(camera, pose) for pose in motion.body_poses(subject.betas)], fps, not view.size)
    if view.pose is not None and not view.pose.isdecimal():
        first = capture.body_pose(min(tests or subject.training_frames))
        pose = subject.pose(view.pose)
        stand = stand_of(subject.body, first, up_axis([first]))
        return Take([Shot(camera, _moved(subject, pose, stand))], fps, not view.size)
    frames = [int(view.pose)] if view.pose is not None else sorted(tests) or subject.training_frames
    trained = set(subject.training_frames)
    shots = []
    for frame in frames:
        pose = subject.pose(str(frame))
        truth = _truth(subject, tests[frame], camera) if frame in tests else None
        shots.append(Shot(camera, pose, frame if frame in trained else None, truth))
    return Take(shots, fps, not view.size)


def _truth(subject: Subject, index: int, camera: Camera) -> Callable[[], NDArray[np.float32]]:
    def image() -> NDArray[np.float32]:
        truth = subject.run.scene.test[index].image
        if truth.shape[:2] == (camera.height, camera.width):
            return truth
        import cv2

        larger = camera.width > truth.shape[1]
        how = cv2.INTER_LINEAR if larger else cv2.INTER_AREA
        return np.asarray(cv2.resize(truth, (camera.width, camera.height), interpolation=how), np.float32)

    return image


def _moved(subject: Subject, pose: BodyPose, stand: Stand) -> BodyPose:
    one = Motion(pose.pose[None], pose.transl[None], RATE)
    return placed(one, subject.body, subject.betas, stand).body_poses(subject.betas)[0]


def _poses(subject: Subject, view: View, fps: float, frames: int | None) -> list[BodyPose]:
    """One for each frame, or one for all."""
    if view.motion is None:
        return [subject.pose(view.pose or "a_pose", centred=True)]
    if view.pose is not None:
        raise BadInput("--pose and --motion: expected one of them; a motion has its own poses")
    motion = subject.motion(view.motion, fps)
    return (motion if frames is None else motion.resampled(fps, frames)).body_poses(subject.betas)


def _sized(camera: Camera, size: Sequence[int]) -> Camera:
    if not size:
        return camera
    if len(size) > 1:
        raise BadInput("--size: of cameras that have a shape of their own, give the longer side alone")
    share = size[0] / max(camera.width, camera.height)
    return camera.scaled(max(1, round(camera.width * share)), max(1, round(camera.height * share)))
