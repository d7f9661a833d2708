"""Gaussians as a glTF point cloud with `KHR_gaussian_splatting` (Khronos, release candidate of 2026).

Scales and opacities are linear, quaternions x y z w, colours display-referred sRGB, y up. Readers without the
extension see points in `COLOR_0`, which is linear as all of glTF's vertex colours are. The extension knows no skins.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.export.glb import VERTICES, Glb
from ihbench.export.splat_cloud import SplatCloud

EXTENSION = "KHR_gaussian_splatting"
POINTS = 0  # mode of a primitive
PROPERTIES = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}


def splat_glb(cloud: SplatCloud, glb: Glb, extras: Mapping[str, Any]) -> bytes:
    """The file of a cloud in glTF's axes. Raises `ValueError` for an empty cloud, which glTF cannot say."""
    if not len(cloud):
        raise ValueError("splat GLB: expected at least one Gaussian")
    color = np.column_stack([linear(cloud.colors), cloud.opacities])
    attributes = {
        "POSITION": glb.accessor(cloud.means.astype(np.float32), VERTICES, bounds=True),
        "COLOR_0": glb.accessor(np.round(color * 65535).astype(np.uint16), VERTICES, normalized=True),
        f"{EXTENSION}:ROTATION": glb.accessor(_unit(cloud.quaternions[:, [1, 2, 3, 0]]), VERTICES),
        f"{EXTENSION}:SCALE": glb.accessor(cloud.scales.astype(np.float32), VERTICES),
        f"{EXTENSION}:OPACITY": glb.accessor(cloud.opacities.astype(np.float32), VERTICES),
    }
    for degree in range(cloud.degree + 1):
        for k in range(2 * degree + 1):
            values = cloud.harmonics[:, degree**2 + k].astype(np.float32)
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = glb.accessor(values, VERTICES)
    glb.use(EXTENSION)
    primitive = {"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: PROPERTIES}}
    mesh = glb.add("meshes", {"name": "avatar", "primitives": [primitive]})
    node = glb.add("nodes", {"name": "avatar", "mesh": mesh, "extras": dict(extras)})
    glb.document |= {"scene": glb.add("scenes", {"nodes": [node]})}
    return glb.data()


def linear(
    srgb: NDArray[np.float64],  # [...] 0..1
) -> NDArray[np.float64]:
    """[...] 0..1, linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _unit(quaternions: NDArray[np.float64]) -> NDArray[np.float32]:
    return (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).astype(np.float32)
