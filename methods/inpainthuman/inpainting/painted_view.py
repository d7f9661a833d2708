"""A view with its hidden pixels painted: what stage 3 learns from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.head_crop import PaintedHead
from ihbench.scene.contracts import MaskState, TrainView


@dataclass(frozen=True)
class PaintedView:
    """`view` is at the training images' own resolution. Its mask says PERSON or BACKGROUND where the painted image is
    to be believed and UNKNOWN elsewhere; `generated` marks the believed pixels that the painter made."""

    index: int  # of the training view, or beyond the last for a turntable view
    view: TrainView
    generated: NDArray[np.bool_]  # [H, W]


def paste_back(
    shown: TrainView,  # the view as the painter was shown it: UNKNOWN where it was to paint
    crop_view: CropView,
    painted: NDArray[np.uint8],  # [S, W, 3] the completed crop
    silhouette: NDArray[np.bool_],  # [S, W] the complete silhouette in it
    original: TrainView | None,  # the training view; None for a turntable view, of which nothing else is believed
    head: PaintedHead | None = None,  # its head, painted at a larger scale
) -> PaintedView:
    """Bring a painted crop to the view's resolution: the original where it is visible, the painted image where the
    painter was asked, and nothing in pixels of the original's occluder that another frame knows better."""
    crop = crop_view.crop
    image = crop.paste(painted.astype(np.float32), shown.image.astype(np.float32))
    if head is not None:
        image, _ = head.onto(image)
    image = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    alpha = crop.paste(silhouette.astype(np.float32), (shown.mask == MaskState.PERSON).astype(np.float32))
    # outside the crop nothing was painted: what was asked there stays unknown
    window = crop.paste(np.ones(painted.shape[:2], np.float32), np.zeros(shown.mask.shape, np.float32)) > 0.5
    asked = (shown.mask == MaskState.UNKNOWN) & window
    found = np.where(alpha >= 0.5, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    if original is None:
        mask = np.full(shown.mask.shape, MaskState.UNKNOWN, np.uint8)
        kept = shown.image
    else:
        mask, kept = original.mask.copy(), original.image
    mask[asked] = found[asked]
    image = np.where(asked[..., None], image, kept)
    return PaintedView(crop_view.index, replace(shown, image=image, mask=mask), asked)
