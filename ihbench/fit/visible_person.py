"""Whether there is anybody to fit."""

from __future__ import annotations

from ihbench.errors import BadInput
from ihbench.scene.contracts import MaskState, TrainingSet


def require_visible_person(training: TrainingSet) -> None:
    """Raises `BadInput` where no training view shows a pixel of the person, or there is none."""
    if not any((view.mask == MaskState.PERSON).any() for view in training.views):
        why = "no training view shows a visible person pixel" if len(training.views) else "no training view"
        raise BadInput(f"scene {training.name}: {why}; nothing to fit")
