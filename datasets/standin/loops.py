"""Movements without a seam, from the stand-ins' exercises, for `--motion` of `ihbench render` and `ihbench export`.

`march`, `lunge` and `bow` are those of the protocol `novel_pose`, which nobody does among the training exercises.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.datasets.standin.motion import EXERCISES, standing
from ihbench.show.motion import Loop

Array = NDArray[np.float64]

SECONDS = 2.0  # of one repetition
HALVES = ("kick", "wave")  # of these the phase counts half: left and right in turn


def _exercise(name: str) -> Loop:
    rounds = 2 if name in HALVES else 1
    return Loop(SECONDS * rounds, lambda phase: EXERCISES[name](rounds * phase))


def _turning(phase: Array) -> Array:
    """Standing still, turned once about the vertical."""
    pose = standing(phase)
    pose[:, 0, 1] += phase
    return pose


MARCH, LUNGE, BOW, SQUAT, WAVE, KICK, TWIST, PUNCH = map(
    _exercise, ("march", "lunge", "bow", "squat", "wave", "kick", "twist", "punch")
)
TURN = Loop(2 * SECONDS, _turning)
