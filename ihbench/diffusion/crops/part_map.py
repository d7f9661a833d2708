"""The semantic map that guides the ControlNet (sec. 3.3): the posed body's SMPL parts in fixed colours.

The paper's map has a colour for each of the 24 parts. Ours has three, a bright one for the side of a part that faces
forward in the rest pose, a dark one for its back and one between for its profile: from a part alone a face cannot be
told from the back of a head, nor from an ear.
"""

from __future__ import annotations

import colorsys
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.render.triangles import triangle_crosses
from ihbench.render.zbuffer import Raster, rasterize

N_PARTS = 24
BACK, PROFILE = N_PARTS, 2 * N_PARTS  # added to a part's number on its back, and on its profile
N_LABELS = 3 * N_PARTS
NO_PART = 255
BRIGHTNESS = (1.0, 0.5, 0.75)  # of front, back and profile
SIDEWAYS = 0.5  # cosine to the forward axis in the rest pose, below which surface is profile
HEAD = 15


@cache
def palette() -> NDArray[np.uint8]:
    """[72, 3] RGB; neighbours in the kinematic tree and left and right differ clearly. Background is black."""
    hues = [(k * 7 % N_PARTS) / N_PARTS for k in range(N_PARTS)]
    rgb = [colorsys.hsv_to_rgb(hue, (1.0, 0.55)[k % 2], (1.0, 0.75, 0.9)[k % 3]) for k, hue in enumerate(hues)]
    return np.round(255 * np.concatenate([share * np.array(rgb) for share in BRIGHTNESS])).astype(np.uint8)


def part_labels(
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
) -> NDArray[np.uint8]:
    """[H, W] the joint that a pixel's surface follows most (argmax of skinning weights), plus `BACK` where the
    surface faces backward in the rest pose and `PROFILE` where it faces sideways, up or down; `NO_PART` off the
    body."""
    return labels_of(drawn_body(vertices, body, camera), body)


def drawn_body(vertices: NDArray[np.float64], body: Body, camera: Camera) -> Raster:
    """The posed body as the camera sees it."""
    return rasterize(camera.project(vertices), body.faces, camera.height, camera.width)


def labels_of(raster: Raster, body: Body) -> NDArray[np.uint8]:
    """`part_labels` of a body that is drawn already."""
    on = raster.mask
    face = raster.face[on]
    vertex = body.faces[face, raster.bary[on].argmax(1)]
    normals = triangle_crosses(body.v_template[body.faces[face]])
    forward = normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-30)
    side = np.where(np.abs(forward) < SIDEWAYS, PROFILE, np.where(forward < 0, BACK, 0))
    labels = np.full(on.shape, NO_PART, np.uint8)
    labels[on] = body.weights[vertex].argmax(1) + side
    return labels


def smpl_parts(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Labels without the side: 0 to 23, or `NO_PART`."""
    return np.where(labels == NO_PART, labels, labels % N_PARTS)


def part_colours(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[..., H, W] labels -> [..., H, W, 3] RGB for the ControlNet."""
    table = np.zeros((256, 3), np.uint8)
    table[:N_LABELS] = palette()
    return table[labels]
