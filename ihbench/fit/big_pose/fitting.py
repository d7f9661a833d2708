"""Optimising Gaussians in the big pose: their rates, what counts as small, what a step does beside its loss."""

from __future__ import annotations

from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.fit.big_pose.avatar import BigPoseAvatar
from ihbench.fit.big_pose.config import BigPoseConfig
from ihbench.fit.big_pose.deformation import Posed
from ihbench.fit.gaussians.adam import Rate
from ihbench.fit.gaussians.density import DensityChanged, DensityRules, farther_than
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.harmonics import DC, REST
from ihbench.fit.gaussians.optimisation import EPS, GaussianOptimisation
from ihbench.fit.losses import Perceptual, perceptual
from ihbench.fit.optimisation import ParameterGroup
from ihbench.scene.contracts import TrainingSet

TARGETS_HELD = 256  # prepared views kept in memory, about 2 MB each in the paper profiles
REST_SHARE = 1 / 20  # of the step size of degree 0, for spherical harmonics above
SMALLEST_POSITION_RATE = 0.01  # of the first

Colour = tuple[float, float, float]
Fitted = TypeVar("Fitted", bound=BigPoseAvatar)


def rates(config: BigPoseConfig) -> dict[str, Rate]:
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


def with_pixels(density: DensityConfig, least_px: float, training: TrainingSet) -> DensityConfig:
    """Density control by which what is up to so many pixels at the body's depth counts as small."""
    return replace(density, size=max(density.size, least_px * pixel_size(training)))


def pixel_size(training: TrainingSet) -> float:
    """Metres a pixel covers at the root's depth, median over the views that it stands in front of; 0 for none."""
    sizes = []
    for view in training.views:
        camera, root = view.camera, training.body.posed_joints(view.body_pose)[0]
        depth = camera.to_camera(root)[2]
        if depth > 0:
            sizes.append(depth / np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    return float(np.median(sizes)) if sizes else 0.0


class BigPoseFit(GaussianOptimisation[Fitted], Generic[Fitted]):
    """A stage of such a fit. Gaussians carry the vertex they take their weights from; both networks share a rate."""

    def __init__(
        self,
        avatar: Fitted,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        density: DensityConfig,
        *,
        steps: int,
        views: int,
        first_step: int = 0,
    ):
        config = avatar.config
        networks = [n for n in (avatar.pose_correction, avatar.weight_offsets) if n is not None]
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            [ParameterGroup([p for n in networks for p in n.parameters()], config.lr_networks, eps=EPS)],
            rates(config),
            density,
            DensityRules(unwanted=farther_than(avatar.deformation.vertices, config.distance)),
            steps=steps,
            views=views,
            first_step=first_step,
        )
        self._perceptual: Perceptual | None = None

    def _load_perceptual(self, weight: float) -> None:
        """LPIPS, if it has a weight; an event says so when its own weights are missing."""
        if weight > 0:
            distance = perceptual(self.avatar.config.lpips_net, self.avatar.device)
            if isinstance(distance, str):
                self.ledger.event_once(LeftOut("lpips term", distance))
            else:
                self._perceptual = distance

    def _draw(
        self, posed: Posed, camera: Camera, background: Colour, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """rgb [h, w, 3] and alpha [h, w] in a window of an image of this size in px, whose screen gradient density
        control will see."""
        rgb, alpha, screen = self.avatar.draw(posed, camera, background, ("rgb", "alpha", "screen"))
        if torch.is_grad_enabled():
            self.observe(screen, width, height)
        return rgb, alpha

    def _before_step(self) -> None:
        config, done = self.avatar.config, self.first_step + self.step
        self.avatar.degree = config.degree_at(done + 1)
        if self.step % config.nearest_every == 0:
            self.avatar.refresh_vertices()

    def _restored(self) -> None:
        # as the last step had it
        self.avatar.degree = self.avatar.config.degree_at(self.first_step + self.step)

    def _rearranged(self, changed: DensityChanged) -> None:
        self.avatar.refresh_vertices()
