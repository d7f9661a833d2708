"""GauHuman as a registered method (Hu, Hu, Liu, CVPR 2024), and OccGauHuman, which is its configuration."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.gauhuman.avatar import GauHumanAvatar
from ihbench.methods.gauhuman.config import GauHumanConfig
from ihbench.methods.gauhuman.fitting import GauHumanFit
from ihbench.scene.contracts import TrainingSet


class GauHuman:
    """Skinned Gaussians fitted to the training views in one go."""

    def __init__(self, config: GauHumanConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> GauHumanAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        `Diverged` also where density control would leave no Gaussian."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            avatar = GauHumanAvatar(self.config, training.body, seed).to(device)
            fit = GauHumanFit(avatar, training, seed, ledger)
        with ledger.stage("fit/gaussians"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> GauHumanAvatar:
        """Read an avatar written by `GauHumanAvatar.save`."""
        return GauHumanAvatar.load(folder, body, device)
