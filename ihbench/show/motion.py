"""What a body does over time: motions from files and built-in ones, in any rate, anywhere in the world.

Read are AMASS' own files (`poses` [T, 156] of SMPL-H or [T, 165] of SMPL-X, `trans`, `mocap_framerate`), SMPL poses
under the same names ([T, 72]), and this project's `poses.npz` (`pose`, `transl`; `datasets/plain/plain_scene.md`), as
InstantAvatar's (`thetas`, `transl`). Of SMPL-H and SMPL-X the 22 joints count that SMPL shares; hands stay straight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import SMPLX_SIZES
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.errors import BadInput
from ihbench.files.npz import read_npz

if TYPE_CHECKING:
    from ihbench.body import Body

Array = NDArray[np.float64]

POSES, PLACES = ("poses", "pose", "thetas", "smpl_poses"), ("trans", "transl", "smpl_trans")
RATES = ("mocap_framerate", "mocap_frame_rate", "framerate", "fps")
LARGEST = 2**29  # bytes of one array: AMASS' longest recordings have a tenth of it
MOST_FRAMES = 100_000
UNKNOWN_RATE = 30.0  # frames per second of a file that does not say
UPRIGHT_WITHIN = 0.85  # cosine to a world axis within which that axis is up, and not the mean body's own


@dataclass(frozen=True)
class Motion:
    """Poses of one body at equal steps of time. With `cyclic`, the first frame follows the last one."""

    pose: Array  # [T, 24, 3] rad
    transl: Array  # [T, 3] m
    fps: float
    cyclic: bool = False

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def seconds(self) -> float:
        return (len(self) if self.cyclic else max(len(self) - 1, 0)) / self.fps

    def body_poses(self, betas: Array) -> list[BodyPose]:
        """One for each frame, of a body of this shape."""
        return [BodyPose(pose, betas, transl) for pose, transl in zip(self.pose, self.transl, strict=True)]

    def resampled(self, fps: float, frames: int | None = None) -> Motion:
        """At another rate: joints turn evenly between two frames, places lie on a line. `frames` of them, over and
        over if need be; by default as many as the motion lasts."""
        count = max(1, round(self.seconds * fps) + (not self.cyclic)) if frames is None else frames
        at = np.arange(count) * self.fps / fps
        if len(self) == 1:
            return replace(self, pose=self.pose.repeat(count, 0), transl=self.transl.repeat(count, 0), fps=fps)
        at = np.mod(at, len(self)) if self.cyclic else np.mod(at, len(self) - 1 + 1e-9)
        low = np.floor(at).astype(int)
        share, high = at - low, (low + 1) % len(self)
        transl = self.transl[low] + share[:, None] * (self.transl[high] - self.transl[low])
        return Motion(_between(self.pose[low], self.pose[high], share), transl, fps, self.cyclic)

    def standing_on(self, body: Body, betas: Array) -> Motion:
        """Of a motion in SMPL's axes, y up: moved so that the body's lowest point is at y = 0 throughout."""
        transl = self.transl.copy()
        for k, body_pose in enumerate(self.body_poses(betas)):
            transl[k, 1] -= body.pose(body_pose)[:, 1].min()
        return replace(self, transl=transl)


@dataclass(frozen=True)
class Loop:
    """A movement on the spot without a seam, registered under `ihbench.motions`. SMPL's axes: y up, facing +z."""

    seconds: float
    poses: Callable[[Array], Array]  # [T] rad, 0 to 2 pi in one repetition -> [T, 24, 3] rad

    def motion(self, fps: float, body: Body, betas: Array) -> Motion:
        """One repetition of it, the feet on the floor at y = 0."""
        frames = max(1, round(self.seconds * fps))
        pose = np.asarray(self.poses(np.arange(frames) * 2 * np.pi / frames), np.float64)
        return Motion(pose, np.zeros((frames, 3)), fps, cyclic=True).standing_on(body, betas)


def find_motion(name: str, fps: float, body: Body, betas: Array) -> Motion:
    """A built-in motion by name, or a file's, at this rate. Raises `BadInput` for neither."""
    known = registry.names("motion")
    if name in known:
        loop = registry.load("motion", name)
        return loop.motion(fps, body, betas)
    path = Path(name)
    if path.suffix != ".npz" and not path.exists():
        raise BadInput(
            f"--motion {name}: neither a file nor a built-in motion: {registry.nearest(name, [*known, 'capture'])}"
        )
    return read_motion(path, body, betas).resampled(fps)


def read_motion(path: Path, body: Body, betas: Array) -> Motion:
    """A file of poses. Raises `BadInput` for other contents.

    The shape that the file names is left alone: the motion is given to a body of another one, whose feet may then
    slide or leave the floor a little.
    """
    arrays = read_npz(path, (*POSES, *PLACES, *RATES, "root", "frames"), LARGEST)
    pose = next((arrays[name] for name in POSES if name in arrays), None)
    place = next((arrays[name] for name in PLACES if name in arrays), None)
    if pose is None:
        raise BadInput(f"{path}: expected an array of poses, {' or '.join(POSES)}; found none of them")
    angles = _as_smpl(path, pose)
    place = np.zeros((len(angles), 3)) if place is None else _numbers(path, place).reshape(-1, 3)
    if not 1 <= len(angles) <= MOST_FRAMES or len(place) != len(angles):
        raise BadInput(f"{path}: expected as many poses as places, got {len(angles)} and {len(place)}")
    if "frames" in arrays:
        order = np.argsort(_numbers(path, arrays["frames"]).reshape(-1), kind="stable")
        if len(order) != len(angles):
            raise BadInput(f"{path}: expected as many frame numbers as poses, got {len(order)} and {len(angles)}")
        angles, place = angles[order], place[order]
    if str(arrays.get("root", "smpl")) == "zju":
        angles, place = _from_zju(angles, place, body, betas)
    rate = next((arrays[name] for name in RATES if name in arrays), None)
    fps = UNKNOWN_RATE if rate is None else float(_numbers(path, rate).reshape(-1)[0])
    if not 0.1 <= fps <= 10_000:
        raise BadInput(f"{path}: expected 0.1 to 10000 frames a second, got {fps:.4g}")
    try:
        BodyPose(angles[np.abs(angles).max((1, 2)).argmax()], betas, place[0])  # refuses degrees
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from error
    return Motion(angles, place, fps)


