"""Which part of the surface a run's painter made up: read from what the run has kept of its painted views."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.clock.checkpoints import States
from ihbench.errors import BadInput
from ihbench.scene.mask_state import MaskState
from ihbench.scene.visibility import PosedSurface

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.body.uv import Texels

STATE = "stage2-painted"  # saved state of painted views: tensors N.mask, N.generated, N.K, N.R, N.t, N.pose, …
MOST_VIEWS = 4096


def painted_counts(folder: Path, body: Body, texels: Texels) -> NDArray[np.int32] | None:
    """[N] in how many painted views each texel shows a pixel that a painter made and that is person; None for a run
    without painted views, and where they cannot be read."""
    try:
        state = States(folder).load(STATE)
    except (BadInput, OSError, ValueError, KeyError):
        return None
    if state is None:
        return None
    tensors, _ = state
    counts = np.zeros(len(texels.face), np.int32)
    try:
        for k in range(MOST_VIEWS):
            if f"{k}.generated" not in tensors:
                return counts
            part = {name: np.asarray(tensors[f"{k}.{name}"]) for name in PARTS}
            made = part["generated"].astype(bool) & (part["mask"] == MaskState.PERSON)
            camera = Camera(part["K"], part["R"], part["t"], made.shape[1], made.shape[0])
            pose = BodyPose(part["pose"], part["betas"], part["transl"])
            faced = PosedSurface(body, camera, pose).faced(texels)
            counts[faced.texel[made[faced.pixel]]] += 1
    except (BadInput, KeyError, ValueError, IndexError):
        return None
    return counts


PARTS = ("generated", "mask", "K", "R", "t", "pose", "betas", "transl")
