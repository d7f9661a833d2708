"""The surface of the procedural body: a signed distance function of smoothly joined parts, and its triangle mesh.

Used only to build `procedural_body.npz` (see `procedural.py`), with scikit-image. Metres, y up, facing +z, left hand
at +x, T-pose, feet at y = -0.95.

The parts are stacks of superellipses (torso, arms, legs), ellipsoids and round cones (head, hands, feet). The mesh is
made for x >= 0 and mirrored, so the body is exactly symmetric.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SHOULDER_BLEND, HIP_BLEND, NECK_BLEND = 0.045, 0.040, 0.035  # m, how widely two parts flow into each other
SOLE = -0.953  # m, height of the ground under the feet
LEFT, RIGHT = 1, -1


def smooth_union(a: Array, b: Array, blend: float) -> Array:
    """The union of two distance fields whose crease is rounded over `blend` metres (polynomial smooth minimum)."""
    h = np.clip(0.5 + 0.5 * (b - a) / blend, 0, 1)
    return b * (1 - h) + a * h - blend * h * (1 - h)


def smooth_cut(a: Array, b: Array, blend: float) -> Array:
    """The first field without what the second covers, rounded alike."""
    return -smooth_union(-a, b, blend)


def ellipsoid(points: Array, centre: Sequence[float], radii: Sequence[float]) -> Array:
    """First-order distance to an ellipsoid."""
    q = (points - np.asarray(centre)) / np.asarray(radii)
    norm = np.linalg.norm(q, axis=-1)
    slope = np.linalg.norm(q / np.asarray(radii), axis=-1)
    return norm * (norm - 1) / np.maximum(slope, 1e-6)


def round_cone(points: Array, start: Sequence[float], end: Sequence[float], r_start: float, r_end: float) -> Array:
    """Distance to a bar with round ends whose radius changes along it."""
    a, bar = np.asarray(start), np.subtract(end, start)
    h = np.clip((points - a) @ bar / (bar @ bar), 0, 1)
    return np.linalg.norm(points - a - h[..., None] * bar, axis=-1) - (r_start + (r_end - r_start) * h)


def loft(points: Array, axis: int, profile: Sequence[Sequence[float]], exponent: float = 2.0) -> Array:
    """First-order distance to a stack of superellipses along `axis`, cut flat at both ends.

    Rows of `profile`: coordinate along the axis, centre in the two other axes, half extents in the two other axes.
    """
    from scipy.interpolate import PchipInterpolator

    table = np.asarray(profile)
    first, second = (other for other in range(3) if other != axis)
    along = points[..., axis]
    inside = np.clip(along, table[0, 0], table[-1, 0])
    c1, c2, r1, r2 = (PchipInterpolator(table[:, 0], table[:, k])(inside) for k in range(1, 5))
    x, y = (points[..., first] - c1) / r1, (points[..., second] - c2) / r2
    norm = (np.abs(x) ** exponent + np.abs(y) ** exponent + 1e-12) ** (1 / exponent)
    distance = (norm - 1) * norm / np.maximum(np.hypot(x / r1, y / r2), 1e-6)
    beyond = along - inside
    return np.where(beyond != 0, np.hypot(np.maximum(distance, 0), beyond), distance)


# height, centre x and z, half width, half depth
TORSO_PROFILE = (
    (-0.135, 0, -0.010, 0.100, 0.075),
    (-0.090, 0, -0.020, 0.150, 0.105),
    (-0.040, 0, -0.025, 0.165, 0.116),
    (0.020, 0, -0.015, 0.160, 0.110),
    (0.090, 0, 0.000, 0.146, 0.100),
    (0.160, 0, 0.006, 0.140, 0.096),
    (0.240, 0, 0.006, 0.145, 0.100),
    (0.320, 0, 0.004, 0.150, 0.103),
    (0.390, 0, -0.006, 0.144, 0.094),
    (0.440, 0, -0.014, 0.120, 0.078),
    (0.475, 0, -0.018, 0.075, 0.060),
)
# |x| along the left arm, centre y and z, half height, half depth
ARM_PROFILE = (
    (0.100, 0.425, -0.015, 0.044, 0.050),
    (0.160, 0.424, -0.015, 0.052, 0.057),
    (0.200, 0.424, -0.016, 0.054, 0.057),
    (0.260, 0.428, -0.018, 0.052, 0.052),
    (0.330, 0.433, -0.018, 0.049, 0.049),
    (0.400, 0.435, -0.022, 0.043, 0.042),
    (0.445, 0.435, -0.025, 0.041, 0.040),
    (0.500, 0.435, -0.022, 0.045, 0.044),
    (0.560, 0.435, -0.020, 0.041, 0.040),
    (0.630, 0.435, -0.015, 0.033, 0.032),
    (0.690, 0.435, -0.010, 0.025, 0.029),
    (0.720, 0.434, -0.008, 0.021, 0.031),
    (0.750, 0.433, -0.006, 0.017, 0.032),
    (0.785, 0.433, -0.005, 0.010, 0.024),
)
# height, centre |x| and z, half width, half depth
LEG_PROFILE = (
    (-0.905, 0.110, -0.034, 0.036, 0.042),
    (-0.870, 0.110, -0.030, 0.036, 0.042),
    (-0.820, 0.110, -0.030, 0.037, 0.043),
    (-0.740, 0.110, -0.035, 0.045, 0.052),
    (-0.640, 0.108, -0.034, 0.055, 0.062),
    (-0.560, 0.106, -0.020, 0.054, 0.058),
    (-0.500, 0.105, -0.006, 0.050, 0.053),
    (-0.460, 0.105, 0.003, 0.051, 0.056),
    (-0.400, 0.104, 0.004, 0.058, 0.064),
    (-0.300, 0.100, 0.004, 0.070, 0.078),
    (-0.200, 0.096, 0.000, 0.080, 0.088),
    (-0.100, 0.092, -0.005, 0.084, 0.093),
    (-0.040, 0.088, -0.012, 0.074, 0.085),
    (0.030, 0.080, -0.014, 0.045, 0.055),
)
# across the palm, length from the knuckles, radius at the knuckle and at the tip; side by side so that no gap opens
# between two fingers, which would turn the hand into a handle or fold the texture
FINGERS = (
    (0.0285, 0.066, 0.0118, 0.0102),
    (0.0095, 0.075, 0.0120, 0.0104),
    (-0.0095, 0.071, 0.0118, 0.0102),
    (-0.0280, 0.057, 0.0110, 0.0096),
)


def ellipsoids(points: Array, centre: tuple[float, float, float], radii: Sequence[float], blend: float) -> Array:
    """An ellipsoid and its mirror image as one field: adding one after the other to a body would not be symmetric."""
    x, y, z = centre
    return smooth_union(ellipsoid(points, (x, y, z), radii), ellipsoid(points, (-x, y, z), radii), blend)


def torso(points: Array) -> Array:
    d = loft(points, 1, TORSO_PROFILE, exponent=2.35)
    chest = ellipsoids(points, (0.068, 0.335, 0.066), (0.070, 0.052, 0.034), 0.055)
    buttocks = ellipsoids(points, (0.085, -0.085, -0.075), (0.085, 0.090, 0.075), 0.05)
    shoulder_blades = ellipsoids(points, (0.082, 0.370, -0.060), (0.078, 0.090, 0.046), 0.05)
    d = smooth_union(smooth_union(smooth_union(d, chest, 0.055), buttocks, 0.05), shoulder_blades, 0.05)
    left, right = (
        round_cone(points, (s * 0.02, 0.485, -0.03), (s * 0.165, 0.433, -0.02), 0.045, 0.046) for s in (LEFT, RIGHT)
    )
    return smooth_union(d, smooth_union(left, right, 0.05), 0.05)  # trapezius


def head(points: Array) -> Array:
    d = round_cone(points, (0, 0.44, -0.022), (0, 0.60, 0), 0.058, 0.052)  # neck
    d = smooth_union(d, ellipsoid(points, (0, 0.708, -0.010), (0.075, 0.092, 0.100)), 0.03)  # skull
    d = smooth_union(d, ellipsoid(points, (0, 0.648, 0.034), (0.054, 0.072, 0.060)), 0.035)  # face and jaw
    d = smooth_union(d, ellipsoid(points, (0, 0.602, 0.066), (0.024, 0.018, 0.020)), 0.028)  # chin
    d = smooth_union(d, round_cone(points, (0, 0.692, 0.086), (0, 0.655, 0.106), 0.008, 0.0105), 0.014)  # nose
    d = smooth_union(d, ellipsoid(points, (0, 0.627, 0.086), (0.024, 0.009, 0.012)), 0.010)  # lips
    d = smooth_union(d, ellipsoid(points, (0, 0.700, 0.078), (0.050, 0.012, 0.014)), 0.020)  # brow
    d = smooth_union(d, ellipsoids(points, (0.075, 0.672, -0.008), (0.010, 0.028, 0.017), 0.010), 0.010)  # ears
    return smooth_cut(d, ellipsoids(points, (0.031, 0.686, 0.096), (0.016, 0.009, 0.012), 0.014), 0.014)  # sockets


def arm(points: Array, side: int) -> Array:
    q = points * [side, 1, 1]
    hand = ellipsoid(q, (0.745, 0.433, -0.005), (0.056, 0.017, 0.041))  # palm
    for z, length, knuckle, tip in FINGERS:
        finger = round_cone(q, (0.770, 0.433, z), (0.785 + length, 0.429, z), knuckle, tip)
        hand = smooth_union(hand, finger, 0.010)
    hand = smooth_union(
        hand, round_cone(q, (0.725, 0.428, 0.028), (0.790, 0.420, 0.066), 0.014, 0.0115), 0.014
    )  # thumb
    return smooth_union(loft(q, 0, ARM_PROFILE), hand, 0.02)


def leg(points: Array, side: int) -> Array:
    q = points * [side, 1, 1]
    foot = smooth_union(
        round_cone(q, (0.112, -0.915, -0.045), (0.122, -0.930, 0.100), 0.036, 0.026),
        ellipsoid(q, (0.124, -0.932, 0.112), (0.043, 0.021, 0.058)),
        0.03,
    )
    foot = smooth_union(foot, ellipsoid(q, (0.111, -0.920, -0.060), (0.033, 0.036, 0.035)), 0.03)  # heel
    d = smooth_union(loft(q, 1, LEG_PROFILE), foot, 0.035)
    return smooth_cut(d, points[..., 1] - SOLE, 0.008)


def signed_distance(points: Array) -> Array:
    """[..., 3] m -> [...] m to the body's surface, negative inside; exact on the surface, first-order near it."""
    d = smooth_union(torso(points), head(points), NECK_BLEND)
    d = smooth_union(d, np.minimum(arm(points, LEFT), arm(points, RIGHT)), SHOULDER_BLEND)
    return smooth_union(d, np.minimum(leg(points, LEFT), leg(points, RIGHT)), HIP_BLEND)


