"""One photograph of a clothed person: z-buffer, texture and light at twice the resolution, then an area average."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.datasets.standin.lighting import Lighting
from ihbench.render.zbuffer import rasterize, vertex_normals

SUPERSAMPLING = 2


@dataclass(frozen=True)
class Photograph:
    """What one camera sees, in its own distorted image."""

    image: NDArray[np.uint8]  # [H, W, 3] sRGB, the person in front of the background
    mask: NDArray[np.bool_]  # [H, W] at least half the pixel shows the person
    parts: NDArray[np.uint8]  # [H, W] `outfit.Part` inside the mask, 0 outside
    depth: NDArray[np.float32]  # [H, W] m, of the nearest sample of the person in the pixel; inf without any


def photograph(
    vertices: NDArray[np.float64],  # [V, 3] m, world
    body: Body,
    texture: NDArray[np.float32],  # [S, S, 3] sRGB albedo in [0, 1]
    labels: NDArray[np.uint8],  # [S, S] part labels
    lighting: Lighting,
    camera: Camera,
    background: NDArray[np.uint8],  # [H, W, 3] sRGB, the empty studio from this camera
) -> Photograph:
    """Project every vertex through the lens, rasterise inside the person's window and shade each sample.

    Edges of triangles stay straight in the distorted image; at a centimetre a side the error is below 0.01 px.
    """
    image = background.copy()
    mask = np.zeros(image.shape[:2], bool)
    parts = np.zeros(image.shape[:2], np.uint8)
    depth = np.full(image.shape[:2], np.inf, np.float32)
    points = camera.project(vertices)
    x0, y0 = np.maximum(np.floor(points[:, :2].min(0)).astype(int), 0)
    x1, y1 = np.minimum(np.ceil(points[:, :2].max(0)).astype(int), (camera.width, camera.height))
    if x1 <= x0 or y1 <= y0:
        return Photograph(image, mask, parts, depth)
    window = np.s_[y0:y1, x0:x1]
    points[:, :2] = (points[:, :2] - (x0, y0)) * SUPERSAMPLING
    raster = rasterize(points, body.faces, (y1 - y0) * SUPERSAMPLING, (x1 - x0) * SUPERSAMPLING)
    samples = raster.depth.reshape(y1 - y0, SUPERSAMPLING, x1 - x0, SUPERSAMPLING)
    depth[window] = samples.min((1, 3))
    image[window], mask[window], parts[window] = _shade_kernel()(
        raster.face,
        raster.bary,
        body.faces,
        body.uv_faces,
        body.uv,
        vertex_normals(vertices, body.faces),
        texture,
        labels,
        lighting.ambient,
        lighting.towards,
        lighting.colours,
        background[window],
        SUPERSAMPLING,
    )
    return Photograph(image, mask, parts, depth)


@cache
def _shade_kernel():
    from numba import njit

    @njit(cache=True, nogil=True)
    def shade(face, bary, faces, uv_faces, uv, normals, texture, labels, ambient, towards, colours, background, s):
        H, W = background.shape[:2]
        size = texture.shape[0]
        image = background.copy()
        mask = np.zeros((H, W), np.bool_)
        parts = np.zeros((H, W), np.uint8)
        light, colour, normal = np.empty(3), np.empty(3), np.empty(3)
        votes = np.zeros(256, np.int64)
        for row in range(H):
            for column in range(W):
                hits, best = 0, 0
                colour[:] = 0.0
                for sample in range(s * s):
                    i, j = row * s + sample // s, column * s + sample % s
                    f = face[i, j]
                    if f < 0:
                        continue
                    hits += 1
                    u, v = 0.0, 0.0
                    normal[:] = 0.0
                    for k in range(3):
                        b = bary[i, j, k]
                        u += b * uv[uv_faces[f, k], 0]
                        v += b * uv[uv_faces[f, k], 1]
                        for c in range(3):
                            normal[c] += b * normals[faces[f, k], c]
                    # scalar loops: array expressions would allocate for every sample
                    length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) + 1e-12
                    for c in range(3):
                        light[c] = ambient[c]
                    for lamp in range(towards.shape[0]):
                        facing = 0.0
                        for c in range(3):
                            facing += normal[c] / length * towards[lamp, c]
                        half = 0.5 + 0.5 * facing
                        for c in range(3):
                            light[c] += half * half * colours[lamp, c]
                    # bilinear, texel centres at +0.5, row 0 is v = 1
                    x = min(max(u * size - 0.5, 0.0), size - 1.001)
                    y = min(max((1.0 - v) * size - 0.5, 0.0), size - 1.001)
                    ix, iy = int(x), int(y)
                    fx, fy = x - ix, y - iy
                    for c in range(3):
                        upper = texture[iy, ix, c] * (1 - fx) + texture[iy, ix + 1, c] * fx
                        lower = texture[iy + 1, ix, c] * (1 - fx) + texture[iy + 1, ix + 1, c] * fx
                        colour[c] += min((upper * (1 - fy) + lower * fy) * light[c], 1.0)
                    part = labels[int(y + 0.5), int(x + 0.5)]
                    votes[part] += 1
                    if votes[part] > votes[best]:
                        best = part
                if hits == 0:
                    continue
                for c in range(3):
                    behind = background[row, column, c] / 255.0 * (s * s - hits)
                    image[row, column, c] = np.uint8((colour[c] + behind) / (s * s) * 255.0 + 0.5)
                if 2 * hits >= s * s:
                    mask[row, column] = True
                    parts[row, column] = best
                votes[:] = 0
        return image, mask, parts

    return shade
