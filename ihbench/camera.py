"""Pinhole cameras: OpenCV axes (x right, y down, z forward), metres, pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """One calibrated view.

    The centre of pixel (row i, column j) lies at (x, y) = (j + 0.5, i + 0.5). OpenCV's calibration puts it at (j, i),
    so a loader of OpenCV calibrations adds 0.5 to the principal point (`from_opencv` does).
    """

    K: Array  # [3, 3] px
    R: Array  # [3, 3] world to camera
    t: Array  # [3] m, world to camera
    width: int
    height: int
    distortion: Array | None = field(default=None)  # [5] OpenCV k1 k2 p1 p2 k3, or None

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,)), ("distortion", (5,))):
            value = getattr(self, name)
            if value is None and name == "distortion":
                continue
            value = np.array(value, dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"camera {name}: expected finite values of shape {shape}, got shape {value.shape}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"camera size: expected at least 1×1 px, got {self.width}×{self.height}")

    @classmethod
    def from_opencv(
        cls, K: Array, R: Array, t: Array, width: int, height: int, distortion: Array | None = None
    ) -> Camera:
        """A camera from an OpenCV calibration, whose pixel centres are integers; t in metres."""
        K = np.array(K, dtype=np.float64)
        K[:2, 2] += 0.5
        return cls(K, R, t, width, height, distortion)

    @property
    def K_opencv(self) -> Array:
        """[3, 3] px, with OpenCV's integer pixel centres: what cv2.undistort and calibration files expect."""
        K = self.K.copy()
        K[:2, 2] -= 0.5
        return K

    @property
    def center(self) -> Array:
        """[3] m, the camera's position in the world."""
        return -self.R.T @ self.t

    def to_camera(self, points: Array) -> Array:
        """[..., 3] m world -> [..., 3] m camera."""
        return points @ self.R.T + self.t

    def project(self, points: Array) -> Array:
        """[..., 3] m world -> [..., 3]: x px, y px, depth m. Applies the lens distortion if the camera has one.

        Points at or behind the camera plane (depth <= 0) get non-finite or meaningless pixels; check the depth.
        """
        p = self.to_camera(points)
        z = p[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y = p[..., 0] / z, p[..., 1] / z
            if self.distortion is not None:
                x, y = distort(x, y, self.distortion)
            u = self.K[0, 0] * x + self.K[0, 1] * y + self.K[0, 2]
            v = self.K[1, 1] * y + self.K[1, 2]
        return np.stack([u, v, z], -1)

    def scaled(self, width: int, height: int) -> Camera:
        """The same view resampled to another size. Exact for area resampling, since centres lie at +0.5."""
        K = self.K.copy()
        K[0] *= width / self.width
        K[1] *= height / self.height
        return replace(self, K=K, width=width, height=height)

    def undistorted(self) -> Camera:
        """The same camera without its lens distortion (same K, as every released ZJU reader keeps it)."""
        return replace(self, distortion=None)

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The window of this view that starts at pixel column x0, row y0."""
        K = self.K.copy()
        K[0, 2] -= x0
        K[1, 2] -= y0
        return replace(self, K=K, width=width, height=height)


def distort(x: Array, y: Array, coefficients: Array) -> tuple[Array, Array]:
    """Normalised image coordinates -> distorted ones, OpenCV's k1 k2 p1 p2 k3 model."""
    k1, k2, p1, p2, k3 = coefficients
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def look_at(
    eye: Array, target: Array, up: Array | tuple[float, float, float] = (0.0, 1.0, 0.0)
) -> tuple[Array, Array]:
    """R [3, 3], t [3] of a camera at `eye` m that looks at `target` m, with `up` pointing up in the image.

    Raises ValueError when eye and target are one point, and when the camera looks along `up`.
    """
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    z = target - eye
    x = np.cross(z, np.asarray(up, np.float64))
    across = np.linalg.norm(x)
    if not across > 1e-12 * np.linalg.norm(z) * np.linalg.norm(up):
        raise ValueError(
            f"look_at: expected a view direction that is not along up, got eye {eye}, target {target}, up {up}"
        )
    z /= np.linalg.norm(z)
    x /= across
    R = np.stack([x, np.cross(z, x), z])
    return R, -R @ eye
