"""The mesh z-buffer: numba against numpy."""

from __future__ import annotations

import time
from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from ihbench.kernels.measuring import Row, interleave, peak_mib, summary


def zbuffer_rows(repeats: int, cases: Sequence[tuple[str, int, int]] = (("14k faces@512", 83, 512),)) -> list[Row]:
    """The mesh z-buffer: numba against numpy, which define one function; the value error is the depth's, in m."""
    from ihbench.render.zbuffer import rasterize

    rows = []
    for case, rings, size in cases:
        points, faces = _sphere(rings, size)
        backends = ["numpy", *(["numba"] if find_spec("numba") is not None else [])]

        def step(backend: str, points=points, faces=faces, size=size) -> tuple[float, None]:
            start = time.perf_counter()
            rasterize(points, faces, size, size, backend)
            return (time.perf_counter() - start) * 1e3, None

        timings = interleave({b: lambda b=b: step(b) for b in backends}, repeats)
        truth = rasterize(points, faces, size, size, "numpy")
        for backend, samples in timings.items():
            raster = rasterize(points, faces, size, size, backend)
            both = truth.mask & raster.mask
            error = float(np.abs(raster.depth[both] - truth.depth[both]).max())
            rows.append(
                {
                    "kernel": "zbuffer",
                    "case": case,
                    "backend": backend,
                    **summary(samples),
                    "peak_mib": peak_mib(lambda b=backend: step(b)),
                    "value_error": error if (truth.face == raster.face).all() else float("inf"),
                    "gradient_error": None,
                }
            )
    return rows


def _sphere(rings: int, size: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """A sphere that fills a size² image: projected points [V, 3] (px, px, m) and faces [2 rings (rings - 1), 3]."""
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, rings + 1), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)], -1)
    points = points.reshape(-1, 3) * (0.45 * size, 0.45 * size, 0.5) + (0.5 * size, 0.5 * size, 3.0)
    corner = np.arange(rings * (rings + 1)).reshape(rings, rings + 1)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    return points, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
