"""The view table: random cameras around a body that stands upright, close-ups among them (gtu/guidance, 286-310,
716-909). Azimuth 0 looks the body in the face, 90 degrees is its left side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ihbench.body import JOINT_INDEX, Body
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.methods.gtu.config import GtuConfig
from ihbench.methods.gtu.deformation import CANONICAL

Kind = Literal["head", "upper", "lower", "entire", "canonical"]
KINDS: tuple[Kind, ...] = ("head", "upper", "lower", "entire", "canonical")
EARLY, LATE = (0.2, 0.1, 0.1, 0.4, 0.2), (0.3, 0.2, 0.2, 0.2, 0.1)  # shares of the kinds
CLOSE: tuple[Kind, ...] = ("head", "upper", "lower")
FOV_DEG = 49.1
RADIUS, CLOSE_RADIUS = 2.2, 2.86  # m
LOWEST, HIGHEST = -30, 29  # degrees of elevation
MARGIN = {"head": 1.6, "upper": 0.4, "lower": 0.4}  # of the joints' extent, around it
HEAD_PART = JOINT_INDEX["head"]
UPPER = ("neck", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
         "left_hip", "right_hip")  # fmt: skip
LOWER = ("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
LEAST_EXTENT = 0.05  # m, of a part whose joints coincide


@dataclass(frozen=True)
class RandomView:
    """A camera, and the body as it stands before it."""

    kind: Kind
    azimuth: int  # degrees, -180..179
    elevation: int  # degrees
    camera: Camera
    body_pose: BodyPose  # root upright


def shares(config: GtuConfig, k: int) -> NDArray[np.float64]:
    """[5] of the kinds in SDS step k."""
    out = np.array(EARLY if k < config.second_stage else LATE)
    if not config.close_ups:
        out[[KINDS.index(kind) for kind in CLOSE]] = 0
    return out / out.sum()


def drawn(rng: np.random.Generator, config: GtuConfig, k: int) -> tuple[Kind, int, int]:
    """A kind of view by the table of SDS step k, and an azimuth and elevation in degrees by chance; close-ups are
    level."""
    kind = KINDS[int(rng.choice(len(KINDS), p=shares(config, k)))]
    azimuth, elevation = int(rng.integers(-180, 180)), int(rng.integers(LOWEST, HIGHEST + 1))
    return kind, azimuth, 0 if kind in CLOSE else elevation


def view_from(
    kind: Kind,
    azimuth: int,  # degrees
    elevation: int,  # degrees
    body: Body,
    pose: NDArray[np.float64],  # [24, 3] rad
    betas: NDArray[np.float64],
    size: int,  # px
) -> RandomView:
    """One view. The body stands with the middle of its T-pose's height at the origin, SMPL's within a centimetre of
    where the released .3 m put it."""
    height = body.v_template[:, 1]
    body_pose = BodyPose(posed_for(kind, pose), betas, np.array([0.0, -(height.min() + height.max()) / 2, 0.0]))
    camera = camera_at(azimuth, elevation, CLOSE_RADIUS if kind in CLOSE else RADIUS, size)
    if kind in CLOSE:
        camera = _cropped(camera, _part_points(kind, body, body_pose), MARGIN[kind], size)
    return RandomView(kind, azimuth, elevation, camera, body_pose)


def posed_for(kind: Kind, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """[24, 3] rad: a frame's pose as the kind of view takes it, the root upright."""
    out = pose.copy()
    if kind == "canonical":
        out = canonical_pose(CANONICAL)
        out[JOINT_INDEX["left_collar"], 2] = -np.pi / 6
        out[JOINT_INDEX["right_collar"], 2] = np.pi / 6
    elif kind == "head":
        out[:] = 0  # as released, which means to keep neck and head and reads them from the tensor it has zeroed
    elif kind == "upper":
        out[:4] = 0
    elif kind == "lower":
        out[:2] = 0
    out[0] = 0
    return out


def camera_at(azimuth: float, elevation: float, radius: float, size: int) -> Camera:
    """Looks at the origin; degrees, m, px."""
    turn, lift = np.deg2rad([azimuth, elevation])
    where = radius * np.array([np.sin(turn) * np.cos(lift), np.sin(lift), np.cos(turn) * np.cos(lift)])
    focal = size / (2 * np.tan(np.deg2rad(FOV_DEG) / 2))
    return Camera(np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]), *look_at(where, np.zeros(3)),
                  size, size)  # fmt: skip


def _cropped(camera: Camera, points: NDArray[np.float64], margin: float, size: int) -> Camera:
    """The camera with the focal length and principal point that put a square around points [P, 3] into the
    picture."""
    p = camera.project(points)
    low, high = p[:, :2].min(0), p[:, :2].max(0)
    least = LEAST_EXTENT * camera.K[0, 0] / p[:, 2].mean()
    side = (1 + margin) * max((high - low).max(), least)
    zoom = size / side
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= zoom
    K[:2, 2] = (K[:2, 2] - (low + high) / 2) * zoom + size / 2
    return Camera(K, camera.R, camera.t, size, size)


def _part_points(kind: Kind, body: Body, body_pose: BodyPose) -> NDArray[np.float64]:
    """[P, 3] m, world. Eyes, ears and nose of a skeleton that has them are taken from the head's surface."""
    joints = body.posed_joints(body_pose)
    if kind != "head":
        return joints[[JOINT_INDEX[name] for name in (UPPER if kind == "upper" else LOWER)]]
    head = np.flatnonzero(body.parts == HEAD_PART)
    at_rest = body.v_template[head]
    face = head[[at_rest[:, 2].argmax(), at_rest[:, 0].argmax(), at_rest[:, 0].argmin()]]
    return np.concatenate([joints[[JOINT_INDEX["neck"]]], body.pose(body_pose)[face]])
