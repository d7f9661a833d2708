"""Which pixels of a view a step looks at: square patches as HumanNeRF draws them, or single pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.fit.rays.ray_target import RayTarget

ON_PERSON = 0.8  # share of the patches whose middle is a visible person pixel


@dataclass(frozen=True)
class Pixels:
    """Some pixels of an image, by row and column, in any shape: [P, h, w] for patches, [N] for pixels."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]


def draw_patches(
    target: RayTarget, count: int, side: int, rng: np.random.Generator, on_person: float = ON_PERSON
) -> Pixels:
    """Patches [count, h, w] of `side` px, or the image's side where that is smaller, inside the image.

    A patch's middle is drawn from the visible person's pixels, or, with the rest of the probability or where there
    are none, from those in the box that are background; middles at the edge are moved inwards (HumanNeRF,
    core/data/human_nerf/train.py:149-231). A middle is never unknown. Where there is neither, anywhere in the image.
    """
    (height, width), starts = target.shape, np.empty((count, 2), np.int64)
    high, wide = min(side, height), min(side, width)
    for k in range(count):
        wants_person = rng.uniform() < on_person
        of = target.person_pixels if wants_person else target.empty_pixels
        if not len(of):
            of = target.empty_pixels if wants_person else target.person_pixels
        number = int(of[rng.integers(len(of))]) if len(of) else int(rng.integers(height * width))
        row, column = divmod(number, width)
        starts[k] = np.clip((row - high // 2, column - wide // 2), 0, (height - high, width - wide))
    rows = starts[:, 0, None, None] + np.arange(high)[:, None]
    columns = starts[:, 1, None, None] + np.arange(wide)
    shape = count, high, wide
    return Pixels(np.broadcast_to(rows, shape).copy(), np.broadcast_to(columns, shape).copy())


def draw_pixels(target: RayTarget, count: int, rng: np.random.Generator, on_person: float = ON_PERSON) -> Pixels:
    """Single pixels [count], each by itself: of the person, or of the background in the box. Never unknown."""
    wants_person = rng.uniform(size=count) < on_person
    number = np.empty(count, np.int64)
    for chosen, of, other in (
        (wants_person, target.person_pixels, target.empty_pixels),
        (~wants_person, target.empty_pixels, target.person_pixels),
    ):
        some = of if len(of) else other if len(other) else np.arange(target.person.size)
        number[chosen] = some[rng.integers(len(some), size=int(chosen.sum()))]
    return Pixels(number // target.shape[1], number % target.shape[1])
