"""Furniture for a room: boxes with a matt finish that stand on the floor between people and cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera
from ihbench.datasets.standin.lighting import Lighting
from ihbench.render.triangles import triangle_normals
from ihbench.render.zbuffer import rasterize

Array = NDArray[np.float64]

SUPERSAMPLING = 2
WOODS = ((0.52, 0.36, 0.22), (0.68, 0.55, 0.40), (0.36, 0.27, 0.22), (0.75, 0.73, 0.70), (0.30, 0.38, 0.44))
SPLITS = 6  # along each edge of a box, so that a bent lens bends its edges


@dataclass(frozen=True)
class Furniture:
    """Triangles in the world, one colour a triangle."""

    vertices: Array  # [V, 3] m, z up
    faces: NDArray[np.int64]  # [F, 3]
    colours: Array  # [F, 3] sRGB albedo


@dataclass(frozen=True)
class FurnitureView:
    """Furniture as one camera sees it."""

    image: NDArray[np.uint8]  # [H, W, 3] sRGB, the furniture in the room
    depth: NDArray[np.float32]  # [H, W] m, of the nearest sample of furniture in the pixel; inf without any


def furnish(rng: np.random.Generator) -> Furniture:
    """A table, a chair with a back, a shelf and a box, on the side of the room from which camera 0 looks (-y).

    The person walks along x at y = 0; the table hides their legs, the chair's back and the shelf more of them.
    """
    wood = np.asarray(WOODS)[rng.permutation(len(WOODS))]
    boxes: list[tuple[Array, Array, Array]] = []  # centre, size, colour

    def add(x: float, y: float, low: float, width: float, deep: float, high: float, colour: Array) -> None:
        boxes.append((np.array([x, y, low + high / 2]), np.array([width, deep, high]), colour))

    table, height = rng.uniform(-0.35, 0.15), rng.uniform(0.68, 0.78)
    add(table, -0.75, height, 1.1, 0.55, 0.04, wood[0])
    for x in (-0.5, 0.5):
        for y in (-0.97, -0.53):
            add(table + x, y, 0, 0.06, 0.06, height, wood[0])
    add(table, -0.98, 0.15, 1.04, 0.02, height - 0.15, wood[0] * 0.9)  # an apron down to the shins
    side = rng.choice([-1, 1])
    chair = table + side * rng.uniform(0.85, 0.95)
    add(chair, -0.7, 0.42, 0.42, 0.42, 0.05, wood[1])
    add(chair, -0.9, 0.42, 0.42, 0.04, 0.58, wood[1])
    for x in (-0.18, 0.18):
        for y in (-0.88, -0.52):
            add(chair + x, y, 0, 0.04, 0.04, 0.42, wood[1])
    shelf = table - side * rng.uniform(0.95, 1.05)
    add(shelf, -0.8, 0, 0.34, 0.30, rng.uniform(1.25, 1.5), wood[2])
    add(table + rng.uniform(-0.3, 0.3), -0.7, height + 0.04, 0.22, 0.18, rng.uniform(0.2, 0.34), wood[3])
    meshes = [_box(*box) for box in boxes]
    offsets = np.cumsum([0, *(len(v) for v, _, _ in meshes[:-1])])
    return Furniture(
        np.concatenate([v for v, _, _ in meshes]),
        np.concatenate([f + o for (_, f, _), o in zip(meshes, offsets, strict=True)]),
        np.concatenate([c for _, _, c in meshes]),
    )


def _box(centre: Array, size: Array, colour: Array) -> tuple[Array, NDArray[np.int64], Array]:
    """Vertices, faces and face colours of a box whose sides are grids."""
    vertices, faces = [], []
    n, grid = SPLITS + 1, np.linspace(-0.5, 0.5, SPLITS + 1)
    a, b = (x.ravel() for x in np.meshgrid(grid, grid, indexing="ij"))
    corner = np.arange(n * n).reshape(n, n)
    p, q, r, s = (x.ravel() for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    quads = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    for axis in range(3):
        for sign in (-0.5, 0.5):
            points = np.empty((n * n, 3))
            points[:, axis], points[:, axis - 2], points[:, axis - 1] = sign, a, b
            faces.append(quads + n * n * len(vertices))
            vertices.append(points)
    points, triangles = np.concatenate(vertices), np.concatenate(faces)
    return centre + points * size, triangles, np.broadcast_to(colour, (len(triangles), 3))


def furniture_view(
    furniture: Furniture, lighting: Lighting, camera: Camera, room: NDArray[np.uint8]
) -> FurnitureView:
    """Draw furniture into the empty room [H, W, 3] sRGB as this camera sees it."""
    s = SUPERSAMPLING
    points = camera.project(furniture.vertices)
    points[:, :2] *= s
    height, width = camera.height, camera.width
    raster = rasterize(points, furniture.faces, height * s, width * s)
    corners = furniture.vertices[furniture.faces]
    normals = triangle_normals(corners)
    outwards = (normals * (camera.center - corners.mean(1))).sum(1) > 0
    normals[~outwards] *= -1
    colours = np.clip(furniture.colours * lighting.shade(normals), 0, 1) * 255
    samples = np.repeat(np.repeat(room, s, 0), s, 1).astype(np.float64)
    samples[raster.mask] = colours[raster.face[raster.mask]]
    image = samples.reshape(height, s, width, s, 3).mean((1, 3))
    depth = raster.depth.reshape(height, s, width, s).min((1, 3))
    return FurnitureView((image + 0.5).astype(np.uint8), depth)
