"""The optimisation of HumanNeRF: patches of a view on a random colour each step, and the guard against empty fits."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.events import Warned
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.losses import Perceptual, where_known
from ihbench.fit.optimisation import ParameterGroup
from ihbench.fit.rays.marching import march_pixels, wanted_colors
from ihbench.fit.rays.optimisation import DEPTHS, PIXELS, FieldOptimisation
from ihbench.fit.rays.patch_loss import patch_distance, patch_loss
from ihbench.fit.rays.sampling import draw_patches
from ihbench.methods.humannerf.avatar import HumanNerfAvatar
from ihbench.methods.humannerf.spec import STATE
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scene.spread import spread

LOOKED_AT, LOOKED_PX = 16, 32  # pictures of the guard, and their longer side; the released ones have all pixels
NOTHING = 5 / 255  # of the background everywhere: an empty picture
MOST_RESTARTS = 5


def groups(avatar: HumanNerfAvatar) -> list[ParameterGroup]:
    """What is fitted, with its learning rates."""
    config = avatar.config
    of = [(avatar.canonical, config.lr), (avatar.motion, config.lr_motion)]
    if avatar.non_rigid is not None:
        of.append((avatar.non_rigid, config.lr_non_rigid))
    if avatar.pose_correction is not None:
        of.append((avatar.pose_correction, config.lr_poses))
    return [ParameterGroup(list(module.parameters()), lr) for module, lr in of]


class ShowsNothing(Diverged):
    """A picture of the fit is background alone."""


class HumanNerfFit(FieldOptimisation[HumanNerfAvatar]):
    """Each step draws patches of one view."""

    name, title = STATE, "field"

    def __init__(self, avatar: HumanNerfAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config = avatar.config
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups(avatar),
            steps=config.steps,
            decay_steps=config.decay_steps,
            unknown=config.unknown,
            margin=config.box_margin,
        )
        self._perceptual: Perceptual | None = None

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`. Events say where another distance stands for LPIPS, whose weights are missing, and
        how often the fit started again."""
        config = self.avatar.config
        if config.lpips > 0:
            self._perceptual = patch_distance(config.lpips_net, config.without_lpips, self.avatar.device, self.ledger)
        super().run(progress)
        restarts = int(self.avatar.restarts)
        if restarts:
            self.ledger.event_once(Warned(f"started again {restarts} times: a picture showed nothing"))

    # --- the loss ---

    def _loss(self, k: int) -> Tensor:
        config, target = self.avatar.config, self.targets[k]
        background = self.random_background()
        patches = draw_patches(target, config.patches, config.patch_px, self.rng(PIXELS), config.on_person)
        field = self.avatar.posed(target.body_pose)
        shown = march_pixels(
            field, target, patches, config.samples, background, self.rng(DEPTHS), config.least, config.inside
        )
        image, unknown = wanted_colors(target, patches, background)
        rgb = shown.rgb
        if config.unknown == "ignore":
            rgb, image = where_known(rgb, image, unknown[..., None])
        share = self._perceptual_share()
        return patch_loss(rgb, image, config.mse, self._perceptual if share > 0 else None, config.lpips * share)

    def _perceptual_share(self) -> float:
        """Of the perceptual distance's weight, in this step."""
        alone = self.avatar.config.squared_first
        return min(max(self.step - alone, 0) / alone, 1.0) if alone else 1.0

    # --- the step ---

    def _rate_share(self) -> float:
        return super()._rate_share() * min((self.step + 1) / max(self.avatar.config.warm_up, 1), 1)

    def rng(self, what: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.step, what, int(self.avatar.restarts)))

    def _before_step(self) -> None:
        self.avatar.step = self.step
        if self.step in self.avatar.config.guard:
            self._look()
        self.avatar.step = self.step + 1

    def _restored(self) -> None:
        self.avatar.step = self.step  # the last one taken

    @torch.no_grad()
    def _look(self) -> None:
        """Raise `ShowsNothing` where a picture of somebody does (trainer.py:171-175, 242-255)."""
        views = [view for view in self.training.views if (view.mask == MaskState.PERSON).any()]
        for view in (views[k] for k in spread(len(views), LOOKED_AT)):
            share = LOOKED_PX / max(view.camera.width, view.camera.height)
            width, height = (max(round(share * n), 1) for n in (view.camera.width, view.camera.height))
            alpha = self.avatar.draw(view.camera.scaled(width, height), view.body_pose, (1.0, 1.0, 1.0)).alpha
            if alpha.max() <= NOTHING:
                raise ShowsNothing(self.step, f"the picture of frame {view.frame} shows nothing")

    def _roll_back(self, bad: Diverged) -> None:
        if not isinstance(bad, ShowsNothing):
            super()._roll_back(bad)
            return
        avatar, restarts = self.avatar, int(self.avatar.restarts) + 1
        if restarts > MOST_RESTARTS:
            raise Diverged(bad.step, f"{bad.reason}, after {MOST_RESTARTS} new starts") from bad
        fresh = HumanNerfAvatar(avatar.config, avatar.body, avatar.betas, restarted(self.seed, restarts))
        avatar.load_state_dict(fresh.state_dict())
        avatar.restarts.fill_(restarts)
        self.optimizer.state.clear()
        self.step, avatar.step, self.rolled_back = 0, 0, 0
        self._good = self._first_bad = self._usual = None


def restarted(seed: int, restarts: int) -> int:
    """The seed of the first weights after so many new starts; the released code starts with the same ones again."""
    return int(np.random.default_rng((seed, restarts)).integers(2**31)) if restarts else seed
