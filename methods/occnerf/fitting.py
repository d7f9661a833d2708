"""The optimisation of OccNeRF, step by step, with everything needed to stop after any step and go on later.

A step looks at patches of one training view on a background of a colour of its own, changes networks, grid,
displacements and motion weights together, and then counts the vertices that ended its rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, cast

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.losses import Perceptual, where_known
from ihbench.fit.optimisation import ParameterGroup
from ihbench.fit.rays.marching import MarchedPixels, march_pixels, wanted_colors
from ihbench.fit.rays.optimisation import DEPTHS, PIXELS, FieldOptimisation
from ihbench.fit.rays.patch_loss import patch_distance, patch_loss
from ihbench.fit.rays.ray_target import RayTarget
from ihbench.fit.rays.sampling import Pixels, draw_patches
from ihbench.methods.occnerf.avatar import OccNerfAvatar
from ihbench.methods.occnerf.canonical_surface import NEIGHBOURS
from ihbench.methods.occnerf.completeness import Completeness, completeness
from ihbench.methods.occnerf.config import OccNerfConfig
from ihbench.methods.occnerf.field import SurfaceValues, decoded
from ihbench.methods.occnerf.spec import STATE
from ihbench.methods.occnerf.visibility import count_seen, ends_of_rays
from ihbench.render.volumes.intervals import box_interval
from ihbench.scene.contracts import MaskState, TrainingSet

NOTED_EVERY = 50  # steps between two notes of the prior's value


@dataclass(frozen=True)
class PriorNoted:
    """What the completeness prior cost, by where its samples lie, and how much the vertices were seen."""

    kind: ClassVar[str] = "completeness"
    step: int
    body: float  # inside the body
    collapsed: float  # dropped onto the origin by the warp
    seen_vertices: float  # share of them that ended a ray so far
    moved_mm: float  # mean absolute displacement


def groups(avatar: OccNerfAvatar, config: OccNerfConfig) -> list[ParameterGroup]:
    return [
        ParameterGroup(list(avatar.decoder.parameters()), config.lr),
        ParameterGroup(list(avatar.grid.parameters()), config.lr_grid),
        ParameterGroup([avatar.displacement], config.lr_displacement),
        ParameterGroup(list(avatar.motion.parameters()), config.lr_motion),
    ]


class OccNerfFit(FieldOptimisation[OccNerfAvatar]):
    """See the module. Views without a visible pixel are not drawn."""

    name, title = STATE, "field"

    def __init__(self, avatar: OccNerfAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config = avatar.config
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups(avatar, config),
            steps=config.steps,
            decay_steps=config.decay_steps,
            unknown=config.unknown,
        )
        for group in self.optimizer.param_groups:
            group["betas"] = (0.9, config.second_moment)
        self._perceptual: Perceptual | None = None
        self._looked_at: MarchedPixels | None = None
        self._prior: Completeness | None = None

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        config = self.avatar.config
        if config.lpips > 0:
            self._perceptual = patch_distance(config.lpips_net, config.without_lpips, self.avatar.device, self.ledger)
        super().run(progress)

    @cached_property
    def _shown(self) -> list[int]:
        """Views that show a visible pixel."""
        return [k for k, view in enumerate(self.training.views) if (view.mask == MaskState.PERSON).any()]

    def _view_of(self, step: int, n: int) -> int:
        return self._shown[super()._view_of(step, len(self._shown))]

    # --- the loss ---

    def _loss(self, k: int) -> Tensor:
        avatar, config, target = self.avatar, self.avatar.config, self.targets[k]
        pixels = draw_patches(target, config.patches, config.patch_px, self.rng(PIXELS))
        volume, features = avatar.decode()
        background = self.random_background()
        shown = march_pixels(
            avatar.posed(target.body_pose, volume, features),
            target,
            pixels,
            config.samples,
            background,
            self.rng(DEPTHS),
            config.least,
            config.inside,
        )
        loss = self._image_loss(shown.rgb, target, pixels, background)
        prior = self._completeness(shown, target, pixels, features)
        if torch.is_grad_enabled():
            self._looked_at, self._prior = shown, prior
        return loss if prior is None else loss + config.completeness_weight * prior.total

    def _image_loss(self, rgb: Tensor, target: RayTarget, pixels: Pixels, background: Tensor) -> Tensor:
        config = self.avatar.config
        wanted, unknown = wanted_colors(target, pixels, background)
        if unknown.any():
            rgb, wanted = where_known(rgb, wanted, unknown[..., None].to(rgb))
        return patch_loss(rgb, wanted, config.mse, self._perceptual, config.lpips)

    def _completeness(
        self, shown: MarchedPixels, target: RayTarget, pixels: Pixels, features: Tensor
    ) -> Completeness | None:
        """Over as many samples as the rays have between the faces of the box: those of a second pass, which lie
        closer, stand for less than one each."""
        config, values = self.avatar.config, surface_values(shown)
        if config.completeness == "off":
            return None
        origin = None
        if config.completeness == "released":
            at = decoded(self.avatar, features, features.new_zeros(1, 3))
            origin = at.raw[0], at.inside[0]
        shares = None
        if config.inside:
            near, far = box_interval(shown.rays, *target.box.ends(features.dtype, features.device))
            apart = (far - near) / (config.samples - 1)
            own = (shown.depths[:, -1] - shown.depths[:, 0]) / (shown.depths.shape[1] - 1)
            shares = (own / apart)[:, None].expand_as(shown.depths)[shown.marched.active]
        rays = int(target.in_box[pixels.rows, pixels.columns].sum())
        return completeness(values.raw, values.inside, rays * config.samples, origin, shares)

    # --- the step ---

    def _check_gradients(self) -> None:
        """Clips everything together, as released."""
        super()._check_gradients()
        learned = [p for group in self.optimizer.param_groups for p in group["params"]]
        torch.nn.utils.clip_grad_norm_(learned, self.avatar.config.clip)

    @torch.no_grad()
    def _update(self) -> None:
        shown, prior = self._looked_at, self._prior
        self._looked_at = self._prior = None
        if shown is not None and self.avatar.config.visibility:
            count_seen(self.avatar.counters, ending_vertices(self.avatar, shown))
        super()._update()
        if prior is not None and (self.step + 1) % NOTED_EVERY == 0:
            self.ledger.event(
                PriorNoted(
                    self.step + 1,
                    round(float(prior.body), 6),
                    round(float(prior.collapsed), 6),
                    round(float((self.avatar.counters > 1).float().mean()), 4),
                    round(1000 * float(self.avatar.displacement.abs().mean()), 4),
                )
            )


def surface_values(shown: MarchedPixels) -> SurfaceValues:
    """What the field said of the samples that were evaluated."""
    return cast("SurfaceValues", shown.marched.values)


@torch.no_grad()
def ending_vertices(avatar: OccNerfAvatar, shown: MarchedPixels) -> Tensor:
    """[N, 10] int64: of each ray that ends somewhere, the displaced vertices nearest to where it does."""
    from scipy.spatial import KDTree

    marched, values = shown.marched, surface_values(shown)
    ends, at = ends_of_rays(marched.alpha, marched.composited.weights, shown.depths)
    place = torch.full_like(marched.active, -1, dtype=torch.int64)
    place[marched.active] = torch.arange(len(values.canonical), device=place.device)
    which = place.gather(1, at[:, None])[ends, 0]
    points = values.canonical[which[which >= 0]].double().cpu().numpy()
    if not len(points):
        return torch.empty(0, NEIGHBOURS, dtype=torch.int64, device=place.device)
    tree = KDTree(avatar.displaced().double().cpu().numpy())
    near = np.asarray(tree.query(points, NEIGHBOURS)[1], np.int64)
    return torch.from_numpy(near).to(place.device)
