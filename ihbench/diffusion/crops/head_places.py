"""What guides the painter of a head crop: each pixel's place on the head, and where a face's features lie.

A part map has one colour for the whole front of a head: from it nobody can tell where the eyes are.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.diffusion.crops.part_map import HEAD, labels_of, part_colours, smpl_parts
from ihbench.render.zbuffer import Raster

Array = NDArray[np.float64]

REACH = 0.16  # m from the head's middle to where a place's colour ends
FLAT = 0.5  # share of the third channel that says how far forward a place lies; the rest marks features
EYES, MOUTH, BROWS, NOSE = 1.0, 0.85, 0.7, 0.6  # of the third channel


def head_guide(raster: Raster, body: Body) -> NDArray[np.uint8]:
    """[H, W, 3] of a drawn body: on the head how far to the left, up and forward a pixel's surface lies in the rest
    pose, eyes, brows, nose and mouth marked in the third channel; elsewhere the part map's colours."""
    labels = labels_of(raster, body)
    out = part_colours(labels)
    on = raster.mask & head_of(labels)
    points = raster.interpolate(body.v_template, body.faces)[on].astype(np.float64)
    middle = _middle(body)
    place = np.clip(0.5 + 0.5 * (points - middle) / REACH, 0, 1)
    mark = _features(points, body, middle[2])
    place[:, 2] = np.where(mark > 0, mark, FLAT * place[:, 2])
    out[on] = np.rint(255 * place)
    return out


def marked(guide: Any) -> Any:
    """[..., H, W] where a head's guide [..., H, W, 3] of 0 to 255, array or tensor, marks a feature of the face."""
    return guide[..., 2] > 255 * FLAT + 1


def head_of(labels: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where part labels say head."""
    return smpl_parts(labels) == HEAD


@lru_cache(maxsize=4)
def head_vertices(body: Body) -> NDArray[np.int64]:
    """Numbers of the vertices that follow the head most."""
    return np.flatnonzero(body.parts == HEAD)


def _middle(body: Body) -> Array:
    """[3] m of the head's box in the template."""
    head = body.v_template[head_vertices(body)]
    return (head.min(0) + head.max(0)) / 2


def _features(points: Array, body: Body, middle_z: float) -> Array:
    """[N] the mark of each point of the template's head, 0 where there is none."""
    eye_x, eye_y, mouth_y = body.eyes_and_mouth
    x, y = np.abs(points[:, 0]), points[:, 1]
    front = points[:, 2] > middle_z
    out = np.zeros(len(points))
    for mark, inside in (
        (NOSE, _ellipse(x, y - eye_y + 0.030, 0.012, 0.008)),
        (BROWS, _ellipse(x - eye_x, y - eye_y - 0.022, 0.020, 0.005)),
        (MOUTH, _ellipse(x, y - mouth_y, 0.023, 0.009)),
        (EYES, _ellipse(x - eye_x, y - eye_y, 0.015, 0.008)),
    ):
        out[front & inside] = mark
    return out


def _ellipse(x: Array, y: Array, a: float, b: float) -> NDArray[np.bool_]:
    return (x / a) ** 2 + (y / b) ** 2 <= 1
