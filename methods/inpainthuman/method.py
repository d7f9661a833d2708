"""InpaintHuman as a registered method: fit what is seen, paint what is not, refine on both (sec. 3.4)."""

from __future__ import annotations

from pathlib import Path

import torch

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.precision import DTYPES, Computed, choose
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.config import InpaintHumanConfig
from ihbench.methods.inpainthuman.stages.stage1 import Stage1
from ihbench.scene.contracts import TrainingSet


class InpaintHuman:
    """Multi-scale UV Gaussians fitted to the visible pixels, personalised inpainting of the hidden, refinement."""

    def __init__(self, config: InpaintHumanConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> GaussianAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person."""
        require_visible_person(training)
        inpaint = self.config.inpaint
        with ledger.stage("fit/prepare"):
            if self.config.paints and inpaint.uses_diffusion and inpaint.names_something:
                from ihbench.diffusion.diffusion_inpainter import check_backbone

                check_backbone(inpaint)
            if self.config.paints and inpaint.silhouette == "sam":
                from ihbench.diffusion.complete_silhouette import check_sam

                check_sam(inpaint.sam_weights)
            betas = mean_betas(training.views, ledger, "the avatar")
            avatar = GaussianAvatar(self.config, training.body, betas, seed).to(device)
            avatar.fit_dtype = self._precision(device, ledger)
        with ledger.stage("fit/stage1"):
            Stage1(avatar, training, seed, ledger).run(progress)
        if self.config.paints:
            # imported here: a run without inpainting must not pay for it
            from ihbench.methods.inpainthuman.stages.stage2 import Stage2
            from ihbench.methods.inpainthuman.stages.stage3 import Stage3

            with ledger.stage("fit/stage2"):
                painted = Stage2(avatar, training, inpaint, seed, ledger).run(progress)
            with ledger.stage("fit/stage3"):
                Stage3(avatar, training, painted, seed, ledger).run(progress)
        return avatar

    def _precision(self, device: str, ledger: Ledger) -> torch.dtype:
        """As the record says that the run began, else chosen now and put there."""
        said = [event.data["precision"] for event in ledger.events if event.kind == Computed.kind]
        if not said:
            computed = choose(self.config.precision, device)
            ledger.event(computed)
            said = [computed.precision]
        return DTYPES[said[-1]]

    def load(self, folder: Path, body: Body, device: str = "cpu") -> GaussianAvatar:
        """Read an avatar written by `GaussianAvatar.save`."""
        return GaussianAvatar.load(folder, body, device)
