"""HumanNeRF as a registered method."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.mean_betas import mean_betas
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.humannerf.avatar import HumanNerfAvatar
from ihbench.methods.humannerf.config import HumanNerfConfig
from ihbench.methods.humannerf.fitting import HumanNerfFit
from ihbench.scene.contracts import TrainingSet


class HumanNerfMethod:
    """A radiance field in the T-pose fitted to the training views in one go."""

    def __init__(self, config: HumanNerfConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> HumanNerfAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        `Diverged` also where every start ends in an empty picture."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            betas = mean_betas(training.views, ledger, "the T-pose")
            avatar = HumanNerfAvatar(self.config, training.body, betas, seed).to(device)
            fit = HumanNerfFit(avatar, training, seed, ledger)
        with ledger.stage("fit/field"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> HumanNerfAvatar:
        """Read an avatar written by `HumanNerfAvatar.save`."""
        return HumanNerfAvatar.load(folder, body, device)
