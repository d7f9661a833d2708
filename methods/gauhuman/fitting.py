"""The optimisation of GauHuman, step by step, with everything needed to stop after any step and go on later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.adam import Rate
from ihbench.fit.gaussians.density import DensityChanged, DensityRules, farther_than
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.optimisation import EPS, GaussianOptimisation
from ihbench.fit.losses import Perceptual, perceptual
from ihbench.fit.optimisation import ParameterGroup
from ihbench.methods.gauhuman.avatar import DC, REST, GauHumanAvatar
from ihbench.methods.gauhuman.config import GauHumanConfig
from ihbench.methods.gauhuman.spec import STATE
from ihbench.methods.gauhuman.target import BLACK, Colour, box_loss, prepare_target
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 256  # prepared views kept in memory, about 2 MB each in the paper profile
WHITE: Colour = (1.0, 1.0, 1.0)
REST_SHARE = 1 / 20  # of the step size of degree 0, for spherical harmonics above
SMALLEST_POSITION_RATE = 0.01  # of the first


def rates(config: GauHumanConfig) -> dict[str, Rate]:
    """Learning rates of the Gaussians' attributes."""
    far, end = config.lr_position, SMALLEST_POSITION_RATE * config.lr_position
    rates = {
        "means": Rate(far, end, config.position_decay) if far > 0 else Rate(far),
        "log_scales": Rate(config.lr_scale),
        "quaternions": Rate(config.lr_rotation),
        "opacity_logits": Rate(config.lr_opacity),
        DC: Rate(config.lr_colour),
    }
    return rates | ({REST: Rate(REST_SHARE * config.lr_colour)} if config.highest_degree > 0 else {})


def density(config: GauHumanConfig, training: TrainingSet, background: Colour) -> DensityConfig:
    """Density control as the scene has it: what counts as small in pixels, and the reset on a white background."""
    size = max(config.density.size, config.least_px * pixel_size(training))
    resets = set(config.density.resets)
    if background == WHITE and config.white_reset > 0:
        resets.add(config.white_reset)
    return replace(config.density, size=size, resets=tuple(sorted(resets)))


def pixel_size(training: TrainingSet) -> float:
    """Metres a pixel covers at the root's depth, median over the views that it stands in front of; 0 for none."""
    sizes = []
    for view in training.views:
        camera, root = view.camera, training.body.posed_joints(view.body_pose)[0]
        depth = camera.to_camera(root)[2]
        if depth > 0:
            sizes.append(depth / np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return float(np.median(sizes)) if sizes else 0.0


class GauHumanFit(GaussianOptimisation[GauHumanAvatar]):
    """Each step draws one view and compares it inside the box; five times in between the set of Gaussians changes."""

    name, title = STATE, "gaussians"

    def __init__(self, avatar: GauHumanAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config, views = avatar.config, training.views
        self.background: Colour = BLACK if config.backdrop == "black" else training.background
        networks = [n for n in (avatar.pose_correction, avatar.weight_offsets) if n is not None]
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            [ParameterGroup([p for n in networks for p in n.parameters()], config.lr_networks, eps=EPS)],
            rates(config),
            density(config, training, self.background),
            DensityRules(unwanted=farther_than(avatar.deformation.vertices, config.distance)),
            steps=config.steps,
            views=len(views),
        )
        self._targets = LazyViews(
            lambda k: prepare_target(avatar, views[k], self.background), len(views), held=TARGETS_HELD
        )
        self._perceptual: Perceptual | None = None

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        config = self.avatar.config
        if config.lpips > 0:
            distance = perceptual(config.lpips_net, self.avatar.device)
            if isinstance(distance, str):
                self._say_once("lpips term", distance)
            else:
                self._perceptual = distance
        super().run(progress)

    def _say_once(self, what: str, reason: str) -> None:
        """A resumed run has the event already."""
        if what not in [event.data["what"] for event in self.ledger.events if event.kind == LeftOut.kind]:
            self.ledger.event(LeftOut(what, reason))

    def _loss(self, k: int) -> Tensor:
        avatar, target = self.avatar, self._targets[k]
        posed = avatar.posed(target.frame)
        rgb, alpha, screen = render_gaussians(
            posed.means,
            avatar.covariances(posed),
            avatar.sh,
            target.camera,
            self.background,
            opacities=avatar.gaussians.opacities,
            sh_degree=avatar.degree,
            preset="3dgs",
            outputs=("rgb", "alpha", "screen"),
        )
        if torch.is_grad_enabled():
            self.observe(screen, target.width, target.height)
        return box_loss(rgb, alpha, target, avatar.config, self._perceptual)

    def _before_step(self) -> None:
        self.avatar.degree = self.avatar.config.degree_at(self.step + 1)
        if self.step % self.avatar.config.nearest_every == 0:
            self.avatar.refresh_vertices()

    def _restored(self) -> None:
        self.avatar.degree = self.avatar.config.degree_at(self.step)  # as the last step had it

    def _rearranged(self, changed: DensityChanged) -> None:
        self.avatar.refresh_vertices()
