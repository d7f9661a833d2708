"""The empty studio behind the person: a floor with mats and a round curtained wall, from any camera.

A busy background makes the masks matter: a method that ignores them paints the studio onto the person.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera, distort
from ihbench.datasets.standin.noise import fractal_noise, value_noise

Array = NDArray[np.float64]

WALL_RADIUS = 4.4  # m; the cameras stand inside
COARSE = 2  # the studio is out of focus, half the resolution is enough


def empty_studio(camera: Camera, seed: int) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB of the room without the person. The room is the same from every camera for one `seed`."""
    from PIL import Image

    coarse = camera.scaled(camera.width // COARSE, camera.height // COARSE)
    rays = _pixel_rays(coarse).reshape(-1, 3)
    floor = -camera.center[2] / np.where(rays[:, 2] < -1e-6, rays[:, 2], np.inf)
    wall = _distance_to_wall(camera.center, rays)
    on_floor = (rays[:, 2] < -1e-6) & (floor < wall)
    hit = camera.center + np.where(on_floor, floor, wall)[:, None] * rays
    colour = np.empty((len(rays), 3))
    colour[on_floor] = _floor_colour(hit[on_floor], seed)
    colour[~on_floor] = _wall_colour(hit[~on_floor], seed)
    image = (np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(coarse.height, coarse.width, 3)
    return np.asarray(Image.fromarray(image).resize((camera.width, camera.height), Image.Resampling.BILINEAR))


def _pixel_rays(camera: Camera) -> Array:
    """[H, W, 3] unit directions in the world through every pixel centre, lens distortion undone."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    y = (y - camera.K[1, 2]) / camera.K[1, 1]
    x = (x - camera.K[0, 2] - camera.K[0, 1] * y) / camera.K[0, 0]
    if camera.distortion is not None:
        x, y = _undistort(x, y, camera.distortion)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera.R
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def _undistort(x: Array, y: Array, coefficients: Array, steps: int = 12) -> tuple[Array, Array]:
    """Fixed-point inverse of `distort`."""
    u, v = x, y
    for _ in range(steps):
        du, dv = distort(u, v, coefficients)
        u, v = u + (x - du), v + (y - dv)
    return u, v


def _distance_to_wall(eye: Array, rays: Array) -> Array:
    """[N] m along unit rays [N, 3] to the cylinder around the z axis."""
    a = (rays[:, :2] ** 2).sum(1)
    b = rays[:, :2] @ eye[:2]
    c = eye[:2] @ eye[:2] - WALL_RADIUS**2
    return (-b + np.sqrt(b * b - a * c)) / np.maximum(a, 1e-9)


def _floor_colour(points: Array, seed: int) -> Array:
    """Interlocking foam mats, with the soft dark patch where the person stands."""
    mat = np.floor(points[:, :2] / 0.6)
    checker = np.mod(mat.sum(1), 2)
    joint = np.abs(points[:, :2] / 0.6 - np.round(points[:, :2] / 0.6)).min(1) * 0.6
    grey = 0.40 + 0.05 * checker + 0.07 * (fractal_noise(points, seed, 3.0) - 0.5)
    grey = np.where(joint < 0.006, grey - 0.10, grey)
    radius = np.hypot(points[:, 0], points[:, 1])
    grey *= 1 - 0.30 * np.exp(-((radius / 0.45) ** 2)) - 0.05 * np.clip(radius - 1.5, 0, 3)
    return grey[:, None] * (1.0, 1.01, 0.96)


def _wall_colour(points: Array, seed: int) -> Array:
    """A pleated curtain below, lamps and a dark ceiling band above, boxes of equipment here and there."""
    azimuth, height = np.arctan2(points[:, 1], points[:, 0]), points[:, 2]
    rng = np.random.default_rng(seed)
    cloth = np.asarray(((0.30, 0.36, 0.33), (0.27, 0.31, 0.38), (0.38, 0.34, 0.30))[seed % 3])
    wobble = 3 * value_noise(points * (1, 1, 0.15), seed + 1, 1.5)
    pleat = 0.5 + 0.5 * np.sin(90 * azimuth + wobble)
    shade = (0.72 + 0.35 * pleat) * (0.85 + 0.25 * fractal_noise(points, seed + 2, 1.2))
    colour = cloth * shade[:, None]
    rail = height > 2.55
    colour[rail] = np.array([0.13, 0.13, 0.14]) * (0.8 + 0.3 * value_noise(points[rail], seed + 3, 2.0))[:, None]
    for _ in range(9):
        centre, half_width = rng.uniform(-np.pi, np.pi), rng.uniform(0.05, 0.10)
        low, high = rng.uniform(2.65, 2.8), rng.uniform(3.0, 3.3)
        lamp = (_angle_between(azimuth, centre) < half_width) & (height > low) & (height < high)
        colour[lamp] = (0.93, 0.93, 0.88)
    for _ in range(14):
        centre, half_width = rng.uniform(-np.pi, np.pi), rng.uniform(0.02, 0.09)
        top = rng.uniform(0.4, 1.5)
        tint = 0.75 * rng.uniform(0.12, 0.55) + 0.25 * rng.uniform(0.12, 0.55, 3)
        box = (_angle_between(azimuth, centre) < half_width) & (height < top)
        colour[box] = tint * (0.85 + 0.2 * value_noise(points[box], seed + 4, 5.0))[:, None]
    return colour


def _angle_between(a: Array, b: float) -> Array:
    return np.abs(np.mod(a - b + np.pi, 2 * np.pi) - np.pi)
