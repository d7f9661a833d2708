"""Normals and areas of triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def triangle_crosses(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] of triangles [..., 3, 3] m: along the normal (right-handed), as long as twice the area, m²."""
    return np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])


def triangle_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """[..., 3] unit normals of triangles [..., 3, 3] m; 0 where there is no area."""
    crosses = triangle_crosses(corners)
    return crosses / np.maximum(np.linalg.norm(crosses, axis=-1, keepdims=True), 1e-20)


def triangle_areas(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """[...] m² of triangles [..., 3, 3] m."""
    return np.linalg.norm(triangle_crosses(corners), axis=-1) / 2
