"""Every switch of `ihbench train-mini`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class MiniTraining:
    """How `mini` is trained."""

    people: int = 1600
    """Procedural people to learn from, a multiple of 100."""
    each: int = 8
    """Photographs of every person."""
    steps: int = 3000
    """Optimisation steps; the rate falls over the last quarter."""
    batch: int = 8
    """Crops a step; of wider ones fewer, of narrower ones more."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the networks' arithmetic; bfloat16 is for GPUs."""
    lr: float = 5e-4
    """AdamW step size."""
    seed: int = 0
    """Draws the weights, the order and the masks."""
    average: float = 0.999
    """Decay of the running mean of the weights, which is what is kept."""
    traits: float = 0.40
    """Share of the samples whose person is told by trait tokens, the room in which V* is looked for."""
    captions: float = 0.35
    """Share that has a caption; the rest has "a photo of a person"."""
    phrase_kept: float = 0.7
    """Chance that a phrase of a caption stays."""
    control: float = 0.65
    """Share of the steps with the part map."""
    background_weight: float = 0.15
    """Weight of hidden blocks without the person."""
    save_every: float = 240.0
    """Seconds between two saved states."""