def normals(points: Array, step: float = 1e-4) -> tuple[Array, Array]:
    """[N, 3] gradient of the distance by central differences, and the same at length 1."""
    offsets = step * np.eye(3)
    gradient = np.stack(
        [(signed_distance(points + o) - signed_distance(points - o)) / (2 * step) for o in offsets], -1
    )
    return gradient, gradient / np.linalg.norm(gradient, axis=-1, keepdims=True)


def build_mesh(coarseness: float = 1.0) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """The closed mesh: vertices [V, 3] m, faces [F, 3] seen counter-clockwise from outside, and mirror [V], the index
    of each vertex's mirror image (itself on the plane x = 0). `coarseness` scales every edge length.
    """
    vertices, faces = _marching_cubes(coarseness)
    vertices, faces = _collapse_short_edges(vertices, faces, coarseness)
    vertices = _relax(vertices, faces)
    return _mirror(vertices, faces)


def _grid_line(knots: Sequence[float], steps: Sequence[float], coarseness: float) -> Array:
    """Coordinates from the first knot past the last whose spacing follows `steps` at the knots."""
    line = [knots[0]]
    while line[-1] < knots[-1]:
        line.append(line[-1] + coarseness * float(np.interp(line[-1], knots, steps)))
    return np.array(line)


