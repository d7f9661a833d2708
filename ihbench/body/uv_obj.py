"""Texture coordinates from a Wavefront OBJ file, such as the `smpl_uv.obj` that SMPL users have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.files.regular import LARGEST_TEXT, read_bytes


def read_uv_obj(
    path: str | Path,
    faces: NDArray[np.integer],  # [F, 3] of the body
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """uv [Vt, 2] and uv_faces [F, 3] in the order of `faces`, from the `vt` and `f v/vt` lines of an OBJ file.

    The file's triangles must be the body's; they may come in another order or start at another corner. Raises
    `BadInput` on anything else.
    """
    path = Path(path)
    uv, obj_faces, obj_uv_faces = _parse(path)
    if len(uv) == 0 or len(obj_faces) == 0:
        raise BadInput(f"{path}: expected an OBJ file with 'vt u v' and 'f v/vt v/vt v/vt' lines, found none")
    if not np.isfinite(uv).all() or uv.min() < -1e-6 or uv.max() > 1 + 1e-6:
        raise BadInput(f"{path}: expected texture coordinates from 0 to 1, found {uv.min():.4g} to {uv.max():.4g}")
    if obj_uv_faces.min() < 0 or obj_uv_faces.max() >= len(uv) or obj_faces.min() < 0:
        raise BadInput(f"{path}: a face names a texture coordinate that is not in the file (it has {len(uv)})")
    if np.array_equal(obj_faces, faces):
        return uv, obj_uv_faces
    return uv, _match_by_corners(faces, obj_faces, obj_uv_faces, path)


def _parse(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.int32]]:
    uv: list[tuple[float, float]] = []
    corners: list[tuple[int, int]] = []
    lines = read_bytes(path, "an OBJ file", LARGEST_TEXT).decode("utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines, 1):
        word, *values = line.split() or [""]
        try:
            if word == "vt":
                uv.append((float(values[0]), float(values[1])))
            elif word == "f":
                if len(values) != 3:
                    raise ValueError
                for value in values:
                    vertex, texture = value.split("/")[:2]
                    corners.append((int(vertex) - 1, int(texture) - 1))
        except (ValueError, IndexError):
            raise BadInput(
                f"{path}: line {number}: expected 'vt u v' or a triangle 'f v/vt v/vt v/vt', found {line[:60]!r}"
            ) from None
    if any(not -(2**31) <= index < 2**31 for corner in corners for index in corner):
        raise BadInput(f"{path}: a face index does not fit 32 bits")
    table = np.array(corners, np.int64).reshape(-1, 3, 2)
    return np.array(uv, np.float64).reshape(-1, 2), table[..., 0].astype(np.int32), table[..., 1].astype(np.int32)


def _match_by_corners(
    faces: NDArray[np.integer], obj_faces: NDArray[np.int32], obj_uv_faces: NDArray[np.int32], path: Path
) -> NDArray[np.int32]:
    """uv_faces in the order of `faces`: triangles are the same when their three vertices are."""
    pairs = zip(obj_faces.tolist(), obj_uv_faces.tolist(), strict=True)
    of_corners = {frozenset(corners): dict(zip(corners, uv_corners, strict=True)) for corners, uv_corners in pairs}
    triangles = faces.tolist()
    if len(obj_faces) != len(triangles) or of_corners.keys() != set(map(frozenset, triangles)):
        raise BadInput(
            f"{path}: its {len(obj_faces)} triangles are not the body's {len(faces)}; "
            "give the texture coordinates of this body, or none to have an atlas cut from the mesh"
        )
    return np.array([[of_corners[frozenset(face)][vertex] for vertex in face] for face in triangles], np.int32)
