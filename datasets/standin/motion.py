"""Exercises on the spot with turns, as the ZJU-MoCap subjects perform them, with the feet on the floor.

Angles are written in degrees of SMPL axis-angle at the T-pose that looks along +z with the left hand at +x: a
negative hip x lifts the thigh forwards, a positive knee x bends it, a negative left shoulder z lowers the arm, a
negative left shoulder or elbow y brings the arm forwards. On the right side y and z change sign.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import JOINT_INDEX
from ihbench.body.skinning_numpy import joint_transforms, lbs

Array = NDArray[np.float64]

N_FRAMES = 570  # of the exercises that a ZJU-MoCap stand-in shows
NOVEL_FRAMES = 240  # and of the movements after them, which the protocol `novel_pose` tests on
FRAMES_PER_SECOND = 30
CROSSFADE = 36  # frames from one exercise to the next
SMPL_UP_TO_WORLD_UP = Rotation.from_euler("x", 90, degrees=True)  # y up, facing +z -> z up, facing -y


@dataclass(frozen=True)
class Performance:
    """A whole sequence: what the joints do, where the person looks and where they stand."""

    pose: Array  # [T, 24, 3] rad; the root holds only the sway of the pelvis
    yaw: Array  # [T] rad about the world's z axis; 0 looks along -y
    place: Array  # [T, 2] m, where on the floor the person means to stand
    exercises: tuple[str, ...]


def perform(
    rng: np.random.Generator, exercises: tuple[str, ...], full_turn: bool, n_frames: int = N_FRAMES
) -> Performance:
    """A sequence of frames: the exercises one after the other while the person turns.

    `full_turn` people make one to two turns; the others look around through 60–200°.
    """
    yaw = _turning(rng, full_turn, n_frames)
    pose = _blend([EXERCISES[name](_phase(rng, n_frames)) for name in exercises])
    pose = pose + _stepping(yaw) + _restlessness(rng, n_frames)
    pose = gaussian_filter1d(pose, 1.5, axis=0, mode="nearest")
    return Performance(pose, yaw, _drift(rng, n_frames), exercises)


def turntable(rng: np.random.Generator, n_frames: int, turns: float) -> Performance:
    """An A-pose that turns on the spot before a camera at -y, as PeopleSnapshot's subjects do; it starts facing it.

    Arms and weight move a little, as nobody stands quite still.
    """
    t = np.linspace(0, 1, n_frames)
    sway = np.sin(2 * np.pi * (3 * t + rng.uniform()))
    yaw = 2 * np.pi * turns * t + np.deg2rad(4) * sway * np.minimum(1, 20 * t)
    phase = 2 * np.pi * 2 * t
    pose = standing(phase)
    lift = 12 + 5 * np.sin(phase + rng.uniform(0, 2 * np.pi))
    _turn_both(pose, "shoulder", z=lift)
    pose = pose + _stepping(yaw) + 0.5 * _restlessness(rng, n_frames)
    return Performance(
        gaussian_filter1d(pose, 1.5, axis=0, mode="nearest"), yaw, np.zeros((n_frames, 2)), ("a_pose",)
    )


def stroll(rng: np.random.Generator, n_frames: int, reach: float) -> Performance:
    """Walking to and fro along x over `reach` m to either side, stopping in the middle to reach out, as in a room
    with furniture. The person looks where they go, and to -y while reaching."""
    t = np.linspace(0, 1, n_frames)
    side = rng.choice([-1, 1])
    # out, reach, on, and back a little
    knots, places = [0, 0.38, 0.62, 0.9, 1], reach * np.array([-1, 0, 0, 1, 0.8])
    place = np.zeros((n_frames, 2))
    place[:, 0] = side * gaussian_filter1d(np.interp(t, knots, places), 3, mode="nearest")
    place[:, 1] = 0.1 * np.sin(2 * np.pi * t + rng.uniform(0, 2 * np.pi))
    going = np.gradient(place[:, 0])
    walking = gaussian_filter1d((np.abs(going) > 0.006).astype(float), 3, mode="nearest")
    heading = np.interp(t, [0, 0.34, 0.4, 0.6, 0.66, 0.9, 0.97, 1], np.pi / 2 * np.array([1, 1, 0, 0, 1, 1, 0, -0.6]))
    stride = np.cumsum(np.abs(going)) * 2 * np.pi / 1.25  # a double step of 1.25 m
    pose = standing(stride)
    for s, lead in ((1, "left"), (-1, "right")):
        swing = s * np.sin(stride) * walking
        _turn(pose, f"{lead}_hip", x=-26 * swing)
        _turn(pose, f"{lead}_knee", x=walking * 28 * np.maximum(0, s * np.cos(stride)) ** 1.5)
        _turn(pose, f"{lead}_ankle", x=6 * swing)
        _turn(pose, f"{lead}_shoulder", y=s * 24 * swing)
    out = np.exp(-(((t - 0.5) / 0.07) ** 2))
    hand = "left" if rng.random() < 0.5 else "right"
    sign = 1 if hand == "left" else -1
    _turn(pose, f"{hand}_shoulder", y=-sign * 62 * out, z=sign * 40 * out)
    _turn(pose, f"{hand}_elbow", y=sign * 10 * out)
    _turn(pose, "spine1", x=14 * out)
    _turn(pose, "spine2", x=10 * out)
    pose = pose + 0.6 * _restlessness(rng, n_frames)
    yaw = side * gaussian_filter1d(heading, 2, mode="nearest")
    return Performance(gaussian_filter1d(pose, 1.2, axis=0, mode="nearest"), yaw, place, ("walk", "reach"))


def body_poses(performance: Performance, betas: Array, body: Body) -> list[BodyPose]:
    """The performance of one body in the world: z up, the floor at z = 0, the lowest point of the body on it.

    The planted foot holds its place on the floor while the weight is on it: the root follows from the feet, as in
    walking, and is then drawn slowly back to `performance.place`.
    """
    heading = Rotation.from_euler("z", performance.yaw[:, None])
    root = heading * SMPL_UP_TO_WORLD_UP * Rotation.from_rotvec(performance.pose[:, 0])
    pose = performance.pose.copy()
    pose[:, 0] = root.as_rotvec()
    feet = _foot_points(pose, betas, body)  # [T, 2, n, 3]
    transl = np.zeros((len(pose), 3))
    transl[:, :2] = performance.place + _planted(feet)
    transl[:, 2] = -feet[..., 2].min((1, 2))
    return [BodyPose(pose[i], betas, transl[i]) for i in range(len(pose))]


def _foot_points(pose: Array, betas: Array, body: Body) -> Array:
    """[T, 2, n, 3] m: the soles (left, right) for every pose with the root at its rest place."""
    vertices, joints = body.shaped(betas)
    soles = []
    for side in ("left", "right"):
        own = body.weights[:, [JOINT_INDEX[f"{side}_ankle"], JOINT_INDEX[f"{side}_foot"]]].sum(1) > 0.9
        own &= vertices[:, 1] < vertices[own, 1].min() + 0.03
        soles.append(np.flatnonzero(own))
    n = min(len(sole) for sole in soles)
    lowest = np.concatenate([sole[np.linspace(0, len(sole) - 1, n).astype(int)] for sole in soles])
    points, weights = vertices[lowest], body.weights[lowest]
    posed = [lbs(points, weights, joint_transforms(frame, joints, body.parents)) for frame in pose]
    return np.stack(posed).reshape(len(pose), 2, n, 3)


def _planted(feet: Array) -> Array:
    """[T, 2] m of root movement that cancels the slip of the foot with the weight on it."""
    centre = feet.mean(2)  # [T, 2, 3]
    weight = np.exp(-(centre[..., 2] - centre[..., 2].min(1, keepdims=True)) / 0.015)
    weight = gaussian_filter1d(weight / weight.sum(1, keepdims=True), 2, axis=0, mode="nearest")
    slip = (np.diff(centre[..., :2], axis=0) * weight[1:, :, None]).sum(1)
    path = np.concatenate([np.zeros((1, 2)), -np.cumsum(slip, 0)])
    return path - gaussian_filter1d(path, 75, axis=0, mode="nearest")


def _phase(rng: np.random.Generator, n_frames: int) -> Array:
    """[T] rad: repetitions of 1.7–2.4 s, never quite the same length."""
    frames = FRAMES_PER_SECOND * rng.uniform(1.7, 2.4)
    uneven = gaussian_filter1d(rng.normal(size=n_frames), 40, mode="wrap")
    rate = (1 + 0.12 * uneven / uneven.std()) * 2 * np.pi / frames
    return np.cumsum(rate)


def _blend(clips: list[Array]) -> Array:
    """[T, 24, 3]: equal shares of the sequence for each clip, with smooth crossfades."""
    n_frames = len(clips[0])
    t = np.arange(n_frames)
    out = clips[0].copy()
    for k, clip in enumerate(clips[1:], 1):
        x = np.clip((t - n_frames * k / len(clips)) / CROSSFADE + 0.5, 0, 1)
        share = x * x * (3 - 2 * x)
        out += share[:, None, None] * (clip - out)
    return out


def _turning(rng: np.random.Generator, full_turn: bool, n_frames: int) -> Array:
    """[T] rad of heading."""
    t = np.linspace(0, 1, n_frames)
    start = rng.uniform(0, 2 * np.pi)
    if full_turn:
        turns = rng.uniform(1.1, 2.0) * rng.choice([-1, 1])
        # stops and starts without ever going back
        stops, offset = rng.integers(3, 6), rng.uniform(0, 2 * np.pi)
        pace = np.sin(2 * np.pi * stops * t + offset) - np.sin(offset)
        return start + 2 * np.pi * turns * (t + 0.8 * pace / (2 * np.pi * stops))
    reach = np.deg2rad(rng.uniform(80, 190))
    swing = np.sin(2 * np.pi * rng.uniform(1.1, 1.9) * t + rng.uniform(0, 2 * np.pi))
    swing += 0.25 * np.sin(2 * np.pi * rng.uniform(2.5, 3.5) * t + rng.uniform(0, 2 * np.pi))
    return start + reach * (swing - swing.min()) / np.ptp(swing)


def _drift(rng: np.random.Generator, n_frames: int) -> Array:
    """[T, 2] m: nobody stays on the mark; 8–18 cm off it at the most."""
    t = np.linspace(0, 2 * np.pi, n_frames)
    reach = rng.uniform(0.08, 0.18)
    rate, offset = rng.uniform(0.6, 1.4, 2), rng.uniform(0, 2 * np.pi, 2)
    return reach * np.stack([np.sin(rate[0] * t + offset[0]), np.sin(rate[1] * t + offset[1])], 1) / np.sqrt(2)


def _stepping(yaw: Array) -> Array:
    """[T, 24, 3]: small steps, right and left in turn, as long as the person turns on the spot."""
    pace = np.abs(np.gradient(yaw)) * FRAMES_PER_SECOND
    effort = gaussian_filter1d(np.clip(pace / np.deg2rad(35), 0, 1), 8, mode="nearest")
    stride = 2 * np.pi * np.cumsum(np.full(len(yaw), 1 / (0.9 * FRAMES_PER_SECOND)))
    pose = _still(len(yaw))
    for side, lift in (("left", np.sin(stride)), ("right", -np.sin(stride))):
        lift = effort * np.maximum(lift, 0) ** 1.5
        _turn(pose, f"{side}_hip", x=-16 * lift)
        _turn(pose, f"{side}_knee", x=30 * lift)
        _turn(pose, f"{side}_ankle", x=-10 * lift)
    return pose


def _restlessness(rng: np.random.Generator, n_frames: int) -> Array:
    """[T, 24, 3]: slow sway of trunk, head and collars."""
    t = np.linspace(0, 2 * np.pi, n_frames)
    pose = _still(n_frames)
    for joint, amount in (("pelvis", 1.5), ("spine1", 2.0), ("spine2", 2.0), ("neck", 3.0), ("head", 5.0)):
        rate, offset = rng.integers(2, 6, 3), rng.uniform(0, 2 * np.pi, 3)
        x, y, z = amount * rng.uniform(0.4, 1, 3)[:, None] * np.sin(rate[:, None] * t + offset[:, None])
        _turn(pose, joint, x, y, z)
    return pose


def _still(n: int) -> Array:
    return np.zeros((n, 24, 3))


def _turn(pose: Array, joint: str, x: Array | float = 0, y: Array | float = 0, z: Array | float = 0) -> None:
    for axis, degrees in enumerate((x, y, z)):
        pose[:, JOINT_INDEX[joint], axis] += np.deg2rad(degrees)


def _turn_both(pose: Array, joint: str, x: Array | float = 0, y: Array | float = 0, z: Array | float = 0) -> None:
    """The same movement left and right, given for the left side."""
    _turn(pose, f"left_{joint}", x, y, z)
    _turn(pose, f"right_{joint}", x, -np.asarray(y), -np.asarray(z))


def standing(phase: Array) -> Array:
    """Arms hanging a little away from the body, knees soft."""
    pose = _still(len(phase))
    _turn_both(pose, "shoulder", z=-62)
    _turn_both(pose, "elbow", y=-14)
    _turn_both(pose, "hip", x=-3, z=5)
    _turn_both(pose, "knee", x=6)
    _turn_both(pose, "ankle", x=-3, z=-3)
    return pose


def _arm_swing(phase: Array) -> Array:
    s, up = np.sin(phase), 0.5 - 0.5 * np.cos(phase)
    pose = standing(phase)
    _turn_both(pose, "shoulder", z=42 * up)
    for side, sign in (("left", 1), ("right", -1)):
        _turn(pose, f"{side}_shoulder", y=-38 * s * sign)
        _turn(pose, f"{side}_elbow", y=-18 * sign * (1 + s))
    _turn(pose, "spine2", y=14 * np.sin(phase / 2))
    _turn_both(pose, "hip", x=-8 * up)
    _turn_both(pose, "knee", x=15 * up)
    _turn_both(pose, "ankle", x=-7 * up)
    return pose


def _kick(phase: Array) -> Array:
    pose = standing(phase)
    for side, other, lift in (("right", "left", np.sin(phase / 2)), ("left", "right", -np.sin(phase / 2))):
        lift = np.maximum(lift, 0) ** 1.6
        sign = 1 if other == "left" else -1
        _turn(pose, f"{side}_hip", x=-78 * lift)
        _turn(pose, f"{side}_knee", x=70 * lift * (1 - lift))
        _turn(pose, f"{other}_hip", x=-4 * lift, z=-2 * lift * sign)
        _turn(pose, f"{other}_knee", x=6 * lift)
        _turn(pose, "spine1", x=9 * lift)
        _turn(pose, f"{other}_shoulder", y=-48 * lift * sign, z=14 * lift * sign)
        _turn(pose, f"{other}_elbow", y=-30 * lift * sign)
    return pose


def _twist(phase: Array) -> Array:
    s = np.sin(phase)
    pose = standing(phase)
    _turn(pose, "spine1", y=18 * s)
    _turn(pose, "spine2", y=16 * s)
    _turn(pose, "spine3", y=10 * s, z=4 * np.cos(phase))
    _turn(pose, "neck", y=-10 * s)
    _turn_both(pose, "shoulder", y=-26, z=30)
    _turn_both(pose, "elbow", y=-66)
    _turn_both(pose, "knee", x=6)
    _turn_both(pose, "hip", x=-4, z=4)
    return pose


def _wave(phase: Array) -> Array:
    pose = standing(phase)
    sway = np.sin(phase / 2)
    _turn(pose, "right_shoulder", y=8, z=-64 + 6 * np.sin(phase))
    _turn(pose, "right_elbow", y=10 + 8 * np.sin(2 * phase), z=-48 + 28 * np.sin(2 * phase))
    _turn(pose, "left_shoulder", z=-4 + 4 * sway)
    _turn(pose, "spine2", z=-5 * sway)
    _turn(pose, "left_knee", x=8 * np.maximum(sway, 0))
    _turn(pose, "left_hip", x=-4 * np.maximum(sway, 0))
    _turn(pose, "right_knee", x=8 * np.maximum(-sway, 0))
    _turn(pose, "right_hip", x=-4 * np.maximum(-sway, 0))
    return pose


def _punch(phase: Array) -> Array:
    """Straight punches, left and right in turn, one foot ahead."""
    pose = standing(phase)
    _turn(pose, "left_hip", x=-14)
    _turn(pose, "left_knee", x=10)
    _turn(pose, "right_hip", x=10)
    _turn(pose, "right_knee", x=10)
    _turn(pose, "right_ankle", x=4)
    for side, sign, reach in (("left", 1, np.sin(phase)), ("right", -1, -np.sin(phase))):
        reach = np.maximum(reach, 0) ** 1.4
        _turn(pose, f"{side}_shoulder", y=-sign * (34 + 44 * reach), z=sign * (22 + 32 * reach))
        _turn(pose, f"{side}_elbow", y=-sign * 76 * (1 - reach))
        _turn(pose, "spine2", y=-sign * 14 * reach)
        _turn(pose, "spine3", y=-sign * 8 * reach)
    return pose


def _march(phase: Array) -> Array:
    """Knees high in turn, the opposite arm bent forwards."""
    pose = standing(phase)
    for side, other, lift in (("left", "right", np.sin(phase)), ("right", "left", -np.sin(phase))):
        lift = np.maximum(lift, 0) ** 1.3
        sign = 1 if other == "left" else -1
        _turn(pose, f"{side}_hip", x=-84 * lift)
        _turn(pose, f"{side}_knee", x=96 * lift)
        _turn(pose, f"{other}_shoulder", y=-sign * 58 * lift, z=sign * 8 * lift)
        _turn(pose, f"{other}_elbow", y=-sign * 74 * lift)
    return pose


# power of the movement down and up again, and degrees (x, y, z) at its end; "hip" is both hips, given for the left
BENT: dict[str, tuple[float, dict[str, tuple[float, float, float]]]] = {
    "squat": (1.3, {
        "hip": (-88, 0, 12), "knee": (98, 0, 0), "ankle": (-28, 0, 0), "pelvis": (14, 0, 0), "spine1": (12, 0, 0),
        "spine2": (6, 0, 0), "neck": (-20, 0, 0), "shoulder": (0, -72, 50),
    }),
    # both arms up at the sides, on the toes at the top
    "overhead": (1.2, {
        "shoulder": (0, 0, 112), "collar": (0, 0, 16), "elbow": (0, 8, 0), "ankle": (14, 0, 0), "foot": (-12, 0, 0),
    }),
    # one foot far ahead, the hips low, both arms out at the sides
    "lunge": (1.2, {
        "left_hip": (-62, 0, 0), "left_knee": (66, 0, 0), "right_hip": (34, 0, 0), "right_knee": (34, 0, 0),
        "right_ankle": (16, 0, 0), "shoulder": (0, 0, 58),
    }),
    # forwards from the hips, the arms crossed before the chest
    "bow": (1.4, {
        "hip": (-40, 0, 0), "pelvis": (38, 0, 0), "spine1": (16, 0, 0), "spine2": (12, 0, 0), "neck": (-14, 0, 0),
        "shoulder": (0, -52, 6), "elbow": (0, -78, 0),
    }),
}  # fmt: skip


def _bend(name: str, phase: Array) -> Array:
    power, angles = BENT[name]
    amount = (0.5 - 0.5 * np.cos(phase)) ** power
    pose = standing(phase)
    for joint, (x, y, z) in angles.items():
        turn = _turn if joint in JOINT_INDEX else _turn_both
        turn(pose, joint, x * amount, y * amount, z * amount)
    return pose


EXERCISES: dict[str, Callable[[Array], Array]] = {
    "arm_swing": _arm_swing,
    "kick": _kick,
    "twist": _twist,
    "wave": _wave,
    "punch": _punch,
    "march": _march,
    **{name: partial(_bend, name) for name in BENT},
}
NOVEL = ("march", "lunge", "bow")  # nobody does these among the exercises
