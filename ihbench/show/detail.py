"""How finely an avatar may be drawn: no finer than it was photographed.

Gaussians learn under the blur of the training images' pixels: each footprint is widened by `render.splats.LOW_PASS`
px². Drawn much finer, that blur is gone: the same points show gaps between them and the person becomes thinner (an
avatar of 256 px images by 2 cm on each side, measured). So what is drawn finer than the training images is drawn with
their pixels, and enlarged.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.record.finished_run import FinishedRun

SOME = 16  # training frames that are asked
FINER = 0.95  # share of a training pixel under which a pixel counts as finer


def training_pixel(run: FinishedRun, body: Body) -> float:
    """m at the body that a pixel of the training images covers: the median over the frames. Raises `BadInput` where
    the capture cannot be opened."""
    from ihbench.scene.views import straight_camera

    capture, protocol = run.capture, run.protocol
    camera = straight_camera(capture.camera(protocol.train.camera), protocol.image)
    frames = protocol.training_frames(capture.name, capture.n_frames)
    poses = [capture.body_pose(frame) for frame in frames[:: len(frames) // SOME + 1]]
    return float(np.median([pixel_at(camera, pose, body) for pose in poses]))


def pixel_at(camera: Camera, body_pose: BodyPose, body: Body) -> float:
    """m at the body's pelvis that a pixel of a camera covers."""
    depth = camera.to_camera(body.posed_joints(body_pose)[0])[2]
    return max(float(depth), 1e-6) / float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def drawn(
    avatar: Any,
    camera: Camera,
    body_pose: BodyPose,
    background: tuple[float, float, float],
    frame: int | None,
    body: Body,
    pixel: float | None,  # m, the finest that is drawn; None for any
    sharp: bool = True,  # enlarged by cubics, without their overshoots; False: linearly, for arithmetic with alpha
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """rgb [H, W, 3] and alpha [H, W] as `Avatar.render` gives them."""
    share = 1.0 if pixel is None else pixel_at(camera, body_pose, body) / pixel
    if share > FINER:
        rgb, alpha = avatar.render(camera, body_pose, background, frame)
        return rgb, alpha
    small = tuple(max(8, round(n * share)) for n in (camera.width, camera.height))
    both = (np.asarray(v, np.float32) for v in avatar.render(camera.scaled(*small), body_pose, background, frame))
    rgb, alpha = (_enlarged(image, camera.width, camera.height, sharp) for image in both)
    return rgb, alpha


def _enlarged(image: NDArray[np.float32], width: int, height: int, sharp: bool) -> NDArray[np.float32]:
    import cv2

    def resized(values: Any, how: int) -> NDArray[np.float32]:
        return np.asarray(cv2.resize(values, (width, height), interpolation=how), np.float32)

    if not sharp:
        return resized(image, cv2.INTER_LINEAR)
    square = np.ones((3, 3), np.uint8)
    low, high = (resized(change(image, square), cv2.INTER_LINEAR) for change in (cv2.erode, cv2.dilate))
    return np.clip(resized(image, cv2.INTER_CUBIC), low, high)
