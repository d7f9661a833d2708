"""Stage 0 (stage0_oc.py): complete silhouettes. A generic person is painted where the real one may be hidden, and
what of the painting is person is looked for; the painting itself is thrown away.

The part map of the posed body, drawn with a z-buffer, stands where the released code has a skeleton without the
joints that the body itself hides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.clock.events import Resumed
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.complete_silhouette import silhouette_finder
from ihbench.diffusion.crops.crop_view import CropView, cut_view
from ihbench.diffusion.sampling import inpaint_views
from ihbench.methods.occfusion.config import OccFusionConfig
from ihbench.methods.occfusion.hidden import cut_states, frames_to_paint, may_hide, visible
from ihbench.methods.occfusion.painted import Painted
from ihbench.methods.occfusion.spec import MASKS, MASKS_SAMPLED
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import TrainingSet, TrainView


@dataclass(frozen=True)
class CompleteMasks:
    """M̂ of the views whose silhouette was looked for in a painting. Of another view it is the visible person and,
    where pixels may be hidden, what the posed body covers."""

    painted: dict[int, NDArray[np.bool_]]  # view -> [H, W]
    body: Body
    config: OccFusionConfig

    def of(self, k: int, view: TrainView) -> NDArray[np.bool_]:
        """[H, W] M̂ of training view k."""
        if k in self.painted:
            return self.painted[k]
        own, hidden = visible(view), may_hide(view, self.config)
        return own | (hidden & self._covered(view)) if hidden.any() else own

    def undecided(self, k: int, view: TrainView) -> NDArray[np.bool_]:
        """[H, W] where nobody knows whether M̂ reaches: of a view that was not painted, what may be hidden just
        beside the posed body. Taken for background, it would cut people's clothes off."""
        hidden = may_hide(view, self.config)
        if k in self.painted or not hidden.any():
            return np.zeros_like(hidden)
        covered = self._covered(view)
        return hidden & ~covered & _near(covered, self.config.inpaint.reach)

    def _covered(self, view: TrainView) -> NDArray[np.bool_]:
        camera = view.camera
        projected = camera.project(self.body.pose(view.body_pose))
        return rasterize(projected, self.body.faces, camera.height, camera.width).mask


def asked(view: TrainView, k: int, body: Body, config: OccFusionConfig, size: int, square: bool) -> CropView:
    """The crop as the painter is shown it: the visible person on the background, unknown what may be hidden and lies
    within reach of the posed body."""
    crop = cut_states(cut_view(view, k, body, size, square), view, config)
    return replace(crop, unknown=crop.unknown & _near(crop.body, config.inpaint.reach))


def _near(body: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """[S, W] on the body, or at most `reach` of its height beside it; everywhere where there is no body."""
    rows = np.flatnonzero(body.any(1))
    if not len(rows) or reach >= 100:
        return np.ones_like(body)
    distance = cv2.distanceTransform((~body).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance) <= max(reach * (rows[-1] - rows[0] + 1), 1)


def complete_masks(
    training: TrainingSet,
    config: OccFusionConfig,
    backbone: Backbone | None,
    seed: int,
    ledger: Ledger,
    progress: Progress,
) -> CompleteMasks:
    """Stage 0. What is done is kept by the ledger, so a killed run goes on behind it. Without a backbone nothing is
    painted."""
    body = training.body
    if backbone is None:
        return CompleteMasks({}, body, config)
    saved = ledger.load_state(MASKS)
    if saved is not None:
        tensors, meta = saved
        ledger.event(Resumed(MASKS, len(meta["views"])))
        shapes = {k: training.views[k].mask.shape for k in meta["views"]}
        masks = {k: _unpacked(np.asarray(tensors[f"{k}"]), shape) for k, shape in shapes.items()}
        return CompleteMasks(masks, body, config)
    inpaint, settled = config.inpaint, config.inpaint.settled()
    finder = silhouette_finder(inpaint.silhouette, training.background, inpaint.sam_weights, str(backbone.device))
    views = {k: training.views[k] for k in frames_to_paint(training, config)}
    crops = [asked(view, k, body, config, backbone.size, backbone.square) for k, view in views.items()]
    crops = [crop for crop in crops if crop.unknown.any()]
    images = inpaint_views(
        backbone, crops, settled.mask_prompt, progress,
        seed=seed, steps=settled.mask_steps, use_parts=True, guidance=settled.guidance, noise_scale=settled.noise,
        batch=inpaint.batch, ledger=ledger if ledger.on_disk else None, state=MASKS_SAMPLED,
        negative=settled.mask_negative,
    )  # fmt: skip
    masks = {}
    for crop, image in zip(crops, images, strict=True):
        view = views[crop.index]
        nothing = np.zeros(view.mask.shape, np.float32)
        found = crop.crop.paste(finder.complete(crop, image).astype(np.float32), nothing) >= 0.5
        masks[crop.index] = visible(view) | (found & may_hide(view, config))
    ledger.event(Painted("silhouettes", len(crops), len(training.views), sum(int(c.unknown.sum()) for c in crops)))
    packed = {f"{k}": np.packbits(mask) for k, mask in masks.items()}
    ledger.save_state(MASKS, {"none": np.zeros(1, np.uint8), **packed}, {"views": list(masks)})
    return CompleteMasks(masks, body, config)


def _unpacked(bits: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    return np.unpackbits(bits, count=int(np.prod(shape))).reshape(shape).astype(bool)