def _numbers(path: Path, values: NDArray) -> Array:
    if values.dtype.kind not in "iuf" or not values.size or not np.isfinite(values).all():
        raise BadInput(f"{path}: expected finite numbers, got {values.dtype} {list(values.shape)} or NaN among them")
    return values.astype(np.float64)


def _as_smpl(path: Path, pose: NDArray) -> Array:
    """[T, 24, 3] of what has 72 numbers a frame, or the sizes of SMPL-H and SMPL-X."""
    pose = _numbers(path, pose)
    rows = pose.reshape(len(pose), -1)
    if pose.ndim > 1 and rows.shape[1] == 72:
        return rows.reshape(-1, 24, 3)
    if pose.ndim > 1 and rows.shape[1] in SMPLX_SIZES:
        out = np.zeros((len(rows), 24, 3))
        out[:, :22] = rows[:, :66].reshape(-1, 22, 3)
        return out
    sizes = ", ".join(map(str, (72, *SMPLX_SIZES)))
    raise BadInput(
        f"{path}: expected axis-angle poses of {sizes} numbers a frame, root first, got {list(pose.shape)}"
    )


def _from_zju(pose: Array, place: Array, body: Body, betas: Array) -> tuple[Array, Array]:
    from ihbench.body.root_convention import from_zju_root

    own = []
    for angles, th in zip(pose, place, strict=True):
        rest = angles.copy()
        rest[0] = 0
        own.append(from_zju_root(rest, betas, angles[0], th, body))
    return np.stack([p.pose for p in own]), np.stack([p.transl for p in own])


def _between(start: Array, end: Array, share: Array) -> Array:
    """[T, 24, 3] rad, `share` [T] of the shortest way from one rotation to the other; for 0 the start itself."""
    from scipy.spatial.transform import Rotation

    first = Rotation.from_rotvec(start.reshape(-1, 3))
    way = (first.inv() * Rotation.from_rotvec(end.reshape(-1, 3))).as_rotvec()
    moved = (first * Rotation.from_rotvec(way * share.repeat(24)[:, None])).as_rotvec().reshape(start.shape)
    return np.where(share[:, None, None] == 0, start, moved)


# --- where a body stands in its world -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stand:
    """Which way is up, and which way a body faces."""

    axes: Array  # [3, 3] columns: to the body's left, up, forwards
    pelvis: Array  # [3] m

    @property
    def up(self) -> Array:
        return self.axes[:, 1]


def up_axis(body_poses: list[BodyPose]) -> Array:
    """[3] which way is up in the world of these poses: the signed axis nearest to the bodies' mean own up, or, where
    none is near (a camera that looks down), that mean itself. Nothing else says it in every data set."""
    mean = np.mean([axis_angle_to_matrix(p.pose[0])[:, 1] for p in body_poses], 0)
    length = np.linalg.norm(mean)
    if length < 1e-6:
        return np.array([0.0, 1.0, 0.0])
    mean /= length
    axis = np.zeros(3)
    axis[np.abs(mean).argmax()] = np.sign(mean[np.abs(mean).argmax()])
    return axis if mean @ axis >= UPRIGHT_WITHIN else mean


def stand_of(body: Body, body_pose: BodyPose, up: Array) -> Stand:
    """Where one body stands in a world whose up is known."""
    root = axis_angle_to_matrix(body_pose.pose[0])
    forward = root[:, 2] - (root[:, 2] @ up) * up
    if np.linalg.norm(forward) < 1e-3:  # lies on its face or back: where its head points will do
        forward = root[:, 1] - (root[:, 1] @ up) * up
    forward = forward / np.linalg.norm(forward)
    pelvis = body.posed_joints(body_pose)[0]
    return Stand(np.stack([np.cross(up, forward), up, forward], 1), pelvis)


def placed(motion: Motion, body: Body, betas: Array, there: Stand) -> Motion:
    """The motion moved rigidly so that its first frame's pelvis and heading are those of `there`."""
    from scipy.spatial.transform import Rotation

    poses = motion.body_poses(betas)
    here = stand_of(body, poses[0], up_axis(poses))
    turn = there.axes @ here.axes.T
    rest = body.shaped(betas)[1][0]
    pose = motion.pose.copy()
    pose[:, 0] = (Rotation.from_matrix(turn) * Rotation.from_rotvec(pose[:, 0])).as_rotvec()
    transl = (motion.transl + rest - here.pelvis) @ turn.T + there.pelvis - rest
    return replace(motion, pose=pose, transl=transl)
