"""Whether poses fit their pictures: the share of a body's vertices that project into the silhouette."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def share_inside(points: NDArray[np.float64], region: NDArray[np.bool_]) -> float:
    """The share of projected points [V, 3] (x px, y px, depth m) that fall on the region [H, W]."""
    height, width = region.shape
    column, row = np.floor(points[:, 0]), np.floor(points[:, 1])
    seen = (points[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    hits = region[row[seen].astype(int), column[seen].astype(int)].sum()
    return float(hits) / len(points)
