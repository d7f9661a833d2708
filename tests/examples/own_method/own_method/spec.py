"""The mannequin's switches."""

from dataclasses import dataclass
from typing import Literal

from ihbench.scene.plan import Omission


@dataclass(frozen=True)
class MannequinConfig:
    brightness: float = 0.5
    """The mesh's grey."""
    trouble: Literal["none", "raise", "wrong-size", "nan"] = "none"
    """What goes wrong: fitting raises, or pictures of a wrong size or full of NaN come out."""
    trouble_seed: int = 0
    """The seed with which it goes wrong."""


PROFILES = {"quick": MannequinConfig(), "paper": MannequinConfig()}


def leave_out(config: MannequinConfig, scene: object) -> list[Omission]:
    return []
