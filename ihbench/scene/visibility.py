"""Which part of the body's surface the training views showed, texel by texel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.render.triangles import triangle_normals
from ihbench.render.zbuffer import rasterize
from ihbench.scene.mask_state import MaskState

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

    @classmethod
    def none(cls, count: int) -> Visibility:
        """Of so many texels, before any view is counted."""
        return cls(np.zeros(count, np.int32), np.zeros(count, np.int32))

    def count(
        self,
        faced: FacedTexels,
        mask: NDArray[np.uint8],  # [H, W] MaskState
    ) -> NDArray[np.uint8]:
        """Count one more view; gives the MaskState [n] of the faced texels' pixels."""
        state = mask[faced.pixel]
        # a texel over known background is neither: the fitted body sticks out of the person there
        self.faced[faced.texel] += state != MaskState.BACKGROUND
        self.seen[faced.texel] += state == MaskState.PERSON
        return state

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


@dataclass(frozen=True)
class FacedTexels:
    """Texels that are the nearest surface in a view, occluder ignored, and not seen too obliquely: n of the N."""

    texel: NDArray[np.int64]  # [n] numbers in the texel table, ascending
    xy: NDArray[np.float64]  # [n, 2] px where the view shows them, pixel centres at +0.5
    cosine: NDArray[np.float64]  # [n] between the normal and the direction to the camera

    @property
    def pixel(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row [n] and column [n] of the pixels that show them."""
        column, row = self.xy.astype(np.int64).T
        return row, column


class PosedSurface:
    """The body before the camera of one view, with its z-buffer: asked for the texels of as many grids as needed."""

    def __init__(self, body: Body, camera: Camera, body_pose: BodyPose):
        self.camera = camera
        vertices = body.pose(body_pose)
        self._depth = rasterize(camera.project(vertices), body.faces, camera.height, camera.width).depth
        self._corners = vertices[body.faces]
        self._normals = triangle_normals(self._corners)
        self._front = (self._normals * (camera.center - self._corners[:, 0])).sum(1) > 0

    def faced(self, texels: Texels, facing: float = FACING, slack: float = DEPTH_SLACK) -> FacedTexels:
        """Those turned to the camera by a cosine above `facing` and at most `slack` m behind the nearest surface."""
        camera = self.camera
        texel = np.flatnonzero(self._front[texels.face])
        face = texels.face[texel]
        points = np.einsum("nk,nkd->nd", texels.bary[texel], self._corners[face])
        to_camera = camera.center - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        cosine = (self._normals[face] * to_camera).sum(1)
        turned = cosine > facing
        texel, cosine = texel[turned], cosine[turned]
        p = camera.project(points[turned])
        inside = (p[:, 2] > 0) & (p[:, :2] >= 0).all(1) & (p[:, 0] < camera.width) & (p[:, 1] < camera.height)
        texel, cosine, p = texel[inside], cosine[inside], p[inside]
        column, row = p[:, :2].astype(np.int64).T
        nearest = p[:, 2] <= self._depth[row, column] + slack
        return FacedTexels(texel[nearest], p[nearest, :2], cosine[nearest])


def texel_visibility(views: Iterable[MaskedView], body: Body, texels: Texels) -> Visibility:
    """Count, for every texel, the training views that faced it and those that showed it."""
    seen = Visibility.none(len(texels.face))
    for view in views:
        seen.count(PosedSurface(body, view.camera, view.body_pose).faced(texels), view.mask)
    return seen
