"""The standard 3D Gaussian splatting PLY, as viewers and editors read it.

They take its axes for those of the released code's captures, y down and z forward: 180 degrees about z from y-up
(`Transform.PLY` of playcanvas/splat-transform). Y-up coordinates written as they are stand on their heads.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import visible
from ihbench.files.atomic import write_bytes

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # quaternion, w first
VIEWER_TURN = (0.0, 0.0, 0.0, 1.0)  # 180 degrees about z, w first
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
    comments: Sequence[str] = (),
    rotation: tuple[float, float, float, float] = UPRIGHT,  # of every Gaussian, a unit quaternion, w first
) -> bytes:
    """A binary little-endian PLY of isotropic Gaussians: log scales, logit opacity. `comments` are lines of its
    header; what is not ASCII is escaped. Raises `ValueError` for other shapes, ranges, and for values not finite."""
    n = len(means)
    if np.shape(means) != (n, 3) or np.shape(scales) != (n,) or np.shape(colors) != (n, 3):
        raise ValueError(
            f"splat PLY: expected means [N, 3], scales [N], colors [N, 3], "
            f"got {np.shape(means)}, {np.shape(scales)}, {np.shape(colors)}"
        )
    if n and not (np.isfinite(means).all() and np.isfinite(scales).all() and np.isfinite(colors).all()):
        raise ValueError("splat PLY: expected finite values; leave broken Gaussians out")
    if n and np.min(scales) < 0:
        raise ValueError(
            "splat PLY: expected scales in metres, got negative ones; the file's logarithms are made here"
        )
    if n and (np.asarray(colors).dtype.kind in "iu" or np.max(colors) > 16):
        raise ValueError("splat PLY: expected colours in 0..1; divide 8-bit values by 255")
    table = np.zeros((len(means), len(FIELDS)), "<f4")
    table[:, 0:3] = means
    table[:, 6:9] = (colors - 0.5) / SH_C0
    table[:, 9] = np.log(OPACITY / (1 - OPACITY))
    table[:, 10:13] = np.log(np.maximum(scales, 1e-9))[:, None]
    table[:, 13:17] = rotation
    header = ["ply", "format binary_little_endian 1.0"]
    for line in comments:  # readers look for the end of the header as text
        plain = visible(line).encode("ascii", "backslashreplace").decode().replace("end_header", "end-header")
        header.append(f"comment {plain}")
    header += [f"element vertex {len(means)}"]
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


def write_splat_ply(
    path: Path,
    means: NDArray,
    scales: NDArray,
    colors: NDArray,
    comments: Sequence[str] = (),
    rotation: tuple[float, float, float, float] = UPRIGHT,
) -> None:
    """Write atomically. Raises `BadInput` when the disk does not take it, `ValueError` as `splat_ply`."""
    write_bytes(path, splat_ply(means, scales, colors, comments, rotation))


def in_viewer_axes(
    means: NDArray,  # [N, 3] m, world
    pelvis: NDArray[np.float64],  # [3] m, world
    root: NDArray[np.float64],  # [3, 3] the body's turn in the world
) -> NDArray[np.float32]:
    """[N, 3] m: upright in the axes that viewers expect, the pelvis at the origin; turned by `VIEWER_TURN`."""
    y_up = (np.asarray(means, np.float64) - pelvis) @ root  # the body's own axes: y up, facing +z
    return (y_up * (-1, -1, 1)).astype(np.float32)
