"""GaussianAvatar as a registered method."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.gaussianavatar.avatar import TexelAvatar
from ihbench.methods.gaussianavatar.config import GaussianAvatarConfig
from ihbench.methods.gaussianavatar.stages import PoseStage, Stage1
from ihbench.scene.contracts import TrainingSet


class GaussianAvatar:
    """Whole images fitted by opaque Gaussians on the body; poses as given, no mask loss."""

    def __init__(self, config: GaussianAvatarConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> TexelAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            betas = mean_betas(training.views, ledger, "the avatar")
            avatar = TexelAvatar(self.config, training.body, betas, seed).to(device)
        with ledger.stage("fit/stage1"):
            stage1 = Stage1(avatar, training, seed, ledger)
            stage1.run(progress)
        if self.config.pose_stage:
            with ledger.stage("fit/stage2"):
                PoseStage(avatar, training, seed, ledger, stage1.steps).run(progress)
        if self.config.batch_norm == "mended":
            avatar.hold_statistics([view.body_pose for view in training.views])
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> TexelAvatar:
        """Read an avatar written by `TexelAvatar.save`."""
        return TexelAvatar.load(folder, body, device)
