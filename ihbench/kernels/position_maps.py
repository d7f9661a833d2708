"""Position maps of the posed body: the cached table, the table anew, and the float64 twin that asks every face."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.kernels.measuring import Row, interleave, peak_mib, summary, timed

POSITION_CASES = (64, 128, 256)  # texels, side of the map
TWIN_UP_TO = 32  # texels a side that the twin looks at; of a finer map every n-th
TWIN = "every face f64, extrapolated"
INSIDE = 1e-9  # barycentric coordinate below which a texel centre lies outside a face


def position_map_rows(repeats: int, cases: Sequence[int] = POSITION_CASES) -> list[Row]:
    """Value error: the largest distance in m between where a texel is and where the twin says it is, on texels that
    both have; infinite where one has a texel inside a chart that the other lacks. The time of the twin is
    extrapolated from the texels that it looked at.
    """
    from ihbench.body import load_body, position_map, texel_table
    from ihbench.body.pose import BodyPose

    body = load_body()
    pose = BodyPose(np.random.default_rng(0).normal(0, 0.3, (24, 3)), np.zeros(10), np.zeros(3))
    vertices = body.pose(pose)
    rows = []
    for resolution in cases:
        step = max(1, resolution // TWIN_UP_TO)

        def cached(resolution: int = resolution) -> tuple[NDArray, NDArray]:
            return position_map(vertices, body, resolution)

        def anew(resolution: int = resolution) -> NDArray:
            texels = texel_table.__wrapped__(body, resolution)
            return texels.interpolate(vertices, body.faces)

        found, mask = cached()
        start = time.perf_counter()
        exact, inside = brute_force_map(vertices, body, resolution, step)
        twin_ms = (time.perf_counter() - start) * 1e3 * step**2
        common = mask[::step, ::step] & inside
        same = bool((mask[::step, ::step] == inside).all())
        off = np.linalg.norm(found[::step, ::step][common] - exact[common], axis=-1).max(initial=0.0)
        from_table = np.zeros((resolution**2, 3))
        from_table[texel_table(body, resolution).index] = anew()
        table_off = np.linalg.norm(
            from_table.reshape(resolution, resolution, 3)[::step, ::step][common] - exact[common], axis=-1
        ).max(initial=0.0)
        steps: dict[str, Callable[[], Any]] = {"cached table f32": cached, "table anew f64": anew}
        timings = interleave({name: partial(timed, f) for name, f in steps.items()}, repeats)
        timings[TWIN] = [(twin_ms, None)]
        errors = {
            "cached table f32": float(off),
            "table anew f64": float(table_off),
            TWIN: 0.0,
        }
        for name, samples in timings.items():
            rows.append(
                {
                    "kernel": "position-map",
                    "case": f"{resolution}² texels",
                    "backend": name,
                    **summary(samples),
                    "peak_mib": peak_mib(steps[name]) if name in steps else None,
                    "value_error": errors[name] if same else float("inf"),
                    "gradient_error": None,
                }
            )
    return rows


def brute_force_map(
    vertices: NDArray[np.float64],  # [V, 3] m
    body: Any,
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
