"""OccGaussian as a registered method (Ye, Zhang, Liao, ICMR 2025)."""

from __future__ import annotations

from pathlib import Path

from ihbench.body import Body
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.visible_person import require_visible_person
from ihbench.methods.occgaussian.avatar import OccGaussianAvatar
from ihbench.methods.occgaussian.config import OccGaussianConfig
from ihbench.methods.occgaussian.fitting import OccGaussianFit
from ihbench.methods.occgaussian.sightings import look_through
from ihbench.scene.contracts import TrainingSet


class OccGaussian:
    """Skinned Gaussians fitted to what the training views show, hidden ones from their seen neighbours."""

    def __init__(self, config: OccGaussianConfig):
        self.config = config

    def fit(
        self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress
    ) -> OccGaussianAvatar:
        """Fit one person. See `scene.contracts.Method`. Raises `BadInput` without a view that shows the person, and
        `Diverged` also where density control would leave no Gaussian."""
        require_visible_person(training)
        with ledger.stage("fit/prepare"):
            avatar = OccGaussianAvatar(self.config, training.body, seed).to(device)
        with ledger.stage("fit/sightings"):
            on = self.config.features.on
            sightings = look_through(training.views, training.body, self.config) if on else None
            fit = OccGaussianFit(avatar, training, seed, ledger, sightings)
        with ledger.stage("fit/gaussians"):
            fit.run(progress)
        return avatar

    def load(self, folder: Path, body: Body, device: str = "cpu") -> OccGaussianAvatar:
        """Read an avatar written by `OccGaussianAvatar.save`."""
        return OccGaussianAvatar.load(folder, body, device)
