"""Z-buffer for triangle meshes: face ids, barycentrics and depth per pixel, from which masks, part maps, UV images,
position maps and visibility follow.

Two implementations of one function, equal to the last bit: numpy (always there) and numba (used when importable).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.camera import whole_pixels
from ihbench.render.triangles import triangle_crosses

NEAR = 1e-3  # m; a triangle with a corner nearer than this is dropped, not clipped


@dataclass(frozen=True)
class Raster:
    """What the nearest surface at every pixel centre is."""

    face: NDArray[np.int32]  # [H, W] index into faces, -1 where nothing is
    bary: NDArray[np.float32]  # [H, W, 3] perspective-correct barycentrics, 0 where nothing is
    depth: NDArray[np.float32]  # [H, W] m, inf where nothing is

    @property
    def mask(self) -> NDArray[np.bool_]:
        """[H, W] True where a surface is."""
        return self.face >= 0

    def interpolate(self, values: NDArray, faces: NDArray) -> NDArray[np.float32]:
        """Values [V, C] at the corners of `faces` [F, 3] -> [H, W, C], 0 where nothing is.

        `faces` may index another table than the one rasterised (UV corners, say) as long as face k is the same face.
        """
        hit = self.mask
        out = np.zeros((*self.face.shape, values.shape[1]), np.float32)
        out[hit] = np.einsum("nk,nkc->nc", self.bary[hit], values[faces[self.face[hit]]].astype(np.float32))
        return out


def rasterize(
    points: NDArray[np.float64],  # [V, 3] x px, y px, depth m (Camera.project)
    faces: NDArray[np.integer],  # [F, 3]
    height: int,
    width: int,
    backend: str = "auto",
) -> Raster:
    """Rasterise a mesh already projected to the image.

    A pixel belongs to a triangle when its centre (+0.5) lies inside or on the edge; the nearest depth wins, the lower
    face index breaks a tie. Both faces of a triangle are drawn. Triangles that touch the near plane, have no area or
    carry a non-finite corner are dropped. `backend` is "numba", "numpy" or "auto" (numba when importable). Raises
    `ValueError` for other shapes and for faces that name no point.
    """
    check_mesh(points, faces, "z-buffer")
    height, width = whole_pixels(height), whole_pixels(width)
    points = np.ascontiguousarray(points, np.float64)
    faces = np.ascontiguousarray(faces, np.int32)
    if backend == "auto":
        backend = "numba" if _numba_kernel() is not None else "numpy"
    if backend == "numba":
        kernel = _numba_kernel()
        if kernel is None:
            raise ImportError("z-buffer back end 'numba' asked for, but numba cannot be imported")
        face, b1, b2, depth = kernel(points, faces, height, width, NEAR)
    elif backend == "numpy":
        face, b1, b2, depth = _rasterize_numpy(points, faces, height, width, NEAR)
    else:
        raise ValueError(f"z-buffer back end {backend!r}: expected 'auto', 'numba' or 'numpy'")
    bary, hit = np.zeros((height, width, 3), np.float32), face >= 0
    b1, b2 = b1[hit], b2[hit]
    bary[hit] = np.stack([1 - b1 - b2, b1, b2], -1)
    return Raster(face, bary, depth.astype(np.float32))


def check_mesh(points: NDArray, faces: NDArray, where: str) -> None:
    """Raise `ValueError` unless points are [V, 3] numbers and faces [F, 3] whole numbers below V."""
    points, faces = np.asarray(points), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "iuf":
        word = "; a depth belongs to every pixel place (Camera.project)" if points.shape[-1:] == (2,) else ""
        raise ValueError(f"{where}: expected points [V, 3], got {points.dtype} {list(points.shape)}{word}")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(f"{where}: expected faces [F, 3] of whole numbers, got {faces.dtype} {list(faces.shape)}")
    if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
        word = "; OBJ files count from 1: subtract 1" if faces.min() == 1 and faces.max() == len(points) else ""
        raise ValueError(
            f"{where}: expected faces that name points 0 to {len(points) - 1}, "
            f"got {faces.min()} to {faces.max()}{word}"
        )


def vertex_normals(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """[V, 3] unit normals, area-weighted over the faces around each vertex; 0 where there is no area. Raises as
    `rasterize`."""
    check_mesh(vertices, faces, "normals")
    n = triangle_crosses(vertices[faces])
    out = np.zeros_like(vertices, dtype=np.float64)
    for axis in range(3):
        for corner in range(3):
            out[:, axis] += np.bincount(faces[:, corner], n[:, axis], minlength=len(vertices))
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return np.divide(out, length, out=np.zeros_like(out), where=length > 1e-20)


def _rasterize_numpy(P, F, H, W, near, chunk=2_000_000):
    """All candidate pixels of all triangles at once, in chunks; the nearest is written last."""
    T = P[F]
    x, y, z = T[..., 0], T[..., 1], T[..., 2]
    finite = np.isfinite(T).all((1, 2))
    with np.errstate(invalid="ignore"):
        T0 = np.where(finite[:, None, None], T, 0.0)
        xa = np.clip(np.ceil(T0[..., 0].min(1) - 0.5), 0, W).astype(np.int64)
        xb = np.clip(np.floor(T0[..., 0].max(1) - 0.5), -1, W - 1).astype(np.int64)
        ya = np.clip(np.ceil(T0[..., 1].min(1) - 0.5), 0, H).astype(np.int64)
        yb = np.clip(np.floor(T0[..., 1].max(1) - 0.5), -1, H - 1).astype(np.int64)
        area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
        ok = np.flatnonzero(finite & (z.min(1) >= near) & (area != 0) & (xb >= xa) & (yb >= ya))
    w = (xb - xa + 1)[ok]
    n = w * (yb - ya + 1)[ok]
    start = np.concatenate([[0], np.cumsum(n)])
    best_depth = np.full(H * W, np.inf)
    face = np.full(H * W, -1, np.int32)
    b1_out, b2_out = np.zeros(H * W), np.zeros(H * W)
    i = 0
    while i < len(ok):
        j = max(i + 1, int(np.searchsorted(start, start[i] + chunk, "right")) - 1)
        r = np.repeat(np.arange(i, j), n[i:j])
        k = np.arange(start[j] - start[i]) - np.repeat(start[i:j] - start[i], n[i:j])
        f = ok[r]
        row, col = np.divmod(k, w[r])
        px, py = (xa[f] + col) + 0.5, (ya[f] + row) + 0.5
        x0, y0 = x[f, 0], y[f, 0]
        inv_area = 1.0 / area[f]
        w1 = ((px - x0) * (y[f, 2] - y0) - (x[f, 2] - x0) * (py - y0)) * inv_area
        w2 = ((x[f, 1] - x0) * (py - y0) - (px - x0) * (y[f, 1] - y0)) * inv_area
        w0 = 1.0 - w1 - w2
        inside = np.flatnonzero((w0 >= 0) & (w1 >= 0) & (w2 >= 0))
        f, w0, w1, w2 = f[inside], w0[inside], w1[inside], w2[inside]
        pixel = ((ya[f] + row[inside]) * W + xa[f] + col[inside]).astype(np.int64)
        i0, i1, i2 = 1.0 / z[f, 0], 1.0 / z[f, 1], 1.0 / z[f, 2]
        depth = 1.0 / (w0 * i0 + w1 * i1 + w2 * i2)
        nearer = np.flatnonzero(depth < best_depth[pixel])
        # farthest first, higher face first among equals: the last write to a pixel is the winner
        nearer = nearer[np.lexsort((-f[nearer], -depth[nearer]))]
        p = pixel[nearer]
        best_depth[p] = depth[nearer]
        face[p] = f[nearer]
        b1_out[p] = w1[nearer] * i1[nearer] * depth[nearer]
        b2_out[p] = w2[nearer] * i2[nearer] * depth[nearer]
        i = j
    shape = (H, W)
    return face.reshape(shape), b1_out.reshape(shape), b2_out.reshape(shape), best_depth.reshape(shape)


@cache
def _numba_kernel():
    try:
        from numba import njit
    except ImportError:
        return None

    # no fastmath: the same operations in the same order as numpy give the same bits
    @njit(cache=True, nogil=True)
    def rasterize_numba(P, F, H, W, near):
        face = np.full((H, W), -1, np.int32)
        b1_out = np.zeros((H, W))
        b2_out = np.zeros((H, W))
        best = np.full((H, W), np.inf)
        for f in range(F.shape[0]):
            x0, y0, z0 = P[F[f, 0], 0], P[F[f, 0], 1], P[F[f, 0], 2]
            x1, y1, z1 = P[F[f, 1], 0], P[F[f, 1], 1], P[F[f, 1], 2]
            x2, y2, z2 = P[F[f, 2], 0], P[F[f, 2], 1], P[F[f, 2], 2]
            if not (z0 >= near and z1 >= near and z2 >= near):
                continue
            area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
            if not np.isfinite(area + z0 + z1 + z2) or area == 0.0:
                continue
            xa = int(min(max(np.ceil(min(x0, x1, x2) - 0.5), 0), W))
            xb = int(max(min(np.floor(max(x0, x1, x2) - 0.5), W - 1), -1))
            ya = int(min(max(np.ceil(min(y0, y1, y2) - 0.5), 0), H))
            yb = int(max(min(np.floor(max(y0, y1, y2) - 0.5), H - 1), -1))
            inv_area = 1.0 / area
            i0, i1, i2 = 1.0 / z0, 1.0 / z1, 1.0 / z2
            for row in range(ya, yb + 1):
                py = row + 0.5
                for col in range(xa, xb + 1):
                    px = col + 0.5
                    w1 = ((px - x0) * (y2 - y0) - (x2 - x0) * (py - y0)) * inv_area
                    w2 = ((x1 - x0) * (py - y0) - (px - x0) * (y1 - y0)) * inv_area
                    w0 = 1.0 - w1 - w2
                    if w0 < 0 or w1 < 0 or w2 < 0:
                        continue
                    depth = 1.0 / (w0 * i0 + w1 * i1 + w2 * i2)
                    if depth < best[row, col]:
                        best[row, col] = depth
                        face[row, col] = f
                        b1_out[row, col] = w1 * i1 * depth
                        b2_out[row, col] = w2 * i2 * depth
        return face, b1_out, b2_out, best

    return rasterize_numba
