"""The three states of a training pixel."""

from enum import IntEnum


class MaskState(IntEnum):
    """What a training pixel is known to show. The complete silhouette is not among it: that would leak the answer."""

    BACKGROUND = 0  # known to show no person
    PERSON = 1  # visible person
    UNKNOWN = 2  # behind the occluder: person or background, nobody knows