def _marching_cubes(coarseness: float) -> tuple[Array, NDArray[np.int64]]:
    """The half x >= 0 of the surface, open at x = 0, on a grid that is fine at the hands and the head."""
    from skimage.measure import marching_cubes

    grid = (
        _grid_line((0, 0.62, 0.70, 0.90), (0.016, 0.016, 0.0056, 0.0056), coarseness),
        _grid_line(
            (-0.98, -0.80, 0.38, 0.42, 0.46, 0.56, 0.62, 0.72, 0.84),
            (0.012, 0.020, 0.020, 0.0058, 0.0058, 0.016, 0.010, 0.010, 0.014),
            coarseness,
        ),
        _grid_line((-0.20, -0.06, 0.06, 0.20), (0.017, 0.008, 0.008, 0.012), coarseness),
    )
    distance = signed_distance(np.stack(np.meshgrid(*grid, indexing="ij"), -1))
    index, faces, _, _ = marching_cubes(distance, 0.0)
    vertices = np.stack([np.interp(index[:, a], np.arange(len(grid[a])), grid[a]) for a in range(3)], 1)
    return vertices, faces.astype(np.int64)


def _shortest_edge(points: Array) -> Array:
    """[N] m: below this an edge is merged; smaller at the hands and the head."""
    at_hand = np.interp(points[:, 0], (0.62, 0.72), (0, 1))
    at_head = np.interp(points[:, 1], (0.54, 0.60), (0, 1))
    return 0.0082 - 0.0058 * at_hand - 0.0034 * at_head


