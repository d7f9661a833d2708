"""The optimisation of 3DGS-Avatar, step by step, with everything needed to stop after any step and go on later.

What is drawn at random (noise on the pose code, turns of the view, places on the surface, LPIPS' window) depends on
the seed and the step alone.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.adam import Rate
from ihbench.fit.gaussians.density import DensityChanged, DensityRules
from ihbench.fit.gaussians.neighbours import nearest
from ihbench.fit.gaussians.optimisation import EPS, GaussianOptimisation
from ihbench.fit.losses import Perceptual, perceptual
from ihbench.fit.optimisation import ParameterGroup
from ihbench.methods.three_dgs_avatar.avatar import COLOUR, NEAREST, SEEN, Posed, ThreeDgsAvatar
from ihbench.methods.three_dgs_avatar.colours import random_turn
from ihbench.methods.three_dgs_avatar.config import ThreeDgsAvatarConfig
from ihbench.methods.three_dgs_avatar.isometry import NEIGHBOURS, six_entries, stretching
from ihbench.methods.three_dgs_avatar.spec import STATE
from ihbench.methods.three_dgs_avatar.target import (
    BLACK,
    Colour,
    Target,
    image_loss,
    perceptual_loss,
    prepare_target,
)
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 128  # prepared views kept in memory, 1 MB each in the quick profile, 4 MB in paper
NOISE, SURFACE, TURN, WINDOW, WARM_UP = range(1, 6)  # what random numbers are drawn for
LAST_SHARE = 0.1  # of the networks' step sizes, at the end
SMALLEST_POSITION_RATE = 0.01  # of the first


def rates(config: ThreeDgsAvatarConfig) -> dict[str, Rate]:
    """Learning rates of the Gaussians' attributes."""
    far, end = config.lr_position, SMALLEST_POSITION_RATE * config.lr_position
    return {
        "means": Rate(far, end, max(config.position_decay, 1)) if far > 0 else Rate(far),
        "log_scales": Rate(config.lr_scale),
        "quaternions": Rate(config.lr_rotation),
        "opacity_logits": Rate(config.lr_opacity),
        COLOUR: Rate(config.lr_feature),
    }


def groups(avatar: ThreeDgsAvatar) -> list[ParameterGroup]:
    """The networks and tables, with their learning rates."""
    config = avatar.config
    of = [
        (list(avatar.skinning.parameters()), config.lr_skinning),
        ([*avatar.colours.parameters(), avatar.latents], config.lr_colour),
    ]
    if avatar.non_rigid is not None:
        of.append((list(avatar.non_rigid.parameters()), config.lr_non_rigid))
    if avatar.poses is not None:
        of.append((list(avatar.poses.parameters()), config.lr_poses))
    return [ParameterGroup(parameters, lr, eps=EPS) for parameters, lr in of]


def skinning_weight(config: ThreeDgsAvatarConfig, number: int) -> float:
    """Of the skinning loss in step `number`."""
    return config.skinning_first if number < config.gaussians_from else config.skinning


def skinning_error(avatar: ThreeDgsAvatar, rng: np.random.Generator) -> Tensor:
    """The mean over fresh places on the surface of the squared difference from the body's weights, all joints'."""
    points, wanted = avatar.star.surface(rng, avatar.config.surface_samples)
    return (avatar.skinning(avatar.star.normalised(points)) - wanted).square().sum(1).mean()


def warm_up(avatar: ThreeDgsAvatar, seed: int) -> None:
    """Fit the skinning field alone to the body's weights, for as many steps as the configuration says."""
    config = avatar.config
    optimizer = torch.optim.Adam(avatar.skinning.parameters(), lr=config.lr_warm_up, eps=EPS, fused=True)
    for step in range(config.warm_up):
        optimizer.param_groups[0]["lr"] = config.lr_warm_up * LAST_SHARE ** (step / config.warm_up)
        optimizer.zero_grad()
        skinning_error(avatar, np.random.default_rng((seed, step, WARM_UP))).backward()
        optimizer.step()


