"""What each training view shows of the body's vertices: which are seen, where, and which the occluder hides."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.uv import Texels
from ihbench.fit.body_box import body_box
from ihbench.methods.occgaussian.config import OccGaussianConfig
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.visibility import PosedSurface


@dataclass(frozen=True)
class Sighting:
    """One view. Places are in px of the window around the body's box, pixel centres at +0.5."""

    seen: NDArray[np.int64]  # [n] vertices that person pixels show
    xy: NDArray[np.float32]  # [n, 2]
    cosine: NDArray[np.float32]  # [n] to the camera: frontal views count more
    hidden: NDArray[np.int64]  # [m] vertices that would be nearest but are UNKNOWN


@dataclass(frozen=True)
class Sightings:
    views: tuple[Sighting, ...]
    seen: NDArray[np.int64]  # [V] key views that show each vertex
    hidden: NDArray[np.int64]  # [V] key views in which it is behind the occluder
    key: NDArray[np.int64]  # numbers of the key views


@lru_cache(maxsize=8)
def vertices_as_texels(body: Body) -> Texels:
    """Each vertex as a point of the first face it belongs to; one in no face is never seen."""
    count = len(body.v_template)
    face = np.zeros(count, np.int32)
    corner = np.full(count, -1)
    for k in (2, 1, 0):  # the first of several wins
        face[body.faces[::-1, k]] = np.arange(len(body.faces), dtype=np.int32)[::-1]
        corner[body.faces[::-1, k]] = k
    bary = np.eye(3)[np.maximum(corner, 0)]
    return Texels(1, np.arange(count), face, bary, np.zeros((count, 2)))


def look_at(view: TrainView, body: Body, config: OccGaussianConfig) -> Sighting:
    """What one view shows. Vertices on known background, or on the rim of the person, are neither seen nor hidden."""
    import cv2

    features = config.features
    surface = PosedSurface(body, view.camera, view.body_pose)
    faced = surface.faced(vertices_as_texels(body), features.facing, features.slack)
    person = (view.mask == MaskState.PERSON).astype(np.uint8)
    if features.erode:
        side = 2 * features.erode + 1
        person = cv2.erode(person, np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    shown = person[faced.pixel] > 0
    behind = (view.mask[faced.pixel] == MaskState.UNKNOWN) & (not config.two_state)
    x0, y0, *_ = body_box(view.camera, body.pose(view.body_pose)).window
    xy = (faced.xy[shown] - (x0, y0)).astype(np.float32)
    return Sighting(faced.texel[shown], xy, faced.cosine[shown].astype(np.float32), faced.texel[behind])


def look_through(views: Sequence[TrainView], body: Body, config: OccGaussianConfig) -> Sightings:
    """All views; counts are over the key views."""
    looks = tuple(look_at(views[k], body, config) for k in range(len(views)))
    wanted = config.features.key_views or len(looks)
    key = np.unique(np.linspace(0, len(looks) - 1, min(wanted, len(looks))).round().astype(np.int64))
    counts = np.zeros((2, len(body.v_template)), np.int64)
    for k in key:
        counts[0, looks[k].seen] += 1
        counts[1, looks[k].hidden] += 1
    return Sightings(looks, counts[0], counts[1], key)
