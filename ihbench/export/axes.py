"""Which way is up in a file, and where its origin is.

Splat viewers take a PLY's axes for those of the released code's captures, y down and z forward: 180 degrees about z
from y-up (`Transform.PLY` of playcanvas/splat-transform). glTF has y up and looks along +z.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ihbench.show.motion import Stand

Array = NDArray[np.float64]
Axes = Literal["splat", "y-up", "world"]

SPLAT = np.diag([-1.0, -1.0, 1.0])  # y-up to y-down, by half a turn about z
WORDS = {
    "splat": "y down, z forward (180 degrees about z from y-up); the pelvis at the origin",
    "y-up": "y up, the body facing +z; the pelvis at the origin",
    "world": "those of the data set",
}


def placement(axes: str, stand: Stand) -> tuple[Array, Array]:
    """R [3, 3] and the origin [3] m: a point x of the world is at R (x - origin) in the file."""
    if axes == "world":
        return np.eye(3), np.zeros(3)
    upright = stand.axes.T
    return (SPLAT @ upright if axes == "splat" else upright), stand.pelvis
