"""Value noise in 3-D: the grain of cloth, hair, walls and floors."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray


def value_noise(points: NDArray[np.floating], seed: int, frequency: float) -> NDArray[np.float32]:
    """Smooth noise in [0, 1] at points [N, 3].

    A hashed value sits on every corner of a cubic lattice with `frequency` cells per unit and is interpolated with
    the smoothstep 3t² − 2t³ (Perlin 1985 calls this a lattice value noise). The same seed gives the same field at any
    point, so texels that meet across a seam of a texture atlas agree.
    """
    return _kernel()(np.ascontiguousarray(points, np.float64), np.uint32(seed & 0xFFFFFFFF), float(frequency))


def fractal_noise(points: NDArray[np.floating], seed: int, frequency: float, octaves: int = 3) -> NDArray[np.float32]:
    """Octaves of `value_noise` at points [N, 3], each twice as fine and half as strong; in [0, 1]."""
    total = np.zeros(len(points), np.float32)
    for octave in range(octaves):
        total += value_noise(points, seed + 101 * octave, frequency * 2**octave) * 0.5**octave
    return total / np.float32(2 - 0.5 ** (octaves - 1))


@cache
def _kernel():
    from numba import njit, uint32

    @njit(cache=True, nogil=True)  # one function: the code of one that calls another from here is never found again
    def noise(points, seed, frequency):
        out = np.empty(len(points), np.float32)
        for n in range(len(points)):
            x, y, z = points[n, 0] * frequency, points[n, 1] * frequency, points[n, 2] * frequency
            i, j, k = int(np.floor(x)), int(np.floor(y)), int(np.floor(z))
            x, y, z = x - i, y - j, z - k
            x, y, z = x * x * (3 - 2 * x), y * y * (3 - 2 * y), z * z * (3 - 2 * z)
            value = 0.0
            for a in range(2):
                for b in range(2):
                    for c in range(2):
                        weight = (x if a else 1 - x) * (y if b else 1 - y) * (z if c else 1 - z)
                        # numba widens uint32 products to 64 bits; the casts bring the hash back to 32
                        p, q, r = uint32(i + a) * 73856093, uint32(j + b) * 19349663, uint32(k + c) * 83492791
                        h = uint32(p ^ q ^ r ^ seed)
                        h = uint32((h ^ (h >> 16)) * 0x7FEB352D)
                        h = uint32((h ^ (h >> 15)) * 0x846CA68B)
                        value += weight * (uint32(h ^ (h >> 16)) / 4294967295.0)
            out[n] = value
        return out

    return noise
