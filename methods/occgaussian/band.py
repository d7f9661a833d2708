"""A vertical band of the visible person that is hidden on purpose: what is under it is asked for, and known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.methods.occgaussian.config import BandConfig
from ihbench.methods.occgaussian.sightings import Sighting

BAND = 7  # what random numbers are drawn for


@dataclass(frozen=True)
class Band:
    first: int  # column of the window
    last: int  # beyond it
    vertices: NDArray[np.int64]  # seen ones under it

    def mask(self, like: Tensor) -> Tensor:  # like [h, w, 1]
        """[h, w, 1] 1 under it."""
        out = torch.zeros_like(like)
        out[:, self.first : self.last] = 1
        return out


def draw_band(
    config: BandConfig,
    person: NDArray[np.bool_],  # [h, w]
    sighting: Sighting,
    seed: int,
    step: int,
) -> Band | None:
    """A band by seed and step, so that a fit that was stopped goes on as it would have. None without a visible person
    and where one column holds all of it."""
    columns = person.sum(0).cumsum()
    if not len(columns) or columns[-1] == 0:
        return None
    generator = np.random.default_rng((seed, step, BAND))
    share = generator.uniform(min(config.least, config.most), config.most)
    start = generator.uniform(0, 1 - share)
    first, last = np.searchsorted(columns / columns[-1], [start, start + share], side="left")
    if last <= first:
        return None
    under = (sighting.xy[:, 0] >= first) & (sighting.xy[:, 0] < last)
    return Band(int(first), int(last), sighting.seen[under])
