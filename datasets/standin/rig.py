"""The studio's calibrated cameras: a ring around the z axis, every lens and tripod a little different."""

from __future__ import annotations

import numpy as np

from ihbench.camera import Camera, look_at

N_CAMERAS = 23
IMAGE_SIZE = 1024  # px
UP = (0.0, 0.0, 1.0)  # the floor is z = 0


def camera_ring(rng: np.random.Generator) -> list[Camera]:
    """Twenty-three cameras about 3 m from the origin that see the whole person wherever they stand and reach.

    fx differs from fy, the principal point lies off the centre, the tripods lean, and the lenses bend straight lines
    (|k1| 0.05–0.2, barrel or pincushion), so a reader that skips undistortion or assumes a tidy camera shows it.
    """
    return [_camera(2 * np.pi * k / N_CAMERAS, rng) for k in range(N_CAMERAS)]


def _camera(azimuth: float, rng: np.random.Generator) -> Camera:
    azimuth += np.deg2rad(rng.uniform(-3, 3))
    radius = rng.uniform(3.0, 3.3)
    eye = np.array([radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(0.8, 1.9)])
    target = np.array([0.0, 0.0, 0.98]) + rng.uniform(-0.05, 0.05, 3)
    lean = np.deg2rad(rng.uniform(-2, 2))
    sideways = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R, t = look_at(eye, target, up=np.cos(lean) * np.asarray(UP) + np.sin(lean) * sideways)
    fx = rng.uniform(880, 940)
    cx, cy = IMAGE_SIZE / 2 + rng.uniform(-18, 18, 2)
    K = np.array([[fx, 0, cx], [0, fx * rng.uniform(0.995, 1.005), cy], [0, 0, 1]])
    return Camera(K, R, t, IMAGE_SIZE, IMAGE_SIZE, _lens(rng))


def _lens(rng: np.random.Generator) -> np.ndarray:
    """[5] OpenCV k1 k2 p1 p2 k3; k2 opposes k1, so the mapping stays one-to-one over the whole image."""
    k1 = rng.uniform(0.05, 0.2) * (1 if rng.random() < 0.25 else -1)
    k2 = -k1 * rng.uniform(0.3, 0.6)
    p1, p2 = rng.uniform(-1e-3, 1e-3, 2)
    return np.array([k1, k2, p1, p2, k1 * rng.uniform(0.0, 0.1)])
