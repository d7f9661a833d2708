"""One body shape for a person whose frames were fitted with several."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.events import Warned
from ihbench.clock.ledger import Ledger
from ihbench.scene.contracts import TrainView

SAME_BETAS = 1e-3  # a shape coefficient that varies less over the frames is the same


def mean_betas(views: Sequence[TrainView], ledger: Ledger, who: str) -> NDArray[np.float64]:
    """[B] mean shape coefficients; an event says so where they vary. `who` has them, such as "the T-pose"."""
    betas = np.array([view.body_pose.betas for view in views])
    if np.ptp(betas, axis=0).max(initial=0) > SAME_BETAS:
        ledger.event_once(Warned(f"shape coefficients vary over the frames; {who} has their mean"))
    return betas.mean(0)
