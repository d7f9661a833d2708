"""General Gaussians from the world to footprints and back, for the renderer on the CPU: `splat_projection` as loops.

One loop over the Gaussians with everything in registers, float64, where torch writes and reads a tensor for each of
some forty steps and as many back. With D the derivative of the projection at the centre (rows D_0, D_1; see
`project_ellipses`), F the gradient of the footprint D Σ Dᵀ as a symmetric matrix, and B = D Q S for axes Q and
standard deviations S:

    dL/dΣ = Dᵀ F D,   dL/dD = 2 F D Σ,   dL/dB = 2 F B,   dL/dQ = Dᵀ dL/dB S,   dL/dS = diag (D Q)ᵀ dL/dB.

Each Gaussian is computed alike whatever part it is in, so that the number of threads changes nothing.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from ihbench.render.splat_ellipses import ELLIPSE_COLOR, ellipse_record, ellipse_sums
from ihbench.render.splat_tiles import f32, fetch_slots, u64

SHORTEST = 1e-12  # a quaternion shorter than this is divided by it, as torch's normalize does
ZERO = f32(0)
_FAST = {"contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _derivative(means, i, K, R, t, A, low, high):
    """Camera-space direction (x, y) and depth of centre i, whether the direction is inside the clamp (per axis), and
    the rows D_0, D_1 of the derivative of its pixel along the world. A is K R."""
    X, Y, Z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
    z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
    inverse = 1.0 / z
    x = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) * inverse
    y = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) * inverse
    clamped_x, clamped_y = min(max(x, low[0]), high[0]), min(max(y, low[1]), high[1])
    u = K[0, 0] * clamped_x + K[0, 1] * clamped_y + K[0, 2]
    v = K[1, 1] * clamped_y + K[1, 2]
    d0 = (A[0, 0] - u * R[2, 0]) * inverse, (A[0, 1] - u * R[2, 1]) * inverse, (A[0, 2] - u * R[2, 2]) * inverse
    d1 = (A[1, 0] - v * R[2, 0]) * inverse, (A[1, 1] - v * R[2, 1]) * inverse, (A[1, 2] - v * R[2, 2]) * inverse
    return x, y, z, clamped_x == x, clamped_y == y, d0, d1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _axes(turns, i):
    """Quaternion i (w, x, y, z) made a unit one, its length, and the columns of its rotation: the Gaussian's axes."""
    w, x, y, z = np.float64(turns[i, 0]), np.float64(turns[i, 1]), np.float64(turns[i, 2]), np.float64(turns[i, 3])
    length = math.sqrt(w * w + x * x + y * y + z * z)
    inverse = 1.0 / max(length, SHORTEST)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    axis_x = 1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)
    axis_y = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)
    axis_z = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    return (w, x, y, z), length, axis_x, axis_y, axis_z


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _blend(p, a, q, b):
    return p * a[0] + q * b[0], p * a[1] + q * b[1], p * a[2] + q * b[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST, forceinline=True)
