"""Numbers out of dictionaries that other people's programs stored, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import Camera, off_orthogonal
from ihbench.datasets.reading.capture_folder import BY_OPTIONS
from ihbench.errors import BadInput

FARTHEST = 100.0  # m from the origin: captures are made in rooms


def numbers(
    content: Any, key: str, shape: tuple[int, ...], where: object, finite: bool = True
) -> NDArray[np.float64]:
    """One entry as float64 of a shape, where -1 is any length; a new array, without NaN and infinity if `finite`.

    Rows and columns pass as vectors, 72 numbers as [24, 3]. Raises `BadInput` that starts with `where`.
    """
    sides = ", ".join("n" if side < 0 else str(side) for side in shape)
    expected = f"{where}: expected {key!r} to be numbers of shape [{sides}]"
    if not isinstance(content, Mapping) or key not in content:
        raise BadInput(f"{expected}, found no such key")
    try:
        value = np.array(content[key], np.float64)
    except (TypeError, ValueError, OverflowError):
        raise BadInput(f"{expected}, found {described(content[key])} of other contents") from None
    if shape == (24, 3) and value.size == 72:
        value = value.reshape(24, 3)
    if not _fits(value.shape, shape):
        squeezed = value.reshape(1) if value.size == 1 else value.squeeze()
        if not _fits(squeezed.shape, shape):
            raise BadInput(f"{expected}, found {list(value.shape)}")
        value = squeezed
    if finite and not np.isfinite(value).all():
        raise BadInput(
            f"{where}: NaN or infinity in {key!r}; expected finite numbers, leave a frame out {BY_OPTIONS}"
        )
    return value


def _fits(shape: tuple[int, ...], expected: tuple[int, ...]) -> bool:
    return len(shape) == len(expected) and all(a == b or (b < 0 < a) for a, b in zip(shape, expected, strict=True))


def described(value: object) -> str:
    """What a value is, for messages."""
    if isinstance(value, dict):
        keys = sorted(str(key)[:20] for key in value)
        return f"a dictionary with {', '.join(keys[:6]) or 'nothing'}{', …' if len(keys) > 6 else ''}"
    if isinstance(value, np.ndarray):
        return f"a {value.dtype} array of shape {list(value.shape)}"
    return f"a {type(value).__name__}"


def check_calibration(K: NDArray[np.float64], E: NDArray[np.float64], where: object) -> None:
    """Raise `BadInput` unless K is a pinhole's and E a rigid world-to-camera transform in metres."""
    if K[0, 0] <= 0 or K[1, 1] <= 0 or np.abs(K[2] - [0, 0, 1]).max() > 1e-6 or abs(K[1, 0]) > 1e-6:
        raise BadInput(f"{where}: expected intrinsics [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] px, found another matrix")
    R = E[:3, :3]
    if off_orthogonal(R) > 1e-3 or np.linalg.det(R) < 0 or np.abs(E[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise BadInput(f"{where}: expected extrinsics [[R, t], [0, 1]] with a rotation R, found another matrix")
    if np.linalg.norm(E[:3, 3]) > FARTHEST:
        raise BadInput(
            f"{where}: the camera stands {np.linalg.norm(E[:3, 3]):.4g} from the origin; expected metres, divide the "
            f"extrinsics' t by 1000 if it is in millimetres"
        )


def extrinsic(camera: Camera) -> NDArray[np.float64]:
    """[4, 4] world to camera, m."""
    return np.block([[camera.R, camera.t[:, None]], [np.zeros(3), 1.0]])


def stored_camera(camera: Camera, layout: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K [3, 3] px with integer pixel centres and E [4, 4] world to camera, m. Raises `ValueError` for a camera with
    distortion, which the layout cannot keep."""
    if camera.distortion is not None:
        raise ValueError(f"{layout} camera: expected a camera without distortion, undistort the images first")
    return camera.K_opencv, extrinsic(camera)
