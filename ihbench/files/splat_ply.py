"""The standard 3D Gaussian splatting PLY, as viewers and editors read it.

What they take for up is `ihbench.export.axes`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import visible
from ihbench.files.atomic import write_bytes

SH_C0 = 0.28209479177387814  # the constant spherical harmonic: colour = 0.5 + SH_C0 * f_dc
UPRIGHT = (1.0, 0.0, 0.0, 0.0)  # quaternion, w first
TRANSPARENT = 1e-6  # likewise of 0
OPACITY = 0.999  # the renderer's alpha bound; opacity 1 has no finite logit
REST = (0, 9, 24, 45)  # f_rest columns of degrees 0 to 3


def fields(rest: int = 0) -> list[str]:
    """The columns of a PLY with so many f_rest columns, in the order of the released code."""
    return (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{k}" for k in range(rest)]
        + ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    )


def splat_ply(
    means: NDArray,  # [N, 3] m
    scales: NDArray,  # [N] or [N, 3] m
    colors: NDArray,  # [N, 3] in [0, 1]
    comments: Sequence[str] = (),
    rotation: NDArray | tuple[float, float, float, float] = UPRIGHT,  # of every Gaussian, or [N, 4]; unit, w first
    opacities: NDArray | float = OPACITY,  # [N] 0..1, or of all
    harmonics: NDArray | None = None,  # [N, K, 3], K = 1, 4, 9 or 16, in place of the colours
) -> bytes:
    """A binary little-endian PLY of Gaussians: log scales, logit opacities, spherical harmonics channel by channel.

    `comments` are lines of its header; what is not ASCII is escaped. Raises `ValueError` for other shapes and ranges,
    and for values that are not finite.
    """
    n = len(means)
    if np.shape(means) != (n, 3) or np.shape(scales) not in ((n,), (n, 3)) or np.shape(colors) != (n, 3):
        raise ValueError(
            f"splat PLY: expected means [N, 3], scales [N] or [N, 3], colors [N, 3], "
            f"got {np.shape(means)}, {np.shape(scales)}, {np.shape(colors)}"
        )
    if harmonics is None:
        harmonics = (np.asarray(colors)[:, None] - 0.5) / SH_C0
    rest = 3 * (harmonics.shape[1] - 1)
    if rest not in REST or np.shape(harmonics) != (n, rest // 3 + 1, 3):
        raise ValueError(f"splat PLY: expected harmonics [N, 1, 4, 9 or 16, 3], got {np.shape(harmonics)}")
    finite = all(np.isfinite(values).all() for values in (means, scales, colors, rotation, opacities, harmonics))
    if n and not finite:
        raise ValueError("splat PLY: expected finite values; leave broken Gaussians out")
    if n and np.min(scales) < 0:
        raise ValueError(
            "splat PLY: expected scales in metres, got negative ones; the file's logarithms are made here"
        )
    if n and (np.asarray(colors).dtype.kind in "iu" or np.max(colors) > 16):
        raise ValueError("splat PLY: expected colours in 0..1; divide 8-bit values by 255")
    if n and (np.min(opacities) < 0 or np.max(opacities) > 1):
        raise ValueError("splat PLY: expected opacities in 0..1; the file's logits are made here")
    names = fields(rest)
    table, opacity = np.zeros((n, len(names)), "<f4"), names.index("opacity")
    table[:, 0:3] = means
    table[:, 6:9] = harmonics[:, 0]
    table[:, 9:opacity] = harmonics[:, 1:].transpose(0, 2, 1).reshape(n, rest)
    share = np.clip(np.asarray(opacities, np.float64), TRANSPARENT, OPACITY)
    table[:, opacity] = np.log(share / (1 - share))
    table[:, opacity + 1 : opacity + 4] = np.log(
        np.maximum(scales if np.ndim(scales) == 2 else np.asarray(scales)[:, None], 1e-9)
    )
    table[:, opacity + 4 :] = rotation
    header = ["ply", "format binary_little_endian 1.0"]
    for line in comments:  # readers look for the end of the header as text
        plain = visible(line).encode("ascii", "backslashreplace").decode().replace("end_header", "end-header")
        header.append(f"comment {plain}")
    header += [f"element vertex {n}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def read_splat_ply(data: bytes) -> tuple[NDArray, NDArray, NDArray]:
    """means [N, 3], scales [N] and colours [N, 3] of a PLY of isotropic Gaussians as `splat_ply` writes it."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    count = next(int(line.split()[-1]) for line in lines if line.startswith("element vertex"))
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    table = np.frombuffer(body, "<f4").reshape(count, len(names))
    return table[:, :3], np.exp(table[:, names.index("scale_0")]), table[:, 6:9] * SH_C0 + 0.5


def write_splat_ply(path: Path, means: NDArray, scales: NDArray, colors: NDArray, *more: Any, **named: Any) -> None:
    """Write atomically, with the arguments of `splat_ply`. Raises `BadInput` when the disk does not take it,
    `ValueError` as `splat_ply`."""
    write_bytes(path, splat_ply(means, scales, colors, *more, **named))
