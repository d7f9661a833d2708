"""GTU's optimisation, iteration by iteration: a photo, then a guess, both with one Adam."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.events import LeftOut
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.adam import Rate
from ihbench.fit.gaussians.density import DensityChanged, DensityRules
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.gaussian_set import Gaussians, to_logit
from ihbench.fit.gaussians.harmonics import DC, REST, Y00
from ihbench.fit.gaussians.optimisation import EPS, GaussianOptimisation
from ihbench.fit.losses import Perceptual, perceptual
from ihbench.fit.optimisation import ParameterGroup
from ihbench.methods.gtu.avatar import NONE, VERTEX, GtuAvatar
from ihbench.methods.gtu.config import GtuConfig
from ihbench.methods.gtu.guesser import Guesser
from ihbench.methods.gtu.schedule import photo_weight, sds_step
from ihbench.methods.gtu.spec import STATE
from ihbench.methods.gtu.target import prepare_target, reconstruction_loss, undecided
from ihbench.render.splats import Screen
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 256  # prepared views kept in memory
REST_SHARE = 1 / 20  # of the step size of degree 0, for spherical harmonics above
PUT_BACK_OPACITY = 0.01  # of a vertex that density control would have removed
CLAMP_BUT_EVERY = 10  # colours are clamped but in these iterations: the released test is inverted


@dataclass(frozen=True)
class PosesRefined:
    """How far the training frames' poses have moved; test poses are those given."""

    kind: ClassVar[str] = "poses_refined"
    frames: int
    median_deg: float  # of a frame's largest joint
    largest_deg: float


def rates(config: GtuConfig) -> dict[str, Rate]:
    """Learning rates of the Gaussians' attributes, of both steps of an iteration."""
    far, end = config.lr_position, config.lr_position_end
    falls = far > 0 and end > 0
    out = {
        "means": Rate(far, end, config.position_decay, config.position_hold) if falls else Rate(far),
        "log_scales": Rate(config.lr_scale),
        "quaternions": Rate(config.lr_rotation),
        "opacity_logits": Rate(config.lr_opacity),
        DC: Rate(config.lr_colour),
    }
    return out | ({REST: Rate(REST_SHARE * config.lr_colour)} if config.highest_degree > 0 else {})


def pruning_alone(config: GtuConfig) -> DensityConfig:
    """Density control once nothing grows any more: what is faint or far too large is pruned."""
    growing = config.density
    return replace(
        growing, clone="off", split=False, kl_merge=None, after=max(growing.before - 1, 0),
        before=max(config.prune_until, growing.before), largest=config.prune_largest, widest=None,
    )  # fmt: skip


def of_body(gaussians: Gaussians) -> Tensor:
    """[N] bool: the body's vertices, not what was made later."""
    return gaussians.carried(VERTEX) != NONE


