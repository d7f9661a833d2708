"""Which part of the body's surface the training views showed, texel by texel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.body.uv import Texels

DEPTH_SLACK = 0.015  # m; a texel this much behind the nearest surface still counts as the surface
FACING = 0.1  # cosine between normal and view direction below which a texel is seen too obliquely to count


class MaskedView(Protocol):
    """The part of a training view that visibility needs; `TrainView` is one. Cameras may have lens distortion."""

    @property
    def mask(self) -> NDArray[np.uint8]: ...

    @property
    def camera(self) -> Camera: ...

    @property
    def body_pose(self) -> BodyPose: ...


@dataclass(frozen=True)
class Visibility:
    """Per texel, over all training views."""

    faced: NDArray[np.int32]  # [N] views in which the texel was the nearest surface, occluder ignored
    seen: NDArray[np.int32]  # [N] views in which its pixel also showed the visible person

    @property
    def visible(self) -> NDArray[np.bool_]:
        """[N] seen un-occluded in at least one training view."""
        return self.seen > 0

    @property
    def hidden(self) -> NDArray[np.bool_]:
        """[N] faced the training camera, but only ever behind the occluder."""
        return (self.seen == 0) & (self.faced > 0)

    @property
    def never_seen(self) -> NDArray[np.bool_]:
        """[N] never faced the training camera."""
        return self.faced == 0


def surface_texels(
    vertices: NDArray[np.float64],  # [V, 3] m world
    body: Body,
    texels: Texels,
    view: MaskedView,
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """(nearest [N], row [N], column [N], cosine [N]): texels that are the nearest surface in this view and not seen
    too obliquely, their pixels, and the cosine between normal and direction to the camera."""
    camera = view.camera
    projected = camera.project(vertices)
    depth = rasterize(projected, body.faces, camera.height, camera.width).depth
    corners = vertices[body.faces[texels.face]]  # [N, 3, 3]
    points = np.einsum("nk,nkd->nd", texels.bary, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    to_camera = camera.center - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    p = camera.project(points)
    inside = (p[:, 2] > 0) & (p[:, 0] >= 0) & (p[:, 0] < camera.width) & (p[:, 1] >= 0) & (p[:, 1] < camera.height)
    column = np.where(inside, p[:, 0], 0).astype(np.int64)
    row = np.where(inside, p[:, 1], 0).astype(np.int64)
    cosine = (normals * to_camera).sum(1)
    return inside & (cosine > FACING) & (p[:, 2] <= depth[row, column] + DEPTH_SLACK), row, column, cosine


def texel_visibility(views: Iterable[MaskedView], body: Body, texels: Texels) -> Visibility:
    """Count, for every texel, the training views that faced it and those that showed it."""
    faced = np.zeros(len(texels.face), np.int32)
    seen = np.zeros(len(texels.face), np.int32)
    for view in views:
        nearest, row, column, _ = surface_texels(body.pose(view.body_pose), body, texels, view)
        state = view.mask[row, column]
        # a texel over known background is neither: the fitted body sticks out of the person there
        faced += nearest & (state != MaskState.BACKGROUND)
        seen += nearest & (state == MaskState.PERSON)
    return Visibility(faced, seen)
