"""The mesh z-buffer: numba against numpy."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ihbench.kernels.measuring import Row, interleave, peak_mib, row_of, timed


def zbuffer_rows(repeats: int, cases: Sequence[tuple[str, int, int]] = (("14k faces@512", 83, 512),)) -> list[Row]:
    """The mesh z-buffer: numba against numpy, which define one function; the value error is the depth's, in m."""
    from ihbench.render.zbuffer import rasterize

    rows = []
    for case, rings, size in cases:
        points, faces = _sphere(rings, size)
        steps = {b: partial(rasterize, points, faces, size, size, b) for b in ("numpy", "numba")}
        timings = interleave({b: partial(timed, step) for b, step in steps.items()}, repeats)
        truth = steps["numpy"]()
        for backend, samples in timings.items():
            raster = steps[backend]()
            both = truth.mask & raster.mask
            error = float(np.abs(raster.depth[both] - truth.depth[both]).max())
            error = error if (truth.face == raster.face).all() else float("inf")
            rows.append(row_of("zbuffer", case, backend, samples, peak_mib(steps[backend]), error))
    return rows


def _sphere(rings: int, size: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A sphere that fills a size² image: projected points [V, 3] (px, px, m) and faces [2 rings (rings - 1), 3]."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, rings + 1), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    points = points.reshape(-1, 3) * (0.45 * size, 0.45 * size, 0.5) + (0.5 * size, 0.5 * size, 3.0)
    corner = np.arange(rings * (rings + 1)).reshape(rings, rings + 1)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    return points, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
