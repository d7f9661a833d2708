"""Every switch of `ihbench train-mini`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ihbench.config_fields import SEEDS, STEPS, MultipleOf, Within, check


@dataclass(frozen=True)
class MiniTraining:
    """How `mini` is trained."""

    people: Annotated[int, Within(100, 1_000_000), MultipleOf(100)] = 1600
    """Procedural people to learn from, a multiple of 100."""
    each: Annotated[int, Within(1, 1000)] = 8
    """Photographs of every person."""
    steps: Annotated[int, Within(1, STEPS)] = 3000
    """Optimisation steps; the rate falls over the last quarter."""
    batch: Annotated[int, Within(1, 4096)] = 8
    """Crops a step; of wider ones fewer, of narrower ones more."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the networks' arithmetic; bfloat16 is for GPUs."""
    lr: Annotated[float, Within(0, 1, above=True)] = 5e-4
    """AdamW step size."""
    seed: Annotated[int, SEEDS] = 0
    """Draws the weights, the order and the masks."""
    average: Annotated[float, Within(0, 1)] = 0.999
    """Decay of the running mean of the weights, which is what is kept."""
    traits: Annotated[float, Within(0, 1)] = 0.40
    """Share of the samples whose person is told by word vectors, of their traits and of their own: the space in which
    V* is looked for."""
    captions: Annotated[float, Within(0, 1)] = 0.35
    """Share that has a caption; the rest has "a photo of a person"."""
    phrase_kept: Annotated[float, Within(0, 1)] = 0.7
    """Chance that a phrase of a caption stays."""
    control: Annotated[float, Within(0, 1)] = 0.65
    """Share of the steps with the part map."""
    background_weight: Annotated[float, Within(0, 1000)] = 0.15
    """Weight of hidden blocks without the person."""
    head_weight: Annotated[float, Within(0, 1000)] = 3.0
    """Weight of hidden blocks that show the head, which is small and of which most is known least."""
    heads: Annotated[float, Within(0, 1)] = 0.5
    """Share of the steps with heads alone at twice the scale: four times as many crops, each a quarter as large."""
    feature_weight: Annotated[float, Within(0, 1000)] = 5.0
    """Weight, in a head crop, of blocks that show eyes, brows, nose or mouth."""
    context_dropped: Annotated[float, Within(0, 1)] = 0.25
    """Share of the crops of which all but a small piece is hidden: who it is can come from the words alone."""
    seen: Annotated[float, Within(0, 1)] = 0.8
    """Share of the crops that are given surface which the person's other photographs show."""
    table_lr: Annotated[float, Within(0, 1000)] = 20.0
    """Step size of the people's own word vectors, as a multiple of `lr`; 0 leaves them out."""
    save_every: Annotated[float, Within(0, 1e6)] = 240.0
    """Seconds between two saved states."""

    def __post_init__(self) -> None:
        check(self, "--train.")
