"""Calibration rows: trivial predictions that bound every method from above and below.

Computed by the bench itself for every table, with the same metrics, regions and views as the methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState, TestView, TrainingSet, TrainView
from ihbench.scene.sightings import FINE

if TYPE_CHECKING:
    from ihbench.body import Body

ROWS = ("truth", "truth-8bit", "nearest-frame", "mean-colour-body", "pasted-texture")
DESCRIPTIONS = {
    "truth": "the truth as prediction",
    "truth-8bit": "the truth through 8 bits",
    "nearest-frame": "the training image whose view of the body is nearest, moved to the body's box",
    "mean-colour-body": "the body mesh in the mean visible colour",
    "pasted-texture": "the body mesh with the mean of what was visible of each texel, mean colour elsewhere",
}
SUPERSAMPLE = 2  # mesh rows are drawn at twice the size: their silhouettes would alias otherwise


@dataclass(frozen=True)
class Calibration:
    """The rows' ingredients, made once per scene from the training views alone."""

    body: Body
    views: Sequence[TrainView]
    background: NDArray[np.float32]  # [3]
    mean_color: NDArray[np.float32]  # [3]
    texture: NDArray[np.float32]  # [R, R, 3]

    @classmethod
    def build(cls, training: TrainingSet) -> Calibration:
        """Average the visible colour of every texel over the training views."""
        from ihbench.body.uv import chart_padding

        person_sum, person_count = np.zeros(3), 0
        for view in training.views:
            person = view.mask == MaskState.PERSON
            person_sum += view.image[person].sum(0, dtype=np.float64)
            person_count += int(person.sum())
        mean = person_sum / max(person_count, 1) / 255
        surface = training.sightings[FINE]
        count, texels = surface.visibility.seen[:, None], surface.texels
        flat = np.zeros((texels.resolution**2, 3), np.float32)
        flat[texels.index] = np.where(count > 0, surface.colour / np.maximum(count, 1) / 255, mean)
        texture = flat[chart_padding(texels.mask, texels.resolution)]
        background = np.asarray(training.background, np.float32)
        return cls(training.body, training.views, background, mean.astype(np.float32), texture)

    def predict(self, row: str, view: TestView) -> NDArray[np.float32]:
        """[H, W, 3] the row's image of a test view."""
        if row == "truth":
            return view.image
        if row == "truth-8bit":
            return (np.round(view.image * 255).astype(np.uint8) / 255).astype(np.float32)
        if row == "nearest-frame":
            return self._nearest_frame(view.camera, view.body_pose)
        if row in ("mean-colour-body", "pasted-texture"):
            return self._mesh(view.camera, view.body_pose, textured=row == "pasted-texture")
        raise ValueError(f"calibration row {row!r}: expected one of {', '.join(ROWS)}")

    def _mesh(self, camera: Camera, body_pose: BodyPose, textured: bool) -> NDArray[np.float32]:
        from ihbench.body.uv import sample_uv

        big = camera.scaled(camera.width * SUPERSAMPLE, camera.height * SUPERSAMPLE)
        raster = rasterize(big.project(self.body.pose(body_pose)), self.body.faces, big.height, big.width)
        image = np.empty((big.height, big.width, 3), np.float32)
        image[:] = self.background
        hit = raster.mask
        if textured:
            uv = raster.interpolate(self.body.uv, self.body.uv_faces)[hit]
            image[hit] = sample_uv(self.texture, uv.astype(np.float64))
        else:
            image[hit] = self.mean_color
        shape = (camera.height, SUPERSAMPLE, camera.width, SUPERSAMPLE, 3)
        return image.reshape(shape).mean((1, 3))

    def _nearest_frame(self, camera: Camera, body_pose: BodyPose) -> NDArray[np.float32]:
        best = min(self.views, key=lambda v: _view_distance(v.camera, v.body_pose, camera, body_pose))
        source = _box(best.camera, self.body.pose(best.body_pose))
        target = _box(camera, self.body.pose(body_pose))
        rows, cols = np.mgrid[: camera.height, : camera.width] + 0.5
        scale = (source[1] - source[0]) / np.maximum(target[1] - target[0], 1e-6)
        x = (cols - target[0][0]) * scale[0] + source[0][0] - 0.5
        y = (rows - target[0][1]) * scale[1] + source[0][1] - 0.5
        image = best.image.astype(np.float32) / 255
        planes = [
            map_coordinates(image[..., c], [y, x], order=1, mode="constant", cval=float(self.background[c]))
            for c in range(3)
        ]
        return np.stack(planes, -1).astype(np.float32)


def _view_distance(camera_a: Camera, pose_a: BodyPose, camera_b: Camera, pose_b: BodyPose) -> float:
    """How differently two cameras see two poses: angle between the view directions in the body's frame, plus the mean
    joint angle between the poses; radians."""
    directions = []
    for camera, pose in ((camera_a, pose_a), (camera_b, pose_b)):
        d = (camera.center - pose.transl) @ axis_angle_to_matrix(pose.pose[0])
        directions.append(d / np.linalg.norm(d))
    angle = np.arccos(np.clip(directions[0] @ directions[1], -1, 1))
    return float(angle + np.linalg.norm(pose_a.pose[1:] - pose_b.pose[1:], axis=1).mean())


def _box(camera: Camera, vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    p = camera.project(vertices)[:, :2]
    return p.min(0), p.max(0)
