"""What the record says of painting and of distillation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar


@dataclass(frozen=True)
class Painted:
    kind: ClassVar[str] = "painted"
    what: str  # "silhouettes" of stage 0, "images" of stage 2
    views: int
    of: int  # training views
    pixels: int  # of the crops, asked for


@dataclass(frozen=True)
class ScoreMeasured:
    """Median sizes of the gradient by alpha over hidden pixels of the silhouette, of a step of stage 1."""

    kind: ClassVar[str] = "score"
    step: int
    pixels: float  # of the losses by pixels
    score: float  # of the distillation, per pixel of the same area
