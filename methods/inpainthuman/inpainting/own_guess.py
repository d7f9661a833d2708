"""The painter's word weighed against the avatar's own guess.

Stage 1 says something of surface that no view shows too: its coarse feature maps carry on what lies beside it. Close
to seen surface that guess is better than a painter's, far from it worse, and everywhere the two err differently.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def painter_weight(distance: NDArray, near: float) -> NDArray:
    """[...] in 0..1 of distances in m to seen surface: 0 where it is seen, a half at `near`, 1 infinitely far.

    `near` 0 gives the painter everything.
    """
    if near == 0:
        return np.ones(distance.shape)
    return 1 - near / (near + distance.astype(np.float64))


def with_own_guess(
    painted: NDArray[np.uint8],  # [H, W, 3]
    guess: NDArray[np.float32],  # [H, W, 3] in 0..1, the avatar's rendering
    weight: NDArray,  # [H, W] of the painter
    where: NDArray[np.bool_],  # [H, W] what was painted
) -> NDArray[np.uint8]:
    """The painted image with the weighted mean of the two where it was painted."""
    mixed = weight[..., None] * painted + (1 - weight[..., None]) * 255 * guess
    return np.where(where[..., None], np.clip(np.rint(mixed), 0, 255), painted).astype(np.uint8)
