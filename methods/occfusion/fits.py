"""Stages 1 and 3: the optimisation, step by step, with everything needed to stop after any step and go on later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.big_pose.deformation import Posed
from ihbench.fit.big_pose.fitting import TARGETS_HELD, BigPoseFit, with_pixels
from ihbench.methods.occfusion.alpha_score import AlphaScore
from ihbench.methods.occfusion.avatar import OccFusionAvatar
from ihbench.methods.occfusion.complete_masks import CompleteMasks
from ihbench.methods.occfusion.hidden import visible
from ihbench.methods.occfusion.painted import ScoreMeasured
from ihbench.methods.occfusion.spec import STAGE1, STAGE3
from ihbench.methods.occfusion.target import Target, prepare_target, refine_loss, visible_loss
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

MEASURED = 6  # times in stage 1 that the sizes of its gradients are put down


def shown(training: TrainingSet) -> list[int]:
    """Numbers of the views that show some of the person. Of others the losses know nothing; all of them where none
    does, which the fit refuses."""
    some = [k for k, view in enumerate(training.views) if visible(view).any()]
    return some or list(range(len(training.views)))


class Stage1(BigPoseFit[OccFusionAvatar]):
    """Each step draws one view: colours on visible pixels, alpha on the complete silhouette, and what the diffusion
    model says of alpha. The set of Gaussians stays as it is."""

    name, title = STAGE1, "stage 1"

    def __init__(
        self,
        avatar: OccFusionAvatar,
        training: TrainingSet,
        masks: CompleteMasks,
        score: AlphaScore | None,
        seed: int,
        ledger: Ledger,
    ):
        config, views = avatar.config, training.views
        self.masks, self.score, self._shown = masks, score, shown(training)
        never = replace(config.density, after=0, before=0, resets=())
        super().__init__(
            avatar, training, seed, ledger, never, steps=config.steps, views=len(self._shown)
        )  # fmt: skip
        self._targets = LazyViews(
            lambda k: prepare_target(
                avatar, views[k], training.background, masks.of(k, views[k]), None, masks.undecided(k, views[k])
            ),
            len(views),
            held=TARGETS_HELD,
        )

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        self._load_perceptual(self.avatar.config.lpips)
        super().run(progress)

    def _loss(self, k: int) -> Tensor:
        avatar, config, k = self.avatar, self.avatar.config, self._shown[k]
        target: Target = self._targets[k]
        posed = avatar.posed(target.frame)
        rgb, alpha = self._draw(posed, target.camera, self.training.background, target.width, target.height)
        loss = config.pixels * visible_loss(rgb, alpha, target, config, self._perceptual)
        if self.score is None or not torch.is_grad_enabled() or self.step % config.score.every:
            return loss
        weight = config.settled_score().weight * config.score.every
        if self.score.is_canonical(self.step):
            return loss + weight * self.score.canonical(self.step)
        distilled, own = self.score.posed(self.step, k, posed)
        if self._to_be_measured():
            self._measure(k, target, loss, alpha, weight * distilled, own)
        return loss + weight * distilled

    def _to_be_measured(self) -> bool:
        """Of a posed step: whether it is the first of its part of the stage."""
        every = max(self.steps // MEASURED, 1)
        part = self.step // every
        earlier = range(part * every, self.step)
        score = self.score
        return score is not None and all(n % self.avatar.config.score.every or score.is_canonical(n) for n in earlier)

    def _measure(self, k: int, target: Target, loss: Tensor, alpha: Tensor, distilled: Tensor, own: Tensor) -> None:
        """Put down what pixels and distillation ask of alpha where the silhouette is hidden."""
        assert self.score is not None
        (by_pixels,) = torch.autograd.grad(loss, alpha, retain_graph=True)
        (by_score,) = torch.autograd.grad(distilled, own, retain_graph=True)
        crop = self.score.views[k].crop
        area = (crop.crop.height / crop.crop.window_height) ** 2
        hidden = (target.complete * (1 - target.visible))[..., 0] > 0
        there = crop.crop.cut(self.masks.of(k, self.training.views[k]) & ~visible(self.training.views[k])) > 0.5
        if hidden.any() and there.any():
            pixels, score = by_pixels[hidden].abs().median(), by_score[torch.from_numpy(there)].abs().median() * area
            step = self.first_step + self.step + 1
            self.ledger.event_once(ScoreMeasured(step, round(float(pixels), 6), round(float(score), 6)))


class Stage3(BigPoseFit[OccFusionAvatar]):
    """Goes on behind stage 1, with density control, now also to the generated images [H, W, 3] of some views. Steps
    are counted on."""

    name, title = STAGE3, "stage 3"

    def __init__(
        self,
        avatar: OccFusionAvatar,
        training: TrainingSet,
        masks: CompleteMasks,
        generated: dict[int, NDArray[np.uint8]],
        seed: int,
        ledger: Ledger,
    ):
        config, views = avatar.config, training.views
        self._shown = shown(training)
        super().__init__(
            avatar, training, seed, ledger, with_pixels(config.density, config.least_px, training),
            steps=config.refine.steps, views=len(self._shown), first_step=config.steps,
        )  # fmt: skip
        self._targets = LazyViews(
            lambda k: prepare_target(
                avatar, views[k], training.background, masks.of(k, views[k]), generated.get(k),
                masks.undecided(k, views[k]),
            ),
            len(views),
            held=TARGETS_HELD,
        )  # fmt: skip

    def go_on_from(self, stage1: Stage1) -> None:
        """Take over Adam's moments, in stage 1's scale as released or in that of this stage's loss."""
        config = self.avatar.config
        scale = 1.0 if config.refine.moments == "released" else 1 / max(config.pixels, 1e-30)
        tensors = {}
        for name, value in stage1._tensors().items():
            power = 1 if name.endswith(".exp_avg") else 2 if name.endswith(".exp_avg_sq") else 0
            tensors[name] = value.detach() * scale**power if power else value.detach().clone()
        self._put(tensors)

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        self._load_perceptual(self.avatar.config.refine.lpips)
        super().run(progress)

    def _loss(self, k: int) -> Tensor:
        avatar = self.avatar
        target: Target = self._targets[self._shown[k]]
        posed: Posed = avatar.posed(target.frame)
        rgb, alpha = self._draw(posed, target.camera, self.training.background, target.width, target.height)
        return refine_loss(rgb, alpha, target, avatar.config, self._perceptual)
