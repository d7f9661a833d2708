"""Stage 3, canonical refinement (sec. 3.4): go on fitting, now also to what was painted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.fit.losses import Perceptual
from ihbench.fit.optimisation import Optimisation
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.refine_config import RefineConfig
from ihbench.methods.inpainthuman.stages.refine_loss import (
    PaintedTarget,
    load_perceptual,
    prepare_painted,
    refine_loss,
)
from ihbench.methods.inpainthuman.stages.stage1 import (
    TARGETS_HELD,
    KnownSurface,
    Target,
    draw,
    fitted_window,
    initial_loss,
    parameter_groups,
    prepare_target,
    ssim_weight,
)
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.scene.views import LazyViews

STATE = "stage3"


@dataclass(frozen=True)
class RefineTarget:
    """What one step needs: the view as it was taken, and as it was painted, in one window."""

    original: Target  # all UNKNOWN for a view that was never taken
    painted: PaintedTarget


class Stage3(Optimisation[GaussianAvatar]):
    """Each step draws one view and adds the refinement loss to stage 1's, which keeps the visible pixels.

    `painted` are training views by their index, at most one each, and views that were never taken, by any index
    beyond the training views'. A training view that was not painted enters the refinement with its visible pixels.
    The pose residual stays as stage 1 left it. Steps are counted on from stage 1's. `config` is the avatar's own
    unless given. Raises `BadInput` when two paintings are of one training view, or one is not of its view's size.
    """

    name, title = STATE, "stage 3"

    def __init__(
        self,
        avatar: GaussianAvatar,
        training: TrainingSet,
        painted: Sequence[PaintedView],
        seed: int,
        ledger: Ledger,
        config: RefineConfig | None = None,
    ):
        n = len(training.views)
        chosen = avatar.config.refine if config is None else config
        self.config = chosen
        self._painted = {view.index: view for view in painted if view.index < n}
        self._others = [view for view in painted if view.index >= n]
        if len(self._painted) + len(self._others) < len(painted) or min(self._painted, default=0) < 0:
            raise BadInput(f"stage 3: expected one painted view per training view, got {[v.index for v in painted]}")
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            parameter_groups(avatar, chosen.lr_share, maps_only=not chosen.networks),
            steps=chosen.steps,
            views=n + len(self._others),
            first_step=avatar.config.fit_steps,
            lr_final=avatar.config.lr_final,
            clip_gradient=avatar.config.clip_gradient,
            warm_up=chosen.warm_up,
        )
        self._surface = KnownSurface.of(avatar, training)
        self._targets = LazyViews(self._target, self.views, held=TARGETS_HELD)
        self._perceptual: Perceptual | None = None

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        if self.config.steps > 0:
            perceptual = load_perceptual(self.config, self.avatar.device)
            if isinstance(perceptual, str):
                self.ledger.event_once(LeftOut("lpips term", perceptual))
            else:
                self._perceptual = perceptual
        super().run(progress)

    def _loss(self, k: int) -> Tensor:
        target, background = self._targets[k], self.training.background
        drawn = draw(self.avatar, target.original, background)
        loss = initial_loss(self.avatar, drawn, target.original)
        if self.config.weight > 0:
            ssim = ssim_weight(self.avatar.config, self.config.ssim, self.step)
            refined = refine_loss(drawn.rgb, target.painted, replace(self.config, ssim=ssim), self._perceptual)
            loss = loss + self.config.weight * refined
        return loss

    def _target(self, k: int) -> RefineTarget:
        n = len(self.training.views)
        if k >= n:
            painted = self._others[k - n]
            view = _never_taken(painted.view)
        else:
            view = self.training.views[k]
            painted = self._painted.get(k) or PaintedView(k, view, np.zeros(view.mask.shape, bool))
            if painted.view.image.shape != view.image.shape:
                raise BadInput(
                    f"painted view {k}: has shape {painted.view.image.shape}, expected {view.image.shape}, the "
                    f"training view's"
                )
        vertices = self.avatar.body.pose(view.body_pose, blend_shapes=False)
        x0, y0, width, height = fitted_window(self.avatar, view.camera, vertices)
        rows, cols = slice(y0, y0 + height), slice(x0, x0 + width)
        background, device = self.training.background, self.avatar.device
        return RefineTarget(
            prepare_target(self.avatar, view, self._surface),
            prepare_painted(painted, rows, cols, background, self.config.generated, device),
        )


def _never_taken(view: TrainView) -> TrainView:
    """The view without anything that stage 1's loss could count."""
    return replace(view, mask=np.full_like(view.mask, MaskState.UNKNOWN))
