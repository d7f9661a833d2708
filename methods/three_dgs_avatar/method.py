"""3DGS-Avatar as a registered method (Qian, Wang, Mihajlovic, Geiger, Tang, CVPR 2024)."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.training_poses import TrainingPoses
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.three_dgs_avatar.avatar import ThreeDgsAvatar
from ihbench.methods.three_dgs_avatar.config import ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.fitting import ThreeDgsAvatarFit
from ihbench.scene.contracts import TrainingSet


class ThreeDgsAvatarMethod:
    """Deformed and skinned Gaussians fitted to the training views in one go."""

    def __init__(self, config: ThreeDgsAvatarConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> ThreeDgsAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        `Diverged` also where density control would leave no Gaussian."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            betas = mean_betas(training.views, ledger, "the avatar")
            poses = TrainingPoses.of(training.views)
            avatar = ThreeDgsAvatar(self.config, training.body, betas, poses, seed).to(device)
            fit = ThreeDgsAvatarFit(avatar, training, seed, ledger)
        with ledger.stage("fit/gaussians"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> ThreeDgsAvatar:
        """Read an avatar written by `ThreeDgsAvatar.save`."""
        return ThreeDgsAvatar.load(folder, body, device)
