"""OccFusion as a registered method (Sun et al., NeurIPS 2024): silhouettes, a fit, generated images, refinement."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.backbone_choice import load_chosen, look_at_chosen
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.occfusion.alpha_score import AlphaScore
from ihbench.methods.occfusion.avatar import OccFusionAvatar
from ihbench.methods.occfusion.complete_masks import complete_masks
from ihbench.methods.occfusion.config import OccFusionConfig
from ihbench.methods.occfusion.fits import Stage1, Stage3
from ihbench.methods.occfusion.hidden import frames_to_paint
from ihbench.methods.occfusion.in_context import generated_images
from ihbench.scene.contracts import TrainingSet


class OccFusion:
    """Gaussians in the big pose, fitted twice, with a diffusion model before, in and between the fits."""

    def __init__(self, config: OccFusionConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> OccFusionAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person and
        for weights that are missing, and `Diverged` also where density control would leave no Gaussian."""
        require_visible_person(training)
        config = self.config
        with ledger.stage("fit/prepare"):
            avatar = OccFusionAvatar(config, training.body, seed).to(device)
            backbone = self._backbone(training, device, ledger)
        with ledger.stage("fit/stage0"):
            masks = complete_masks(training, config, backbone, seed, ledger, progress)
        with ledger.stage("fit/stage1"):
            score = AlphaScore(avatar, training, backbone, seed) if backbone is not None and config.distils else None
            stage1 = Stage1(avatar, training, masks, score, seed, ledger)
            stage1.run(progress)
        if config.refine.steps == 0:
            return avatar
        with ledger.stage("fit/stage2"):
            generated = {}
            if backbone is not None:
                generated = generated_images(avatar, training, backbone, seed, ledger, progress)
        with ledger.stage("fit/stage3"):
            stage3 = Stage3(avatar, training, masks, generated, seed, ledger)
            stage3.go_on_from(stage1)
            stage3.run(progress)
        return avatar

    def _backbone(self, training: TrainingSet, device: str, ledger: Ledger) -> Backbone | None:
        """None where nothing asks for it."""
        inpaint = self.config.inpaint
        if not inpaint.on:
            return None
        look_at_chosen(inpaint)
        if inpaint.silhouette == "sam":
            from ihbench.diffusion.complete_silhouette import check_sam

            check_sam(inpaint.sam_weights)
        if not self.config.distils and not frames_to_paint(training, self.config):
            ledger.event_once(LeftOut("inpainting", "no training view hides any of a person that it shows"))
            return None
        return load_chosen(inpaint, device)

    def load(self, folder: Path, body: Body, device: str = "cpu") -> OccFusionAvatar:
        """Read an avatar written by `OccFusionAvatar.save`."""
        return OccFusionAvatar.load(folder, body, device)
