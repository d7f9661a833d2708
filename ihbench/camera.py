"""Pinhole cameras: OpenCV axes (x right, y down, z forward), metres, pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadValue

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
    distortion: Array | None = field(default=None)  # [5] OpenCV k1 k2 p1 p2 k3; None, as of zeros: no lens

    def __post_init__(self) -> None:
        """Raises `ValueError` for what is no camera: see `check_intrinsics` and `check_rotation`."""
        for name, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,)), ("distortion", (5,))):
            value = getattr(self, name)
            if value is None and name == "distortion":
                continue
            value = as_numbers(value, f"camera {name}")
            if value.shape != shape:
                word = "; Camera.from_opencv takes columns, rotation vectors and other distortions"
                raise BadValue(
                    f"camera {name}: expected finite values of shape {shape}, got shape {value.shape}{word}"
                )
            if name == "distortion" and not value.any():  # of zeros: none
                object.__setattr__(self, name, None)
                continue
            value = without_rounding(value) if name == "K" else value
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        check_intrinsics(self.K)
        check_rotation(self.R)
        for name in ("width", "height"):
            try:
                size = whole_pixels(getattr(self, name))
            except BadValue:
                raise BadValue(
                    f"camera size: expected whole numbers of pixels, at least 1×1, got {self.width!r}×{self.height!r}"
                ) from None
            object.__setattr__(self, name, size)

    @classmethod
    def from_opencv(
        cls,
        K: Any,  # [3, 3] px
        R: Any,  # [3, 3], or a rotation vector of three numbers, rad
        t: Any,  # three numbers, m
        width: int,
        height: int,
        distortion: Any = None,  # 4, 5, 8, 12 or 14 numbers in OpenCV's order
    ) -> Camera:
        """A camera from an OpenCV calibration, whose pixel centres are integers.

        Lists, tensors, rows and columns are taken, as OpenCV and its YAML files have them. Only k1 k2 p1 p2 k3 can be
        kept: others must be 0. A distortion of zeros is none. Raises `ValueError`.
        """
        K = as_numbers(K, "camera K")
        K = K[0] if K.shape == (1, 3, 3) else K
        if K.shape != (3, 3):
            word = "; give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]" if K.size == 4 else ""
            word = "; the camera is its upper left 3×3" if K.shape in ((3, 4), (4, 4)) else word
            raise BadValue(f"camera K: expected shape [3, 3], got {list(K.shape)}{word}")
        K[:2, 2] += 0.5
        R = as_numbers(R, "camera R")
        if R.size == 3:
            from scipy.spatial.transform import Rotation

            R = Rotation.from_rotvec(R.reshape(3)).as_matrix()
        elif R.shape == (1, 3, 3):
            R = R[0]
        elif R.shape != (3, 3):
            word = "; its last column is t, the rest R" if R.shape[-2:] in ((3, 4), (4, 4)) else ""
            raise BadValue(f"camera R: expected [3, 3] or a rotation vector, got shape {list(R.shape)}{word}")
        t = as_numbers(t, "camera t")
        if t.size != 3:
            word = "; its last column is t, the rest R" if t.shape[-2:] in ((3, 4), (4, 4)) else ""
            raise BadValue(f"camera t: expected three numbers, got shape {list(t.shape)}{word}")
        return cls(K, R, t.reshape(3), width, height, five_coefficients(distortion))

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


def as_numbers(value: Any, what: str) -> Array:
    """A float64 copy of a list, an array or a tensor. Raises `ValueError` unless all are finite numbers."""
    if hasattr(value, "detach"):  # a torch tensor; torch itself is not imported for this
        value = value.detach().cpu().double().numpy()
    try:
        array = np.array(value)
        array = array.astype(np.float64, casting="same_kind" if array.dtype.kind != "b" else "no")
    except (TypeError, ValueError):
        raise BadValue(f"{what}: expected numbers, got a {type(value).__name__} of other contents") from None
    if not np.isfinite(array).all():
        raise BadValue(f"{what}: expected finite values, got NaN or infinity in shape {list(array.shape)}")
    return array


def whole_pixels(size: Any) -> int:
    """A width or height of any type of number, an array or tensor of one too. Raises `ValueError` unless whole."""
    if isinstance(size, bool | np.bool_ | str):
        raise BadValue(f"image size: expected whole numbers of pixels, got {size!r}")
    values = as_numbers(size, "image size")
    if values.size != 1 or values.item() < 1 or values.item() != int(values.item()):
        raise BadValue(f"image size: expected whole numbers of pixels, at least 1, got {size!r}")
    return int(values.item())


def without_rounding(K: Array) -> Array:
    """[3, 3] with the zeros and the one of a K that a factorisation left a little off."""
    exact = np.array([[K[0, 0], K[0, 1], K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    off = np.abs(K - exact).max()
    return exact if 0 < off <= 1e-9 * np.abs(K).max() else K


def five_coefficients(distortion: Any) -> Array | None:
    """[5] k1 k2 p1 p2 k3 of any OpenCV distortion; None for none. Raises `ValueError` for what they cannot say."""
    if distortion is None:
        return None
    values = as_numbers(distortion, "camera distortion").reshape(-1)
    if values.size not in (0, 4, 5, 8, 12, 14):
        raise BadValue(
            f"camera distortion: expected 4, 5, 8, 12 or 14 numbers (k1 k2 p1 p2 k3 …), got {values.size}; "
            f"a fisheye or another model is no OpenCV distortion: undistort images and masks, and give none"
        )
    if values[5:].any():
        raise BadValue(
            f"camera distortion: expected k1 k2 p1 p2 k3 alone, got other terms that are not 0 "
            f"({', '.join(f'{v:.4g}' for v in values[5:])}: rational, thin prism, tilt); undistort images and masks "
            f"with cv2.undistort, and give none"
        )
    return np.pad(values[:5], (0, max(0, 5 - values.size))) if values.any() else None


def check_intrinsics(K: Array, what: str = "camera K") -> None:
    """Raise `ValueError` unless [3, 3] is [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0."""
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or not np.array_equal(K[2], (0, 0, 1)):
        word = "it looks transposed" if np.array_equal(K[:, 2], (0, 0, 1)) and K[2, :2].any() else "check the signs"
        word = "divide it by its last number" if not K[2, :2].any() and K[2, 2] not in (0, 1) else word
        raise BadValue(f"{what}: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with fx, fy > 0; {word}")


def off_orthogonal(R: Array) -> Array:
    """[...] largest entry of |R Rᵀ - 1| of [..., 3, 3]. Of a rotation all entries are small: huge ones may be cut."""
    R = np.clip(R, -1e3, 1e3)
    return np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3)).max((-2, -1))


def check_rotation(R: Array, what: str = "camera R", tolerance: float = 1e-2) -> None:
    """Raise `ValueError` unless [..., 3, 3] are rotations; calibrations written with two decimals still are."""
    if (off_orthogonal(R) > tolerance).any():
        raise BadValue(f"{what}: expected rotations (R Rᵀ = 1), got another matrix; leave scale and t out")
    if (np.linalg.det(R) < 0).any():
        raise BadValue(f"{what}: expected rotations, got a reflection (a left-handed world); flip one axis")


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