def _collapse_short_edges(
    vertices: Array, faces: NDArray[np.int64], coarseness: float
) -> tuple[Array, NDArray[np.int64]]:
    """Merge the ends of edges much shorter than the grid, which marching cubes leaves behind, where that keeps the
    surface a manifold and its rim on x = 0."""
    while True:
        edges = _edges(faces)
        length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
        shortest = coarseness * _shortest_edge(vertices[edges[:, 0]])
        short = edges[np.argsort(length, kind="stable")]
        short = short[: int((length < shortest).sum())]
        neighbours: list[set[int]] = [set() for _ in vertices]
        for a, b in edges.tolist():
            neighbours[a].add(b)
            neighbours[b].add(a)
        on_rim = vertices[:, 0] == 0
        touched = np.zeros(len(vertices), bool)
        target = np.arange(len(vertices))
        for a, b in short.tolist():
            ring = list(neighbours[a] | neighbours[b])
            along_rim = on_rim[a] and on_rim[b]
            # link condition: the two ends share exactly the tips of the triangles at the edge
            if touched[ring].any() or len(neighbours[a] & neighbours[b]) != (1 if along_rim else 2):
                continue
            keep, drop = (b, a) if on_rim[b] else (a, b)
            # an inner edge between two vertices of the rim would coincide with its mirror image
            if (
                any(on_rim[n] for n in neighbours[drop] - neighbours[keep] - {keep})
                and not along_rim
                and on_rim[keep]
            ):
                continue
            if on_rim[keep] == on_rim[drop]:
                vertices[keep] = (vertices[a] + vertices[b]) / 2
            target[drop] = keep
            touched[ring] = True
        if not touched.any():
            return vertices, faces
        faces = target[faces]
        kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        used, faces = np.unique(faces[kept], return_inverse=True)
        faces, vertices = faces.reshape(-1, 3), vertices[used]


def _edges(faces: NDArray[np.integer]) -> NDArray[np.integer]:
    """[E, 2] every edge once."""
    return np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1), axis=0)


def _relax(vertices: Array, faces: NDArray[np.int64], rounds: int = 10) -> Array:
    """Even out the triangles: move every vertex half way to the mean of its neighbours along the surface, then back
    onto the surface with Newton steps."""
    edges = _edges(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(vertices))[:, None]
    on_rim = vertices[:, 0] == 0
    for round_ in range(rounds):
        mean = np.zeros_like(vertices)
        np.add.at(mean, both[:, 0], vertices[both[:, 1]])
        _, normal = normals(vertices)
        step = mean / degree - vertices
        step -= (step * normal).sum(1, keepdims=True) * normal
        vertices = vertices + 0.5 * step
        for _ in range(2 if round_ < rounds - 1 else 6):
            gradient, _ = normals(vertices)
            error = np.clip(signed_distance(vertices), -0.01, 0.01)[:, None]
            vertices = vertices - error * gradient / np.maximum((gradient**2).sum(1, keepdims=True), 0.05)
            vertices[on_rim, 0] = 0
    return vertices


def _mirror(half: Array, half_faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """Close the half mesh with its mirror image at x = 0."""
    off_rim = np.flatnonzero(half[:, 0] != 0)
    image = np.arange(len(half))
    image[off_rim] = len(half) + np.arange(len(off_rim))
    vertices = np.concatenate([half, half[off_rim] * [-1, 1, 1]])
    faces = np.concatenate([half_faces, image[half_faces][:, ::-1]])
    mirror = np.concatenate([image, off_rim])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if np.einsum("fi,fi->", a, np.cross(b, c)) < 0:  # six times the enclosed volume
        faces = faces[:, ::-1]
    return vertices, faces.astype(np.int32), mirror.astype(np.int32)
