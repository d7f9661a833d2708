"""OccNeRF as a registered method (Xiang, Sun, Wu, Adeli, Fei-Fei, ICCV 2023)."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.occnerf.avatar import OccNerfAvatar
from ihbench.methods.occnerf.config import OccNerfConfig
from ihbench.methods.occnerf.fitting import OccNerfFit
from ihbench.scene.contracts import TrainingSet


class OccNerf:
    """Surface features, networks and motion weights fitted to patches of the training views in one go."""

    def __init__(self, config: OccNerfConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> OccNerfAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            betas = mean_betas(training.views, ledger, "the T-pose")
            avatar = OccNerfAvatar(self.config, training.body, betas, seed).to(device)
            fit = OccNerfFit(avatar, training, seed, ledger)
        with ledger.stage("fit/field"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> OccNerfAvatar:
        """Read an avatar written by `OccNerfAvatar.save`."""
        return OccNerfAvatar.load(folder, body, device)
