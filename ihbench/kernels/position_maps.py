"""Position maps of the posed body: the cached table, the table anew, and the float64 twin that asks every face."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body, load_body, position_map, texel_table
from ihbench.body.pose import BodyPose
from ihbench.kernels.measuring import Row, interleave, peak_mib, row_of, timed

POSITION_CASES = (64, 128, 256)  # texels, side of the map
TWIN_UP_TO = 32  # texels a side that the twin looks at; of a finer map every n-th
TWIN = "every face f64, extrapolated"
INSIDE = 1e-9  # barycentric coordinate below which a texel centre lies outside a face


def position_map_rows(repeats: int, cases: Sequence[int] = POSITION_CASES) -> list[Row]:
    """Value error: the largest distance in m between where a texel is and where the twin says it is, on texels that
    both have; infinite where one has a texel inside a chart that the other lacks. The time of the twin is
    extrapolated from the texels that it looked at.
    """
    body = load_body()
    pose = BodyPose(np.random.default_rng(0).normal(0, 0.3, (24, 3)), np.zeros(10), np.zeros(3))
    vertices = body.pose(pose)
    rows = []
    for resolution in cases:
        step = max(1, resolution // TWIN_UP_TO)
        steps: dict[str, Callable[[], Any]] = {
            "cached table f32": partial(position_map, vertices, body, resolution),
            "table anew f64": partial(_anew, vertices, body, resolution),
        }
        cached, mask = steps["cached table f32"]()
        anew = np.zeros((resolution, resolution, 3))
        anew.reshape(-1, 3)[texel_table(body, resolution).index] = steps["table anew f64"]()
        start = time.perf_counter()
        exact, inside = brute_force_map(vertices, body, resolution, step)
        twin_ms = (time.perf_counter() - start) * 1e3 * step**2
        common = mask[::step, ::step] & inside
        same = bool((mask[::step, ::step] == inside).all())
        timings = interleave({name: partial(timed, f) for name, f in steps.items()}, repeats)
        timings[TWIN] = [(twin_ms, None)]
        for (name, samples), positions in zip(timings.items(), (cached, anew, None), strict=True):
            error, memory = 0.0, None
            if positions is not None:
                off = positions[::step, ::step][common] - exact[common]
                error, memory = float(np.linalg.norm(off, axis=-1).max(initial=0.0)), peak_mib(steps[name])
            error = error if same else float("inf")
            rows.append(row_of("position-map", f"{resolution}² texels", name, samples, memory, error))
    return rows


def _anew(vertices: NDArray[np.float64], body: Body, resolution: int) -> NDArray[np.float64]:
    return texel_table.__wrapped__(body, resolution).interpolate(vertices, body.faces)


def brute_force_map(
    vertices: NDArray[np.float64],  # [V, 3] m
    body: Body,
    resolution: int,
    step: int = 1,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """[R/step, R/step, 3] m and the mask of texels whose centre lies in some face, asking every face of every texel.

    Of a centre on the edge of two faces the one that has it deeper inside counts; both put it in the same place.
    """
    count = -(-resolution // step)
    positions, mask = np.zeros((count, count, 3)), np.zeros((count, count), bool)
    a, b, c = (body.uv[body.uv_faces[:, k]] for k in range(3))
    area = _cross(b - a, c - a)
    corners = vertices[body.faces]  # [F, 3, 3]
    for i in range(count):
        for j in range(count):
            p = np.array([(j * step + 0.5) / resolution, 1 - (i * step + 0.5) / resolution])
            bary = np.stack([_cross(b - p, c - p), _cross(c - p, a - p), _cross(a - p, b - p)], -1) / area[:, None]
            least = bary.min(-1)
            face = int(np.nanargmax(least))
            if least[face] >= -INSIDE:
                positions[i, j], mask[i, j] = bary[face] @ corners[face], True
    return positions, mask


def _cross(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]
