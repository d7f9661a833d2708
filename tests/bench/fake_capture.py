"""The drawn capture of `ihbench.stress.drawn_capture` under the names that tests know, and what only they need."""

from __future__ import annotations

import numpy as np

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.scene.contracts import MaskState, TestView
from ihbench.stress.drawn_capture import (
    DISTANCE,
    FOCAL,
    SIZE,
    STUDIO,
    WHITE,
    DrawnCapture,
    a_camera,
    a_pose,
    photograph,
    rasterized,
    small_protocol,
    the_body,
    train_view,
    turning_capture,
    vertex_colors,
)

__all__ = [
    "DISTANCE", "DISTORTION", "FOCAL", "SIZE", "STUDIO", "WHITE", "FakeCapture", "a_camera", "a_pose",
    "fake_protocol", "photograph", "rasterized", "the_body", "train_view", "truth_view", "turning_capture",
    "vertex_colors",
]  # fmt: skip

DISTORTION = np.array([-0.24, 0.08, 2e-3, -1.5e-3, 0.01])  # moves the borders of the image by some 3 px
FakeCapture, fake_protocol = DrawnCapture, small_protocol


def truth_view(camera: Camera, body_pose: BodyPose, frame: int = 0) -> TestView:
    """The truth of a view, on white."""
    view = train_view(camera, body_pose)
    return TestView(
        view.image.astype(np.float32) / 255, view.mask == MaskState.PERSON, camera, body_pose, frame, "cam0"
    )
