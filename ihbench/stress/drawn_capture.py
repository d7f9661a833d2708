"""A capture that lives in memory: the bench's own body, drawn by the z-buffer in one colour per vertex.

For cases and tests that need a person at any size within milliseconds, with truth for every pixel.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import JOINT_INDEX, Body, load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera, look_at
from ihbench.config_fields import replaced
from ihbench.render.zbuffer import Raster, rasterize
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.protocol import Protocol, Span, load_protocol

SIZE = 96  # px
DISTANCE = 3.0  # m
FOCAL = 1.35 * SIZE  # px: the body fills most of the height
STUDIO = np.array([40, 90, 60], np.uint8)  # the background of the photograph, no protocol's
WHITE = (1.0, 1.0, 1.0)


@cache
def the_body() -> Body:
    return load_body()


@cache
def vertex_colors() -> NDArray[np.float64]:
    """[V, 3] in [0.1, 0.9]: smooth over the body, different on all its sides."""
    v = the_body().v_template
    return 0.5 + 0.4 * np.sin(np.stack([5 * v[:, 1] + 1, 6 * v[:, 0] + 4 * v[:, 1], 3 * v[:, 1] + 9 * v[:, 2]], 1))


def a_pose(yaw: float = 0.0, arms: float = 0.0, transl: Sequence[float] = (0.0, 0.0, 0.0)) -> BodyPose:
    """Arms half lowered, turned by `yaw` rad about the vertical; `arms` rad bends elbows and knees."""
    pose = np.zeros((24, 3))
    pose[0, 1] = yaw
    pose[JOINT_INDEX["left_shoulder"], 2] = -0.7 - 0.3 * arms
    pose[JOINT_INDEX["right_shoulder"], 2] = 0.7 - 0.3 * arms
    pose[JOINT_INDEX["left_elbow"], 1] = -arms
    pose[JOINT_INDEX["right_knee"], 0] = arms
    return BodyPose(pose, np.zeros(10), np.asarray(transl, np.float64))


def a_camera(
    azimuth: float = 0.0,  # rad; 0 looks the unturned body in the face
    size: int = SIZE,
    distance: float = DISTANCE,
    distortion: NDArray[np.float64] | None = None,
) -> Camera:
    R, t = look_at(distance * np.array([np.sin(azimuth), 0.05, np.cos(azimuth)]), np.array([0.0, -0.08, 0.0]))
    focal = FOCAL * size / SIZE
    K = np.array([[focal, 0, 0.51 * size], [0, 1.01 * focal, 0.49 * size], [0, 0, 1]])
    return Camera(K, R, t, size, size, distortion)


def rasterized(camera: Camera, body_pose: BodyPose) -> Raster:
    body = the_body()
    return rasterize(camera.project(body.pose(body_pose)), body.faces, camera.height, camera.width)


def photograph(camera: Camera, body_pose: BodyPose) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """image [H, W, 3] before the studio's background, silhouette [H, W]; with the camera's distortion."""
    raster = rasterized(camera, body_pose)
    image = np.empty((camera.height, camera.width, 3), np.uint8)
    image[:] = STUDIO
    image[raster.mask] = np.round(255 * raster.interpolate(vertex_colors(), the_body().faces)[raster.mask])
    return image, raster.mask


Edit = Callable[[int, int, NDArray], NDArray]  # camera, frame, pixels -> pixels


def untouched(_camera: int, _frame: int, pixels: NDArray) -> NDArray:
    return pixels


@dataclass(eq=False)
class DrawnCapture:
    """`scene.contracts.Capture` of some poses seen by some cameras; `edit_*` change pixels as they are read."""

    poses: Sequence[BodyPose]
    cameras: Sequence[Camera]
    name: str = "drawn"
    dataset: str = "drawn"
    variant: str = "memory"
    standin: str = "drawn"
    body: str = "procedural"
    visible_masks: bool = False
    edit_image: Edit = untouched
    edit_silhouette: Edit = untouched
    n_frames: int = field(init=False)
    camera_ids: tuple[str, ...] = field(init=False)
    _photographs: dict[tuple[int, int], tuple[NDArray, NDArray]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.n_frames = len(self.poses)
        self.camera_ids = tuple(f"cam{k}" for k in range(len(self.cameras)))

    @property
    def model(self) -> Body:
        return the_body()

    def camera(self, camera: int) -> Camera:
        return self.cameras[camera]

    def body_pose(self, frame: int) -> BodyPose:
        return self.poses[frame]

    def image(self, camera: int, frame: int) -> NDArray[np.uint8]:
        return self.edit_image(camera, frame, self._photograph(camera, frame)[0].copy())

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        return self.edit_silhouette(camera, frame, self._photograph(camera, frame)[1].copy())

    def content_digest(self, camera: int, frame: int, source: str = "mask") -> bytes:
        digest = hashlib.sha256(self.image(camera, frame).tobytes())
        digest.update(self.silhouette(camera, frame, source).tobytes())
        return digest.digest()

    def lacks(self, camera: int, frame: int, source: str = "mask") -> bool:
        return not (0 <= camera < len(self.cameras) and 0 <= frame < self.n_frames)

    def _photograph(self, camera: int, frame: int) -> tuple[NDArray, NDArray]:
        if (camera, frame) not in self._photographs:
            self._photographs[camera, frame] = photograph(self.cameras[camera], self.poses[frame])
        return self._photographs[camera, frame]


def turning_capture(
    n_frames: int = 10, turn: float = 1.8 * np.pi, distortion: NDArray[np.float64] | None = None
) -> DrawnCapture:
    """A person who turns and bends arms and legs, seen from four sides; camera 0 trains."""
    share = np.arange(n_frames) / max(n_frames - 1, 1)
    poses = [a_pose(turn * s, 0.6 * np.sin(4 * s), (0.06 * np.sin(5 * s), 0, 0)) for s in share]
    return DrawnCapture(poses, [a_camera(a, distortion=distortion) for a in (0.0, 1.5, 3.0, 4.5)])


def small_protocol(
    base: str = "zju_occ",
    n_frames: int = 10,
    size: int = SIZE // 2,
    rule: str = "strip-generic",
    strip: tuple[int, int] | None = None,  # mid, width in px of the original image
    width: int = SIZE,
    subject: str = "drawn",
) -> Protocol:
    """A registered protocol cut down to a drawn capture: every frame trains, every third tests, on all cameras."""
    protocol = load_protocol(base, "paper")
    return replaced(
        protocol,
        {
            "train.frames": Span(0, n_frames, 1),
            "test.frames": Span(0, n_frames, 3),
            "test.cameras.stop": 4,
            "occlusion.rule": "fixed-strip" if strip else rule,
            "occlusion.unlisted": rule,
            "occlusion.strips": {subject: strip} if strip else {},
            "occlusion.reference_width": width,
            "image.size": size,
        },
    )


def train_view(camera: Camera, body_pose: BodyPose, hidden: slice | None = None, frame: int = 0) -> TrainView:
    """A clean training view on white, without resampling; the columns `hidden` are UNKNOWN."""
    image, person = photograph(camera, body_pose)
    image[~person] = 255
    mask = np.where(person, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    if hidden is not None:
        mask[:, hidden], image[:, hidden] = MaskState.UNKNOWN, 255
    return TrainView(image, mask, camera, body_pose, frame, "cam0")
