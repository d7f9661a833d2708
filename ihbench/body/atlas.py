"""Texture coordinates for any SMPL-shaped body that comes without: six cylinder charts, one per body part.

Each part (torso, head, two arms, two legs) is unrolled about a line through its bones: u from the angle about the
line, v from the length along it, both re-spaced so that texels cover about the same area everywhere. No chart is
mirrored.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ihbench.render.triangles import triangle_areas

Array = NDArray[np.float64]


class Part(NamedTuple):
    """One chart: which joints' skin it takes and where it lies in the unit square."""

    joints: tuple[int, ...]
    rectangle: tuple[float, float, float, float]  # u0, v0, u1, v1; sizes follow the surface area of the part
    limb: bool  # a limb's line runs away from the torso: its chart is turned so that the torso end is on top


PARTS = (
    Part((0, 3, 6, 9, 13, 14), (0.01, 0.01, 0.49, 0.55), limb=False),
    Part((12, 15), (0.01, 0.57, 0.49, 0.99), limb=False),
    Part((16, 18, 20, 22), (0.51, 0.51, 0.74, 0.99), limb=True),
    Part((17, 19, 21, 23), (0.76, 0.51, 0.99, 0.99), limb=True),
    Part((1, 4, 7, 10), (0.51, 0.01, 0.74, 0.49), limb=True),
    Part((2, 5, 8, 11), (0.76, 0.01, 0.99, 0.49), limb=True),
)
ANGLE_BINS, LENGTH_BINS = 64, 48
LENGTH_ROUNDS, ANGLE_ROUNDS = 8, 2  # of smoothing
POLE = 0.8  # a corner whose neighbours' directions cancel to this fraction of the others' sits at the tip of a part


def part_atlas(
    vertices: Array,  # [V, 3] m, T-pose
    faces: NDArray[np.integer],  # [F, 3]
    weights: Array,  # [V, 24]
    joints: Array,  # [24, 3] m
) -> tuple[Array, NDArray[np.int32], NDArray[np.int32]]:
    """uv [Vt, 2] in [0, 1], uv_faces [F, 3] into it, and the chart [F] of each face (index into `PARTS`)."""
    chart = _part_of_faces(faces, weights)
    uv_tables: list[Array] = []
    uv_faces = np.zeros(faces.shape, np.int32)
    used = 0
    for number, part in enumerate(PARTS):
        mine = np.flatnonzero(chart == number)
        if len(mine) == 0:
            continue
        line, front = _axis(number, joints, vertices[:, 1].max())
        uv, corners = _unroll(vertices, faces[mine], line, front)
        if part.limb:
            uv = 1 - uv
        low, high = np.array(part.rectangle[:2]), np.array(part.rectangle[2:])
        uv_tables.append(low + uv * (high - low))
        uv_faces[mine] = corners + used
        used += len(uv)
    return np.concatenate(uv_tables), uv_faces, chart


def _part_of_faces(faces: NDArray[np.integer], weights: Array) -> NDArray[np.int32]:
    """[F] the part that moves each face most, with borders straightened by four rounds of majority vote."""
    share = np.stack([weights[:, part.joints].sum(1) for part in PARTS], 1)
    label = share[faces].mean(1).argmax(1)
    for _ in range(4):
        around_vertex = np.zeros((len(weights), len(PARTS)))
        np.add.at(around_vertex, faces.ravel(), np.eye(len(PARTS))[np.repeat(label, 3)])
        label = around_vertex[faces].sum(1).argmax(1)
    return label.astype(np.int32)


def _axis(part: int, J: Array, top: float) -> tuple[Array, Array]:
    """The line [n, 3] a part is unrolled about, and the direction [3] of angle 0; the seam is opposite to it."""
    if part == 0:
        return np.array([J[0] - [0, 0.30, 0], J[0], J[6], J[9], J[12]]), np.array([0.0, 0, 1])
    if part == 1:
        return np.array([J[12] - [0, 0.10, 0], J[12], J[15], [0, top + 0.05, J[15, 2] - 0.01]]), np.array([0.0, 0, 1])
    right = (part - 2) % 2  # joint numbers of the right side are one higher
    side = 1 - 2 * right
    if part < 4:  # arm: angle 0 on top, seam below
        shoulder, elbow, wrist, hand = J[16 + right], J[18 + right], J[20 + right], J[22 + right]
        out = np.array([side, 0.0, 0.0])
        return np.array([shoulder - 0.2 * out, shoulder, elbow, wrist, hand, hand + 0.25 * out]), np.array(
            [0.0, 1, 0]
        )
    hip, knee, ankle, foot = J[1 + right], J[4 + right], J[7 + right], J[10 + right]  # angle 0 outside and in front
    above_hip, heel = hip + np.array([0, 0.2, 0]), ankle + np.array([0, -0.03, 0.03])
    sole, beyond_toes = foot + np.array([0, -0.005, 0]), foot + np.array([0, 0, 0.2])
    return np.array([above_hip, hip, knee, ankle, heel, sole, beyond_toes]), np.array([0.8 * side, 0.0, 0.6])


