"""Which pixels of a training view may hide the person, as a configuration takes its mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ihbench.methods.occfusion.config import OccFusionConfig
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.scene.spread import spread


def visible(view: TrainView) -> NDArray[np.bool_]:
    """[H, W] V."""
    return view.mask == MaskState.PERSON


def may_hide(view: TrainView, config: OccFusionConfig) -> NDArray[np.bool_]:
    """[H, W] where the person may be without being visible; nowhere in a frame that nothing stands before."""
    unknown = view.mask == MaskState.UNKNOWN
    if config.hidden == "unknown" or not unknown.any():
        return unknown
    return ~visible(view)


def frames_to_paint(training: TrainingSet, config: OccFusionConfig) -> list[int]:
    """Numbers of the views that show some of the person and may hide some, at most `key_frames`, evenly spread."""
    hiding = [
        k
        for k, view in enumerate(training.views)
        if (view.mask == MaskState.UNKNOWN).any() and (view.mask == MaskState.PERSON).any()
    ]
    most = config.inpaint.key_frames or len(hiding)
    return [hiding[n] for n in spread(len(hiding), most)] if hiding else []
