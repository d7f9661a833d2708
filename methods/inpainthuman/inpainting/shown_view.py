"""What the painter is shown of a view, and what it is asked to paint."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.methods.inpainthuman.inpainting.surface_need import SeenSurface, pixels_of
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView

Background = tuple[float, float, float]


class Renderer(Protocol):
    def render(
        self, camera: Camera, body_pose: BodyPose, background: Background
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...


def with_known_surface(view: TrainView, training: TrainingSet, avatar: Renderer, surface: SeenSurface) -> TrainView:
    """The view with the avatar drawn into those hidden pixels that need no painter. Only surface that no frame shows,
    though one faces it well, stays UNKNOWN."""
    body = training.body
    hidden = view.mask == MaskState.UNKNOWN
    needed = surface.map_of(surface.needed)
    unseen = hidden & pixels_of(needed, body.pose(view.body_pose), body, view.camera)
    known = hidden & ~unseen
    rgb, alpha = avatar.render(view.camera, view.body_pose, training.background)
    image, mask = view.image.copy(), view.mask.copy()
    image[known] = np.rint(rgb[known] * 255).astype(np.uint8)
    mask[known] = np.where(alpha[known] >= 0.5, MaskState.PERSON, MaskState.BACKGROUND)
    return replace(view, image=image, mask=mask)


def turntable_view(
    angle: float,  # rad about the body's own upright axis
    like: TrainView,
    training: TrainingSet,
    avatar: Renderer,
    surface: SeenSurface,
) -> TrainView:
    """The avatar in the pose and from the distance of a training view, seen from another side. Surface that no
    training view shows is UNKNOWN."""
    body = training.body
    camera = orbit(like.camera, like.body_pose, body, angle)
    vertices = body.pose(like.body_pose)
    rgb, alpha = avatar.render(camera, like.body_pose, training.background)
    mask = np.where(alpha >= 0.5, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    mask[pixels_of(surface.map_of(surface.unseen), vertices, body, camera)] = MaskState.UNKNOWN
    image = np.rint(rgb * 255).astype(np.uint8)
    return TrainView(image, mask, camera, like.body_pose, -1, f"turntable-{round(np.degrees(angle))}")


def orbit(camera: Camera, body_pose: BodyPose, body: Body, angle: float) -> Camera:
    """The camera turned about the body's upright axis through its pelvis."""
    joints = body.joint_transforms(body_pose)
    upright = joints[0, :3, :3] @ np.array([0.0, 1.0, 0.0])
    pelvis = body.shaped(body_pose.betas)[1][0] + body_pose.transl
    turn = Rotation.from_rotvec(angle * upright / np.linalg.norm(upright)).as_matrix()
    # x_camera = R (turn (x - p) + p) + t
    R = camera.R @ turn
    t = camera.t + camera.R @ (pelvis - turn @ pelvis)
    return Camera(camera.K, R, t, camera.width, camera.height)
