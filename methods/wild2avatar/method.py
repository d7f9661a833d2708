"""Wild2Avatar as a registered method (Xiang, Sun, Delp, Kozuka, Fei-Fei, Adeli, TPAMI 2025)."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.training_poses import TrainingPoses
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.wild2avatar.avatar import Wild2AvatarAvatar
from ihbench.methods.wild2avatar.config import Wild2AvatarConfig
from ihbench.methods.wild2avatar.fitting import Wild2AvatarFit
from ihbench.scene.contracts import TrainingSet


class Wild2Avatar:
    """Three fields fitted to the training views in one go, after the person's has been made the body."""

    def __init__(self, config: Wild2AvatarConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> Wild2AvatarAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        `Diverged`."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            betas = mean_betas(training.views, ledger, "the avatar")
            poses = TrainingPoses.of(training.views)
            avatar = Wild2AvatarAvatar(self.config, training.body, betas, poses, seed).to(device)
            fit = Wild2AvatarFit(avatar, training, seed, ledger)
        with ledger.stage("fit/fields"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> Wild2AvatarAvatar:
        """Read an avatar written by `Wild2AvatarAvatar.save`."""
        return Wild2AvatarAvatar.load(folder, body, device)
