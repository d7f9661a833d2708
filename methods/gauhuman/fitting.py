"""The optimisation of GauHuman, step by step, with everything needed to stop after any step and go on later."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.big_pose.fitting import TARGETS_HELD, BigPoseFit, with_pixels
from ihbench.fit.big_pose.target import BLACK, Colour, box_loss, prepare_target
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.gauhuman.avatar import GauHumanAvatar
from ihbench.methods.gauhuman.config import GauHumanConfig
from ihbench.methods.gauhuman.spec import STATE
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

WHITE: Colour = (1.0, 1.0, 1.0)


def density(config: GauHumanConfig, training: TrainingSet, background: Colour) -> DensityConfig:
    """Density control as the scene has it: what counts as small in pixels, and the reset on a white background."""
    resets = set(config.density.resets)
    if background == WHITE and config.white_reset > 0:
        resets.add(config.white_reset)
    return replace(with_pixels(config.density, config.least_px, training), resets=tuple(sorted(resets)))


class GauHumanFit(BigPoseFit[GauHumanAvatar]):
    """Each step draws one view and compares it inside the box; five times in between the set of Gaussians changes."""

    name, title = STATE, "gaussians"

    def __init__(self, avatar: GauHumanAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config, views = avatar.config, training.views
        self.background: Colour = BLACK if config.backdrop == "black" else training.background
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            density(config, training, self.background),
            steps=config.steps,
            views=len(views),
        )
        self._targets = LazyViews(
            lambda k: prepare_target(avatar, views[k], self.background), len(views), held=TARGETS_HELD
        )

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        self._load_perceptual(self.avatar.config.lpips)
        super().run(progress)

    def _loss(self, k: int) -> Tensor:
        target = self._targets[k]
        posed = self.avatar.posed(target.frame)
        rgb, alpha = self._draw(posed, target.camera, self.background, target.width, target.height)
        return box_loss(rgb, alpha, target, self.avatar.config, self._perceptual)
