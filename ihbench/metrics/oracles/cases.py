"""Image pairs for checking metrics, made by integer arithmetic: the same bits with any library, now and later."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Case:
    """Two images and their regions."""

    name: str
    pred: NDArray  # [H, W, 3] uint8, or float with peak 1
    truth: NDArray  # as pred
    regions: dict[str, NDArray[np.bool_]]  # all that the presets ask for; `full` is everything


def hashed(seed: int, height: int, width: int, channels: int = 3) -> NDArray[np.uint8]:
    """[H, W, C] bytes that look random."""
    i, j, c = np.indices((height, width, channels), dtype=np.uint64)
    x = i * np.uint64(73856093) ^ j * np.uint64(19349663) ^ c * np.uint64(83492791) ^ np.uint64(seed * 2654435761)
    for shift, factor in ((16, 0x45D9F3B), (16, 0x45D9F3B)):
        x = ((x >> np.uint64(shift)) ^ x) * np.uint64(factor) & np.uint64(0xFFFFFFFF)
    return ((x >> np.uint64(16)) ^ x).astype(np.uint64).astype(np.uint8)


def person_case(height: int = 24, width: int = 22, dtype: type = np.float32, seed: int = 1) -> Case:
    """A textured figure on white, and a prediction that is a pixel off, noisy, and worse in red.

    Float images are the 8-bit ones over 255, the prediction with a fraction of a level added, so that rounding and
    truncation differ, and slightly out of [0, 1] in places.
    """
    rows, columns = np.mgrid[:height, :width]
    y, x = 2 * rows - height + 1, 2 * columns - width + 1  # twice the distance from the centre
    body = (4 * y) ** 2 * width**2 + (9 * x) ** 2 * height**2 < (4 * height * width) ** 2
    shifted = np.roll(body, 1, axis=1)
    texture = 60 + hashed(seed, height, width) // 2
    texture[..., 0] += 40
    truth = np.where(body[..., None], texture, 255).astype(np.uint8)
    noise = hashed(seed + 1, height, width).astype(int) % 41 - 20
    noise[..., 0] *= 2
    pred = np.where(shifted[..., None], np.clip(texture + noise, 0, 255), 255).astype(np.uint8)
    pred[:2, :3] = hashed(seed + 2, 2, 3)  # a stray blob outside every box
    band = abs(x) < max(2, width // 8)
    box = _rectangle(body | shifted, 1)
    regions = {
        "full": np.ones((height, width), bool),
        "box": box,
        "box+0.05": box,
        "box+0.3": _rectangle(body | shifted, 2),
        "body": body,
        "visible": body & ~band & (y < height // 2),
        "hidden": body & band,
        "never_seen": body & ~band & (y >= height // 2),
    }
    name = f"person {np.dtype(dtype).name}"
    if dtype == np.uint8:
        return Case(name, pred, truth, regions)
    fraction = (hashed(seed + 3, height, width).astype(np.float64) - 128) / 300 / 255
    shown = pred / 255 + np.where(shifted[..., None], fraction, 0)
    return Case(name, shown.astype(dtype), (truth / 255).astype(dtype), regions)


def _rectangle(mask: NDArray[np.bool_], margin: int) -> NDArray[np.bool_]:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    out = np.zeros_like(mask)
    out[max(rows[0] - margin, 0) : rows[-1] + margin + 1, max(columns[0] - margin, 0) : columns[-1] + margin + 1] = (
        True
    )
    return out