def _times(shapes, i, d):
    """The symmetric half of the covariance in row i of `shapes` [N, 9], times d."""
    xx, yy, zz = np.float64(shapes[i, 0]), np.float64(shapes[i, 4]), np.float64(shapes[i, 8])
    xy, xz = (np.float64(shapes[i, 1]) + shapes[i, 3]) / 2, (np.float64(shapes[i, 2]) + shapes[i, 6]) / 2
    yz = (np.float64(shapes[i, 5]) + shapes[i, 7]) / 2
    return (
        xx * d[0] + xy * d[1] + xz * d[2],
        xy * d[0] + yy * d[1] + yz * d[2],
        xz * d[0] + yz * d[1] + zz * d[2],
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def project_gaussians(
    means, shapes, turns, opacity, colors, K, R, t, A, low, high, low_pass, near, alpha_min, height, width,
    records, depth, radius, part, parts,
):  # fmt: skip
    """World Gaussians -> one part of `records` [N, ELLIPSE], depth [N] float32, and the radius where asked for, [N].

    `shapes` is [N, 1] standard deviations of spheres, [N, 3] along the axes that `turns` [N, 4] turn to, or [N, 9]
    covariances. A depth of 0 marks what is not drawn: what is out of sight, behind the near plane, not finite in
    float32, or no ellipse.
    """
    n, kind = len(means), shapes.shape[1]
    for i in range(n * part // parts, n * (part + 1) // parts):
        x, y, z, _, _, d0, d1 = _derivative(means, i, K, R, t, A, low, high)
        if kind == 1:
            s = np.float64(shapes[i, 0]) ** 2
            xx, both, yy = s * _dot(d0, d0), s * _dot(d0, d1), s * _dot(d1, d1)
        elif kind == 3:
            _, _, axis_x, axis_y, axis_z = _axes(turns, i)
            sx, sy, sz = np.float64(shapes[i, 0]), np.float64(shapes[i, 1]), np.float64(shapes[i, 2])
            b0 = _dot(d0, axis_x) * sx, _dot(d0, axis_y) * sy, _dot(d0, axis_z) * sz
            b1 = _dot(d1, axis_x) * sx, _dot(d1, axis_y) * sy, _dot(d1, axis_z) * sz
            xx, both, yy = _dot(b0, b0), _dot(b0, b1), _dot(b1, b1)
        else:
            e0, e1 = _times(shapes, i, d0), _times(shapes, i, d1)
            xx, both, yy = _dot(d0, e0), _dot(d0, e1), _dot(d1, e1)
        xx, yy = xx + low_pass, yy + low_pass
        u, v = K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]
        distance = f32(z)
        bad = f32(opacity[i]) * ZERO + f32(u) * ZERO + f32(v) * ZERO + distance * ZERO  # NaN where one is not finite
        bad += f32(xx) * ZERO + f32(both) * ZERO + f32(yy) * ZERO
        for c in range(colors.shape[1]):
            bad += colors[i, c] * ZERO
        depth[i] = ZERO
        if bad == ZERO and distance > near:
            o = np.float64(opacity[i])
            if ellipse_record(records[i], u, v, xx, both, yy, o, alpha_min, height, width):
                depth[i] = distance
                if len(radius):
                    radius[i] = _radius(u, v, xx, both, yy, o, alpha_min, height, width)
            for c in range(min(colors.shape[1], 3)):
                records[i, ELLIPSE_COLOR + c] = colors[i, c]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def _radius(x, y, xx, both, yy, opacity, alpha_min, height, width):
    """`splat_projection.radii` for one ellipse."""
    cut = 2 * math.log(opacity / alpha_min)
    beside_x, beside_y = max(0.5 - x, x - (width - 0.5), 0.0), max(0.5 - y, y - (height - 0.5), 0.0)
    if beside_x * beside_x > xx * cut or beside_y * beside_y > yy * cut:
        return 0.0
    half = (xx - yy) / 2
    return math.sqrt(cut * ((xx + yy) / 2 + math.sqrt(half * half + both * both)))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
def gaussian_gradients(
    slots, rank_of, slot_start, packed, means, shapes, turns, opacity, K, R, t, A, low, high, first, last,
    grad_means, grad_shapes, grad_turns, grad_opacity, grad_colors, grad_xy, part, parts,
):  # fmt: skip
    """Slots -> one part of the gradient of colors [N, C] from channel `first` on, and with `last` of all else, for
    which the slots have been added up over all channels; of the centres [N, 2] px where grad_xy is not empty.

    What is not drawn keeps the gradient that it has.
    """
    n, kind, channels = len(means), shapes.shape[1], min(grad_colors.shape[1] - first, 3)
    for i in range(n * part // parts, n * (part + 1) // parts):
        fetch_slots(slots, rank_of, slot_start, packed, i)
        if rank_of[i] < 0:
            continue
        rank = u64(rank_of[i])
        center, covariance, s0, color = ellipse_sums(slots, slot_start[rank], slot_start[rank + u64(1)], packed[rank])
        for c in range(channels):
            grad_colors[i, first + c] = color[c]
        gu, gv = center
        gxx, half, gyy = covariance[0], covariance[1] / 2, covariance[2]
        if not last or (gu == 0 and gv == 0 and gxx == 0 and half == 0 and gyy == 0 and s0 == 0):
            continue  # the second: hidden
        if len(grad_xy):
            grad_xy[i, 0], grad_xy[i, 1] = center
        grad_opacity[i] = s0 / opacity[i]
        x, y, z, inside_x, inside_y, d0, d1 = _derivative(means, i, K, R, t, A, low, high)
        if kind == 1:
            s = np.float64(shapes[i, 0])
            f0, f1 = _blend(gxx, d0, half, d1), _blend(half, d0, gyy, d1)
            grad_shapes[i, 0] = 2 * s * (_dot(f0, d0) + _dot(f1, d1))
            g0, g1 = _blend(2 * s * s, f0, 0.0, f0), _blend(2 * s * s, f1, 0.0, f1)
        elif kind == 3:
            (qw, qx, qy, qz), length, axis_x, axis_y, axis_z = _axes(turns, i)
            sx, sy, sz = np.float64(shapes[i, 0]), np.float64(shapes[i, 1]), np.float64(shapes[i, 2])
            a0 = _dot(d0, axis_x), _dot(d0, axis_y), _dot(d0, axis_z)
            a1 = _dot(d1, axis_x), _dot(d1, axis_y), _dot(d1, axis_z)
            b0, b1 = (a0[0] * sx, a0[1] * sy, a0[2] * sz), (a1[0] * sx, a1[1] * sy, a1[2] * sz)
            f0, f1 = _blend(2 * gxx, b0, 2 * half, b1), _blend(2 * half, b0, 2 * gyy, b1)
            grad_shapes[i, 0] = f0[0] * a0[0] + f1[0] * a1[0]
            grad_shapes[i, 1] = f0[1] * a0[1] + f1[1] * a1[1]
            grad_shapes[i, 2] = f0[2] * a0[2] + f1[2] * a1[2]
            f0, f1 = (f0[0] * sx, f0[1] * sy, f0[2] * sz), (f1[0] * sx, f1[1] * sy, f1[2] * sz)
            g0 = (
                f0[0] * axis_x[0] + f0[1] * axis_y[0] + f0[2] * axis_z[0],
                f0[0] * axis_x[1] + f0[1] * axis_y[1] + f0[2] * axis_z[1],
                f0[0] * axis_x[2] + f0[1] * axis_y[2] + f0[2] * axis_z[2],
            )
            g1 = (
                f1[0] * axis_x[0] + f1[1] * axis_y[0] + f1[2] * axis_z[0],
                f1[0] * axis_x[1] + f1[1] * axis_y[1] + f1[2] * axis_z[1],
                f1[0] * axis_x[2] + f1[1] * axis_y[2] + f1[2] * axis_z[2],
            )
            # along the columns of the rotation
            p, q, r = (
                _blend(f0[0], d0, f1[0], d1),
                _blend(f0[1], d0, f1[1], d1),
                _blend(f0[2], d0, f1[2], d1),
            )
            gw = 2 * (qz * (p[1] - q[0]) + qy * (r[0] - p[2]) + qx * (q[2] - r[1]))
            gx = 2 * (qy * (p[1] + q[0]) + qz * (p[2] + r[0]) + qw * (q[2] - r[1]) - 2 * qx * (q[1] + r[2]))
            gy = 2 * (qx * (p[1] + q[0]) + qz * (q[2] + r[1]) + qw * (r[0] - p[2]) - 2 * qy * (p[0] + r[2]))
            gz = 2 * (qx * (p[2] + r[0]) + qy * (q[2] + r[1]) + qw * (p[1] - q[0]) - 2 * qz * (p[0] + q[1]))
            along = qw * gw + qx * gx + qy * gy + qz * gz if length > SHORTEST else 0.0
            inverse = 1.0 / max(length, SHORTEST)
            grad_turns[i, 0], grad_turns[i, 1] = (gw - qw * along) * inverse, (gx - qx * along) * inverse
            grad_turns[i, 2], grad_turns[i, 3] = (gy - qy * along) * inverse, (gz - qz * along) * inverse
        else:
            e0, e1 = _times(shapes, i, d0), _times(shapes, i, d1)
            f0, f1 = _blend(gxx, d0, half, d1), _blend(half, d0, gyy, d1)
            for j in range(3):
                for k in range(3):
                    grad_shapes[i, 3 * j + k] = d0[j] * f0[k] + d1[j] * f1[k]
            g0, g1 = _blend(2 * gxx, e0, 2 * half, e1), _blend(2 * half, e0, 2 * gyy, e1)
        # from the derivative D = (A - (u, v) R_2) / z to the direction (x, y), whose clamped axes pull nothing
        inverse = 1.0 / z
        down = R[2, 0], R[2, 1], R[2, 2]
        pull_u, pull_v = -_dot(g0, down) * inverse, -_dot(g1, down) * inverse
        pull_x = K[0, 0] * gu + inside_x * (K[0, 0] * pull_u)
        pull_y = K[0, 1] * gu + K[1, 1] * gv + inside_y * (K[0, 1] * pull_u + K[1, 1] * pull_v)
        pull_z = -(pull_x * x + pull_y * y + _dot(g0, d0) + _dot(g1, d1)) * inverse
        pull_x, pull_y = pull_x * inverse, pull_y * inverse
        for c in range(3):
            grad_means[i, c] = R[0, c] * pull_x + R[1, c] * pull_y + R[2, c] * pull_z
