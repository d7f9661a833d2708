"""Regions of a test view: where a number is taken.

`visible`, `hidden` and `never_seen` partition `body` by what training showed of the surface that a pixel shows. What
nobody knows of a test view (`TestView.hidden`) is in no region.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera
from ihbench.metrics.images import bounds
from ihbench.render.zbuffer import NEAR, rasterize
from ihbench.scene.contracts import TestView
from ihbench.scene.visibility import Visibility

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.body.uv import Texels

VISIBLE, HIDDEN, NEVER_SEEN = 1, 2, 3


@dataclass(frozen=True)
class SurfaceMap:
    """What training showed of the surface, as an image over UV space (charts padded outwards)."""

    body: Body
    labels: NDArray[np.uint8]  # [R, R] VISIBLE, HIDDEN or NEVER_SEEN

    @classmethod
    def build(cls, body: Body, texels: Texels, visibility: Visibility) -> SurfaceMap:
        from ihbench.body.uv import chart_padding

        size = texels.resolution
        flat = np.zeros(size * size, np.uint8)
        flat[texels.index] = np.select([visibility.visible, visibility.hidden], [VISIBLE, HIDDEN], NEVER_SEEN)
        return cls(body, flat[chart_padding(texels.mask, size)])

    def regions(
        self, view: TestView, names: tuple[str, ...], box_padding: float
    ) -> dict[str, NDArray[np.bool_] | str]:
        """Masks [H, W] of the named regions; a string instead of a mask says why a region is absent.

        `box` is padded by `box_padding` m, `box+0.3` by 0.3 m: released evaluators have paddings of their own. Raises
        `ValueError` for a name that is none.
        """
        vertices = self.body.pose(view.body_pose)
        surface = np.zeros(0)
        if {"visible", "hidden", "never_seen"} & set(names):
            surface = self._surface_labels(vertices, view)
        every = {
            "full": lambda: np.ones_like(view.silhouette),
            "box": lambda: projected_box(vertices, view.camera, box_padding),
            "body": lambda: view.silhouette,
            "visible": lambda: surface == VISIBLE,
            "hidden": lambda: surface == HIDDEN,
            "never_seen": lambda: surface == NEVER_SEEN,
        }
        masks = {}
        for name in names:
            if padding := re.fullmatch(r"box\+([0-9.]+)", name):
                region = projected_box(vertices, view.camera, float(padding[1]))
            elif name in every:
                region = every[name]()
            else:
                raise ValueError(f"region {name!r}: expected one of {', '.join(every)}, or box+METRES")
            masks[name] = region if view.hidden is None else region & ~view.hidden
        return masks

    def labels_in(
        self,
        vertices: NDArray[np.float64],  # [V, 3] m world, posed
        camera: Camera,
    ) -> NDArray[np.uint8]:
        """[H, W] label of the posed surface in every pixel, 0 where the body is not."""
        from ihbench.body.uv import texel_at

        raster = rasterize(camera.project(vertices), self.body.faces, camera.height, camera.width)
        labels = np.zeros((camera.height, camera.width), np.uint8)
        hit = raster.mask
        uv = raster.interpolate(self.body.uv, self.body.uv_faces)[hit]
        labels[hit] = self.labels[texel_at(uv, len(self.labels))]
        return labels

    def _surface_labels(self, vertices: NDArray[np.float64], view: TestView) -> NDArray[np.uint8]:
        """[H, W] label of every silhouette pixel, 0 elsewhere. Garments stand off the body, so silhouette pixels
        beyond the projected body take the label of the nearest body pixel."""
        from scipy.ndimage import distance_transform_edt

        labels = self.labels_in(vertices, view.camera)
        hit = labels > 0
        if not hit.any():
            return np.where(view.silhouette, NEVER_SEEN, 0).astype(np.uint8)
        # the search stays in the rectangle that holds both the silhouette and the projected body
        area = bounds(hit | view.silhouette)
        assert area is not None
        rows, cols = np.asarray(distance_transform_edt(~hit[area], return_distances=False, return_indices=True))
        out = np.zeros_like(labels)
        out[area] = np.where(view.silhouette[area], labels[area][rows, cols], 0)
        return out


def projected_box(
    vertices: NDArray[np.float64],  # [V, 3] m world
    camera: Camera,
    padding: float,
) -> NDArray[np.bool_]:
    """[H, W] the convex outline of the body's axis-aligned world box, padded by `padding` m on every side.

    NeuralBody calls it mask_at_box (zju3dv/neuralbody lib/utils/if_nerf/if_nerf_data_utils.py).
    """
    import cv2

    low, high = vertices.min(0) - padding, vertices.max(0) + padding
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    p = camera.project(corners)
    if not (p[:, 2] >= NEAR).all():  # the box reaches the camera plane: its outline has no bounded projection
        return np.ones((camera.height, camera.width), bool)
    hull = cv2.convexHull(np.round(p[:, :2] - 0.5).astype(np.int32))
    mask = np.zeros((camera.height, camera.width), np.uint8)
    cv2.fillConvexPoly(mask, hull, 1)
    return mask.astype(bool)
