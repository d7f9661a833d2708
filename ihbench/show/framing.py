"""Cameras around a body, near enough to fill the picture and far enough to hold it: an orbit, the four sides."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera, look_at
from ihbench.show.motion import Stand

Array = NDArray[np.float64]

FIELD = 30.0  # degrees across the shorter side of the picture: a portrait lens, little perspective
ELEVATION = 8.0  # degrees above the horizon that a camera looks down from
MARGIN = 1.12  # hair and clothes reach out of the body
WANDERS = 0.75  # m that a pelvis moves over the floor before the camera goes with it
SIDES = {"front": 0.0, "left": 90.0, "back": 180.0, "right": 270.0}  # degrees about the vertical, of the body's own
MOST_FRAMES, MOST_POINTS = 48, 20_000  # that are looked at
DIRECTIONS = 36  # from which the body must fit into the picture


@dataclass(frozen=True, eq=False)
class Framing:
    """Where the body of some frames is, as a camera that shows all of it must know."""

    stand: Stand  # of the first frame
    centre: Array  # [T, 3] m, world: what the camera of each frame looks at
    points: Array  # [n, 3] m, about that centre, in the axes of `stand`

    @classmethod
    def of(
        cls,
        vertices: list[Array],  # of some frames, [V, 3] m, world
        frames: list[int],  # which these are
        pelvis: Array,  # [T, 3] m, world
        stand: Stand,
    ) -> Framing:
        """The camera stands still, unless the body walks away; then it goes with the pelvis over the floor."""
        path = (pelvis - stand.pelvis) @ stand.axes * (1, 0, 1)
        path = path if np.ptp(path, 0).max() > WANDERS else np.zeros_like(path)
        points = np.concatenate(
            [(posed - stand.pelvis) @ stand.axes - at for posed, at in zip(vertices, path[frames], strict=True)]
        )
        middle = (points.min(0) + points.max(0)) / 2
        few = points[:: len(points) // MOST_POINTS + 1]
        return cls(stand, (path + middle) @ stand.axes.T + stand.pelvis, few - middle)

    def camera(self, frame: int, degrees: float, width: int, height: int, elevation: float = ELEVATION) -> Camera:
        """From `degrees` about the vertical: 0 from the front, 90 from the body's left. The distance is one from
        which the body fits into the picture whatever the direction, so that it keeps its size."""
        focal = min(width, height) / 2 / np.tan(np.deg2rad(FIELD) / 2)
        distance = self._distance(focal, width, height, elevation)
        centre = self.centre[min(frame, len(self.centre) - 1)]
        eye = centre + distance * self.stand.axes @ _toward(degrees, elevation)
        R, t = look_at(eye, centre, self.stand.up)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        return Camera(K, R, t, width, height)

    @cache  # noqa: B019 - a framing lives as long as its film
    def _distance(self, focal: float, width: int, height: int, elevation: float) -> float:
        needed = 0.0
        for degrees in np.arange(DIRECTIONS) * 360 / DIRECTIONS:
            toward = _toward(degrees, elevation)
            R, _ = look_at(toward, np.zeros(3))
            x, y, z = np.abs(self.points @ R[0]), np.abs(self.points @ R[1]), self.points @ toward
            apart = z + MARGIN * focal * np.maximum(x / (width / 2), y / (height / 2))
            needed = max(needed, float(apart.max()))
        return needed


def orbit(framing: Framing, frames: int, width: int, height: int, elevation: float = ELEVATION) -> list[Camera]:
    """Once around, the first camera in front: frame k of `frames` stands at 360 k / `frames` degrees, so that frame
    `frames`, which is not in the list, would be the first one again."""
    return [framing.camera(k, 360 * k / frames, width, height, elevation) for k in range(frames)]


def some_of(count: int) -> list[int]:
    """Numbers of some of `count` frames, evenly over all: enough to see how far a body reaches."""
    return sorted(set(np.linspace(0, count - 1, min(MOST_FRAMES, count)).round().astype(int).tolist()))


def _toward(degrees: float, elevation: float) -> Array:
    """[3] from the body to the camera, in the body's axes."""
    tilt, turn = np.deg2rad(elevation), np.deg2rad(degrees)
    return np.array([np.sin(turn) * np.cos(tilt), np.sin(tilt), np.cos(turn) * np.cos(tilt)])
