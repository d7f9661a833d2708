"""M_rand: occluders made up for training, on `mini`'s procedural people and on the visible pixels of one person."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

KINDS = ("strip", "band", "blocks", "patches", "side", "all")
SHARES = (0.45, 0.10, 0.15, 0.15, 0.09, 0.06)


def random_mask(
    rng: np.random.Generator,
    person: NDArray[np.bool_],  # [H, W] where the body is
    shares: tuple[float, ...] = SHARES,
) -> NDArray[np.bool_]:
    """[H, W] True where the occluder is: full-height strips, bands, blocks, ragged patches, one side, or all."""
    height, width = person.shape
    out = np.zeros((height, width), bool)
    rows, cols = np.nonzero(person)
    if not len(rows):
        out[:] = True
        return out
    top, bottom, left, right = rows.min(), rows.max() + 1, cols.min(), cols.max() + 1
    kind = KINDS[int(rng.choice(len(KINDS), p=shares))]
    if kind == "strip":
        # the columns that hold a share of the person, as published strips were tuned, or a share of their width
        middle = rng.normal(cols.mean(), 0.12 * (right - left))
        half = 0.5 * (right - left) * rng.uniform(0.12, 0.65)
        out[:, max(round(middle - half), 0) : max(round(middle + half), 0)] = True
    elif kind == "band":
        half = 0.5 * (bottom - top) * rng.uniform(0.1, 0.5)
        middle = rng.uniform(top, bottom)
        out[max(round(middle - half), 0) : max(round(middle + half), 0)] = True
    elif kind == "blocks":
        for _ in range(int(rng.integers(1, 5))):
            h, w = ((bottom - top) * rng.uniform(0.08, 0.4, 2)).astype(int)
            k = int(rng.integers(len(rows)))
            y, x = rows[k] - h // 2, cols[k] - w // 2
            out[max(y, 0) : y + h, max(x, 0) : x + w] = True
    elif kind == "patches":
        # what is left when other frames have shown the rest of the surface
        noise = gaussian_filter(rng.normal(size=(height, width)), 0.05 * (bottom - top) * rng.uniform(0.5, 2))
        near = np.asarray(binary_dilation(person, iterations=3), bool)
        out = near & (noise > np.quantile(noise[person], rng.uniform(0.3, 0.85)))
    elif kind == "side":
        cut = round(rng.uniform(left + 0.25 * (right - left), right - 0.25 * (right - left)))
        out[:, :cut] = True
        if rng.random() < 0.5:
            out = ~out
    else:
        out[:] = True
    return out
