"""Which pixels of a training view may hide the person, as a configuration takes its mask."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.crops.crop_view import EDGE, CropView
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


def cut_states(crop: CropView, view: TrainView, config: OccFusionConfig) -> CropView:
    """The crop of a view with its person and unknown pixels as the configuration takes them."""
    hidden = crop.crop.cut(may_hide(view, config)) > EDGE
    if config.hidden == "unknown":
        return replace(crop, unknown=hidden)
    person = crop.crop.cut(visible(view)) >= 0.5
    return replace(crop, person=person, unknown=hidden & ~person)


def frames_to_paint(training: TrainingSet, config: OccFusionConfig) -> list[int]:
    """Numbers of the views that show some of the person and may hide some, at most `key_frames`, evenly spread."""
    hiding = [
        k
        for k, view in enumerate(training.views)
        if (view.mask == MaskState.UNKNOWN).any() and (view.mask == MaskState.PERSON).any()
    ]
    most = config.inpaint.key_frames or len(hiding)
    return [hiding[n] for n in spread(len(hiding), most)] if hiding else []
