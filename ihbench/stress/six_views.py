"""The training set of methods' own stress cases: a person who bends, six sides, 48 px, every other with a strip."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.stress.drawn_capture import WHITE, a_camera, a_pose, the_body, train_view

SIZE = 48  # px


@cache
def views() -> tuple[TrainView, ...]:
    return tuple(
        train_view(
            a_camera(0.0, SIZE), a_pose(1.05 * k, 0.3 * math.sin(k)), slice(21, 27) if k % 2 else None, frame=k
        )
        for k in range(6)
    )


def training_set(shown: Sequence[TrainView] | None = None) -> TrainingSet:
    """Of all views, or of these."""
    return TrainingSet(list(views() if shown is None else shown), the_body(), WHITE, "stress")


def with_view(k: int, **changes: Any) -> TrainingSet:
    """All views, with fields of view k changed."""
    return training_set([replace(view, **changes) if j == k else view for j, view in enumerate(views())])


def a_person_pixel(k: int) -> tuple[int, ...]:
    """Row and column of one, in view k."""
    return tuple(np.argwhere(views()[k].mask == MaskState.PERSON)[9])


def only_a_pixel(k: int, elsewhere: MaskState) -> TrainView:
    """View k with one person pixel."""
    mask = np.full_like(views()[k].mask, elsewhere)
    mask[a_person_pixel(k)] = MaskState.PERSON
    return replace(views()[k], mask=mask)


def all_unknown() -> list[TrainView]:
    """Views without a visible pixel."""
    return [replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN)) for view in views()]


def with_other_shapes() -> TrainingSet:
    """Shape coefficients differ by frame."""
    betas = [np.array([0.5 * (-1) ** k, 0.0]) for k in range(len(views()))]
    poses = [replace(view.body_pose, betas=own) for view, own in zip(views(), betas, strict=True)]
    return training_set([replace(view, body_pose=pose) for view, pose in zip(views(), poses, strict=True)])


def with_bad_pixel(k: int, value: float) -> TrainingSet:
    """One person pixel of view k has this value."""
    image = views()[k].image.astype(np.float32)
    image[a_person_pixel(k)] = value
    return with_view(k, image=image)


def with_bad_hidden_pixels(k: int, value: float) -> TrainingSet:
    """What the occluder of view k hides has this value."""
    image = views()[k].image.astype(np.float32)
    image[views()[k].mask == MaskState.UNKNOWN] = value
    return with_view(k, image=image)