class ThreeDgsAvatarFit(GaussianOptimisation[ThreeDgsAvatar]):
    """Each step draws one view. Networks learn from the first step, Gaussians, deformation and poses join later."""

    name, title = STATE, "gaussians"

    def __init__(self, avatar: ThreeDgsAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config, views = avatar.config, training.views
        self.background: Colour = BLACK if config.backdrop == "black" else training.background
        ignores = config.unknown == "ignore"
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups(avatar),
            rates(config),
            config.density,
            DensityRules(spared=lambda gaussians: ~gaussians.carried(SEEN)) if ignores else None,
            steps=config.steps,
            views=len(views),
        )
        self._targets = LazyViews(self._target, len(views), held=TARGETS_HELD)
        self._perceptual: Perceptual | None = None

    def _target(self, k: int) -> Target:
        view, avatar = self.training.views[k], self.avatar
        row = avatar.training_poses.row(view.frame)
        assert row is not None
        return prepare_target(view, row, self.background, avatar.config, avatar.device)

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing, another how far
        poses have moved."""
        config = self.avatar.config
        if config.lpips > 0:
            distance = perceptual(config.lpips_net, self.avatar.device)
            if isinstance(distance, str):
                self.ledger.event_once(LeftOut("lpips term", distance))
            else:
                self._perceptual = distance
        super().run(progress)
        if self.avatar.poses is not None and self.avatar.fits_poses:
            self.ledger.event_once(self.avatar.poses.moved(self.avatar.training_poses, self.avatar.betas))

    # --- the loss ---

    def _rng(self, what: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.step, what))

    def _loss(self, k: int) -> Tensor:
        avatar, target, config, number = self.avatar, self._targets[k], self.avatar.config, self.step + 1
        posed = avatar.posed(avatar.training_frame(target.row), self._noise())
        turn = None
        if config.view_noise != "off" and config.view_colours:
            turn = torch.from_numpy(random_turn(self._rng(TURN), config.view_noise)).to(posed.means)
        rgb, alpha, screen = render_gaussians(
            posed.means,
            posed.covariances,
            avatar.colours_of(posed, target.camera, target.row, turn),
            target.camera,
            self.background,
            opacities=avatar.gaussians.opacities,
            preset="3dgs",
            outputs=("rgb", "alpha", "screen"),
        )
        if torch.is_grad_enabled() and number > config.gaussians_from:
            self.observe(screen, target.camera.width, target.camera.height)
            if config.unknown == "ignore":
                self._note_seen(posed, target, screen.radius)
        loss = image_loss(rgb, alpha, target, config)
        if self._perceptual is not None and number % config.lpips_every == 0:
            weight = config.lpips * config.lpips_every
            distance = perceptual_loss(rgb, target, self._perceptual, config.lpips_px, self._rng(WINDOW))
            loss = loss + weight * distance
        return loss + self._skinning_loss(number) + self._isometry_loss(posed)

    def _noise(self) -> Tensor | None:
        """[24, 9] in every other step by chance. As released also on the root's, which is the identity."""
        spread, avatar = self.avatar.config.pose_noise, self.avatar
        if spread == 0 or not avatar.deforms or not torch.is_grad_enabled():
            return None
        rng = self._rng(NOISE)
        if rng.uniform() >= 0.5:
            return None
        return torch.from_numpy(spread * rng.standard_normal((24, 9))).to(avatar.gaussians.means)

    def _skinning_loss(self, number: int) -> Tensor | float:
        weight = skinning_weight(self.avatar.config, number)
        return weight * skinning_error(self.avatar, self._rng(SURFACE)) if weight > 0 else 0.0

    def _isometry_loss(self, posed: Posed) -> Tensor | float:
        avatar, config = self.avatar, self.avatar.config
        loss, neighbours = 0.0, avatar.gaussians.carried(NEAREST)
        if config.isometry > 0:
            loss = loss + config.isometry * stretching(avatar.gaussians.means, posed.means, neighbours)
        if config.isometry_shape > 0:
            shapes = (avatar.canonical_covariances(), posed.covariances)
            entries = (six_entries(each, config.shape_distance) for each in shapes)
            loss = loss + config.isometry_shape * stretching(*entries, neighbours)
        return loss

    @torch.no_grad()
    def _note_seen(self, posed: Posed, target: Target, radius: Tensor) -> None:
        """Mark the Gaussians whose centre lies on a pixel that is not unknown."""
        camera = target.camera
        places = camera.project(posed.means.detach().cpu().double().numpy())
        x, y, depth = np.nan_to_num(places, posinf=-1, neginf=-1).T
        inside = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        seen = torch.from_numpy(inside).to(radius.device) & (radius > 0)
        if target.known is not None:
            column, row = (np.where(inside, each, 0).astype(np.int64) for each in (x, y))
            seen &= target.known[torch.from_numpy(row), torch.from_numpy(column)] > 0
        self.avatar.gaussians.carried(SEEN).logical_or_(seen)

    # --- the step ---

    def _before_step(self) -> None:
        self.avatar.step = self.step + 1
        if self.step % self.avatar.config.neighbours_every == 0:
            self._find_neighbours()

    def _restore(self) -> None:
        super()._restore()
        if self.step == 0:
            warm_up(self.avatar, self.seed)

    def _restored(self) -> None:
        self.avatar.step = self.step  # the last one taken

    def _rearranged(self, changed: DensityChanged) -> None:
        self._find_neighbours()
        self.avatar.gaussians.carried(SEEN).zero_()

    def _find_neighbours(self) -> None:
        gaussians = self.avatar.gaussians
        if not gaussians.means.isfinite().all():
            return  # the guard will find it; a tree of them would raise
        numbers = nearest(gaussians.means, NEIGHBOURS)[1]
        setattr(gaussians, f"carried_{NEAREST}", numbers)

    def _rate_share(self) -> float:
        return LAST_SHARE ** (self.step / self.steps)

    def _check_gradients(self) -> None:
        """Also clips all networks and tables together, as released."""
        super()._check_gradients()
        learned = [p for group in self.optimizer.param_groups for p in group["params"]]
        torch.nn.utils.clip_grad_norm_(learned, self.avatar.config.clip)

    def _update(self) -> None:
        config, latents = self.avatar.config, self.avatar.latents
        if config.latent_decay > 0 and latents.grad is not None:
            # through Adam, which makes it a step of nearly the whole rate wherever there is no other gradient
            latents.grad.add_(latents.detach(), alpha=config.latent_decay)
        if self.step + 1 < config.gaussians_from:
            self.density.adam.zero_grad()
        super()._update()
