"""The standard 3D Gaussian splatting PLY, as viewers and editors read it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.atomic import write_bytes

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc
OPACITY = 0.999  # the renderer's alpha bound; opacity 1 has no finite logit
FIELDS = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    + [f"scale_{k}" for k in range(3)]
    + [f"rot_{k}" for k in range(4)]
)


def splat_ply(
    means: NDArray[np.float32],  # [N, 3] m
    scales: NDArray[np.float32],  # [N] m
    colors: NDArray[np.float32],  # [N, 3] in [0, 1]
) -> bytes:
    """A binary little-endian PLY of isotropic Gaussians: log scales, logit opacity, identity rotation (w first)."""
    table = np.zeros((len(means), len(FIELDS)), "<f4")
    table[:, 0:3] = means
    table[:, 6:9] = (colors - 0.5) / SH_C0
    table[:, 9] = np.log(OPACITY / (1 - OPACITY))
    table[:, 10:13] = np.log(np.maximum(scales, 1e-9))[:, None]
    table[:, 13] = 1
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}"]
    header += [f"property float {name}" for name in FIELDS] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def read_splat_ply(data: bytes) -> tuple[NDArray, NDArray, NDArray]:
    """means [N, 3], scales [N], colours [N, 3] of a PLY as `splat_ply` writes it."""
    head, _, body = data.partition(b"end_header\n")
    count = next(
        int(line.split()[-1]) for line in head.decode("ascii").splitlines() if line.startswith("element vertex")
    )
    table = np.frombuffer(body, "<f4").reshape(count, len(FIELDS))
    return table[:, :3], np.exp(table[:, 10]), table[:, 6:9] * SH_C0 + 0.5


def write_splat_ply(path: Path, means: NDArray, scales: NDArray, colors: NDArray) -> None:
    """Write atomically. Raises `BadInput` when the disk does not take it."""
    write_bytes(path, splat_ply(means, scales, colors))
