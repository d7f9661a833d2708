"""The semantic map that guides the ControlNet (sec. 3.3): the 24 SMPL parts of the posed body in fixed colours."""

from __future__ import annotations

import colorsys
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.render.zbuffer import rasterize

N_PARTS = 24
NO_PART = 255


@cache
def palette() -> NDArray[np.uint8]:
    """[24, 3] RGB; neighbours in the kinematic tree and left and right differ clearly. Background is black."""
    hues = [(k * 7 % N_PARTS) / N_PARTS for k in range(N_PARTS)]
    rgb = [colorsys.hsv_to_rgb(hue, (1.0, 0.55)[k % 2], (1.0, 0.75, 0.9)[k % 3]) for k, hue in enumerate(hues)]
    return np.round(255 * np.array(rgb)).astype(np.uint8)


def part_labels(
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    camera: Camera,
) -> NDArray[np.uint8]:
    """[H, W] the joint that a pixel's surface follows most (argmax of skinning weights), `NO_PART` off the body."""
    raster = rasterize(camera.project(vertices), body.faces, camera.height, camera.width)
    on = raster.face >= 0
    labels = np.full(on.shape, NO_PART, np.uint8)
    corner = raster.bary[on].argmax(1)
    vertex = body.faces[raster.face[on], corner]
    labels[on] = body.weights[vertex].argmax(1)
    return labels


def part_colours(labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[..., H, W] labels -> [..., H, W, 3] RGB for the ControlNet."""
    table = np.zeros((256, 3), np.uint8)
    table[:N_PARTS] = palette()
    return table[labels]
