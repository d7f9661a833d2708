"""Some of many, evenly spread."""

import numpy as np


def spread(n: int, k: int) -> list[int]:
    """k of n indices, ascending, from the first to the last; all where k is larger."""
    return sorted({int(i) for i in np.linspace(0, n - 1, min(k, n)).round()})