class GtuFit(GaussianOptimisation[GtuAvatar]):
    """Each iteration draws one view; once score distillation has begun, a guess follows, and Adam steps again."""

    name, title = STATE, "gaussians"

    def __init__(
        self, avatar: GtuAvatar, training: TrainingSet, seed: int, ledger: Ledger, guesser: Guesser | None = None
    ):
        """`guesser` is None where the configuration asks for none. The avatar has the poses of the views."""
        config, views = avatar.config, training.views
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            [ParameterGroup(list(avatar.poses), config.lr_pose, eps=EPS)],
            rates(config),
            config.density,
            DensityRules(spared=of_body, stays=of_body, unwanted=lambda g: avatar.deformation.outside(g.means)),
            steps=config.steps,
            views=len(views),
        )
        self.guesser = guesser
        self._targets = LazyViews(lambda k: prepare_target(avatar, views[k]), len(views), held=TARGETS_HELD)
        self._perceptual: Perceptual | None = None
        self._start_scales = avatar.gaussians.log_scales.detach().clone()  # [V, 3] by vertex
        self._given = [p.detach().clone() for p in avatar.poses]
        self._phases = config.density, pruning_alone(config)

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; events say so when LPIPS is wanted and its weights are missing, and how far poses
        have moved."""
        config = self.avatar.config
        if config.lpips > 0:
            distance = perceptual(config.lpips_net, self.avatar.device)
            if isinstance(distance, str):
                self.ledger.event_once(LeftOut("lpips term", distance))
            else:
                self._perceptual = distance
        super().run(progress)
        self.ledger.event_once(self._poses_refined())

    # --- the photo ---

    def _backdrop(self) -> Tensor:
        """[3] this iteration's random colour."""
        colour = np.random.default_rng((self.seed, *b"backdrop", self.step)).uniform(size=3)
        return torch.from_numpy(colour).float().to(self.avatar.device)

    def _photo(self, k: int) -> tuple[Tensor, Tensor, Screen]:
        """L_rec and R of view k, and the screen."""
        avatar, target = self.avatar, self._targets[k]
        backdrop = self._backdrop()
        rgb, alpha, screen = avatar.draw(
            avatar.poses[k], target.joints, target.transl, target.camera, backdrop, ("rgb", "alpha", "screen")
        )
        loss = reconstruction_loss(rgb, target, backdrop, avatar.config, self._perceptual)
        return loss, undecided(alpha * target.keep[..., 0]), screen

    def _loss(self, k: int) -> Tensor:
        config = self.avatar.config
        weight = photo_weight(config, self.step + 1)
        loss, doubt, screen = self._photo(k)
        if torch.is_grad_enabled():
            target = self._targets[k]
            seen = _Weighed(screen, 1 / weight if config.statistics == "photos" else 1.0)
            self.observe(seen, target.width, target.height)
        return weight * loss + config.opaque * doubt

    # --- an iteration ---

    def _restored(self) -> None:
        self.avatar.degree = self.avatar.config.degree_at(self.step)  # as the last step had it

    def _before_step(self) -> None:
        self.avatar.degree = self.avatar.config.degree_at(self.step + 1)
        growing, pruning = self._phases
        self.density.config = growing if self.step + 1 < growing.before else pruning

    def _update(self) -> None:
        super()._update()
        iteration = self.step + 1
        k = sds_step(self.avatar.config, iteration)
        if k is not None and self.guesser is not None:
            self._guess(self.guesser, k, iteration)
        self._hold(iteration)

    def _guess(self, guesser: Guesser, k: int, iteration: int) -> None:
        """The iteration's second step, of the same Adam; what it would do to the pose is dropped."""
        config = self.avatar.config
        self._zero_grad()
        guess = guesser(k, self._view_of(self.step, self.views))
        doubt = config.opaque * photo_weight(config, iteration) * undecided(guess.alpha)
        (guess.loss + doubt).backward()
        self._check_gradients()
        if config.statistics == "released" and guess.screen.gradient is not None:
            self.density.observe(iteration, guess.screen.gradient, guess.screen.radius, guess.size, guess.size)
        self.density.adam.step(iteration)

    @torch.no_grad()
    def _hold(self, iteration: int) -> None:
        """What is put back after an iteration: colours into their range, vertices to their start or into the grid."""
        config, gaussians, adam = self.avatar.config, self.avatar.gaussians, self.density.adam
        if iteration % CLAMP_BUT_EVERY:
            gaussians.attributes[DC].clamp_(-0.5 / Y00, 0.5 / Y00)
        vertices = self.avatar.deformation.vertices
        own = of_body(gaussians)
        if iteration < config.reset_until:
            number = gaussians.carried(VERTEX)[own]
            gaussians.means[own] = vertices[number]
            gaussians.log_scales[own] = self._start_scales[number]
            floor = to_logit(torch.tensor(config.opacity_floor)).item()
            adam.set_rows("opacity_logits", own, gaussians.opacity_logits[own].clamp(min=floor))
        else:
            # beside the grid a Gaussian would collapse to a point; those of the body are never removed
            low = self.avatar.deformation.low
            high = low + self.avatar.deformation.side
            gaussians.means[own] = gaussians.means[own].clamp(low, high)

    @torch.no_grad()
    def _rearranged(self, changed: DensityChanged) -> None:
        """Vertices that would have been removed get their start scale back, and are faint."""
        adam, back = self.density.adam, self.density.kept_back
        if not back.any():
            return
        number = self.avatar.gaussians.carried(VERTEX)[back]
        adam.set_rows("log_scales", back, self._start_scales[number])
        faint = to_logit(torch.tensor(PUT_BACK_OPACITY)).item()
        adam.set_rows("opacity_logits", back, faint)

    def _poses_refined(self) -> PosesRefined:
        pairs = zip(self.avatar.poses, self._given, strict=True)
        degrees = np.rad2deg([float((now.detach() - given).norm(dim=1).max()) for now, given in pairs])
        moved = len(degrees)
        return PosesRefined(moved, round(float(np.median(degrees)), 3), round(float(degrees.max()), 3))


@dataclass(frozen=True)
class _Weighed:
    """A renderer's screen whose gradient counts so many times."""

    screen: Screen
    by: float

    @property
    def gradient(self) -> Tensor | None:
        gradient = self.screen.gradient
        return gradient if gradient is None or self.by == 1 else gradient * self.by

    @property
    def radius(self) -> Tensor:
        return self.screen.radius