def _unroll(
    vertices: Array, faces: NDArray[np.integer], line: Array, front: Array
) -> tuple[Array, NDArray[np.int64]]:
    """uv [n, 2] in [0, 1] and the corners [F, 3] of one chart; vertices on the seam get two uv entries."""
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    points = vertices[used]
    direction, length, radius = _cylinder_coordinates(points, line, front)
    # where the line bends, every point of a wedge is nearest to the corner: without smoothing the heel has no length
    length = _smoothed(length[:, None], faces, LENGTH_ROUNDS)[faces, 0]
    direction = _smoothed(direction, faces, ANGLE_ROUNDS)[faces]  # [F, 3, 2] cosine and sine, shorter at the poles
    face_direction = direction.mean(1)
    face_angle = np.arctan2(face_direction[:, 1], face_direction[:, 0])
    angle = np.arctan2(direction[..., 1], direction[..., 0])
    angle -= 2 * np.pi * np.round((angle - face_angle[:, None]) / (2 * np.pi))  # keep a face on one side of the seam
    strength = np.linalg.norm(direction, axis=-1)
    at_pole = strength < POLE * strength.max(1, keepdims=True)
    angle = np.where(at_pole, face_angle[:, None], angle)  # at the tip of a part a vertex has no angle of its own
    key = np.column_stack([faces.ravel(), np.round(angle.ravel(), 5)])
    _, first, corners = np.unique(key, axis=0, return_index=True, return_inverse=True)
    area = triangle_areas(points[faces])
    u = np.interp(angle.ravel()[first], *_by_area(angle, face_angle, area))
    v = np.interp(length.ravel()[first], *_by_area_over_radius(length, length.mean(1), radius[faces].mean(1), area))
    return np.column_stack([u, v]), corners.reshape(-1, 3)


def _smoothed(values: Array, faces: NDArray[np.integer], rounds: int) -> Array:
    """[n, k] values at vertices, averaged with their neighbours' mean so many times."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
    degree = np.bincount(edges[:, 0])
    for _ in range(rounds):
        gathered = [np.bincount(edges[:, 0], column[edges[:, 1]]) / degree for column in values.T]
        values = (values + np.stack(gathered, 1)) / 2
    return values


def _cylinder_coordinates(points: Array, line: Array, front: Array) -> tuple[Array, Array, Array]:
    """Cosine and sine [N, 2] of the angle about the nearest segment of a line, arc length [N] m along the line and
    distance [N] m to it."""
    distance = np.full(len(points), np.inf)
    direction, length = np.zeros((len(points), 2)), np.zeros(len(points))
    before = 0.0
    for start, end in pairwise(line):
        span = float(np.linalg.norm(end - start))
        along = (end - start) / span
        h = np.clip((points - start) @ along, 0, span)
        radial = points - start - h[:, None] * along
        here = np.linalg.norm(radial, axis=1)
        nearer = here < distance
        x = front - (front @ along) * along
        x /= np.linalg.norm(x)
        y = np.cross(along, x)
        distance[nearer] = here[nearer]
        length[nearer] = before + h[nearer]
        across = np.column_stack([radial @ x, radial @ y])
        direction[nearer] = (across / np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None])[nearer]
        before += span
    return direction, length, distance


def _by_area(angle: Array, face_angle: Array, area: Array) -> tuple[Array, Array]:
    """Knots that map the angle to [0, 1] mostly in proportion to the area found there."""
    edges = np.linspace(angle.min(), angle.max(), ANGLE_BINS + 1)
    density = np.histogram(face_angle, edges, weights=area)[0]
    return edges, _cumulative(0.7 * density + 0.3 * density.mean())


def _by_area_over_radius(length: Array, face_length: Array, radius: Array, area: Array) -> tuple[Array, Array]:
    """Knots that map the length to [0, 1] by area over the root of the girth: thin stretches are not squeezed, and
    end caps, which are all area and no length, get their room."""
    edges = np.linspace(length.min(), length.max(), LENGTH_BINS + 1)
    density = np.histogram(face_length, edges, weights=area)[0]
    moment = np.histogram(face_length, edges, weights=area * radius)[0]
    mean_radius = moment / np.maximum(density, 1e-9)
    floor = 0.3 * moment.sum() / density.sum()
    density = density / np.sqrt(np.maximum(mean_radius, floor))
    density = np.convolve(np.pad(density, 2, "edge"), np.ones(5) / 5, "valid")
    return edges, _cumulative(0.85 * density + 0.15 * density.mean())


def _cumulative(density: Array) -> Array:
    return np.concatenate([[0], np.cumsum(density)]) / density.sum()
