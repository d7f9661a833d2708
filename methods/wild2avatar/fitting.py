"""The optimisation of Wild2Avatar, step by step, with everything needed to stop after any step and go on later.

What is drawn at random (pixels, samples on rays, places of the eikonal term) depends on the seed and the step alone.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import Diverged
from ihbench.fit.optimisation import Optimisation, ParameterGroup
from ihbench.methods.wild2avatar.avatar import Wild2AvatarAvatar
from ihbench.methods.wild2avatar.layers import Layer, background_layer, occlusion_layer, together
from ihbench.methods.wild2avatar.losses import FULL, Rays, eikonal, ray_losses
from ihbench.methods.wild2avatar.person.human_rays import HumanMarch, HumanRays, march_human
from ihbench.methods.wild2avatar.person.inverse_skinning import PosedBody
from ihbench.methods.wild2avatar.person.near_body import unit_rays
from ihbench.methods.wild2avatar.spec import STATE
from ihbench.methods.wild2avatar.target import Target, middle, prepare_target
from ihbench.methods.wild2avatar.three_parts import FARTHEST_CAMERA, ThreeParts, inner_radius, three_parts
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

TARGETS_HELD = 128  # prepared views kept in memory, 3 MB each at 256 px
PIXELS, PLACES, SAMPLES = range(1, 4)  # what random numbers are drawn for
SPREAD = 0.01  # m, of the eikonal term's places about canonical vertices
LAST_SHARE = 0.05  # of the step sizes, under the cosine
HALVED_AT = (200, 500)  # epochs
WITHOUT_POSE = 20  # in every so-manieth epoch shape and colour do not see the pose


class Wild2AvatarFit(Optimisation[Wild2AvatarAvatar]):
    """Each step draws rays of one view through all three parts."""

    name, title = STATE, "fields"

    def __init__(self, avatar: Wild2AvatarAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        config, views = avatar.config, training.views
        field = avatar.field
        others = [*field.colour.parameters(), *([] if avatar.scene is None else avatar.scene.parameters())]
        groups = [
            ParameterGroup(list(field.sdf.parameters()), config.lr_sdf),
            ParameterGroup([field.beta], config.lr_beta),
            ParameterGroup(others, config.lr),
        ]
        if avatar.poses is not None:
            groups.append(ParameterGroup(list(avatar.poses.parameters()), config.lr_poses))
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            groups,
            steps=config.steps,
            views=len(views),
            lr_final=LAST_SHARE,
            clip_gradient=config.clip,
            warm_up=config.warm_up,
        )
        centres = [middle(training.body.pose(view.body_pose)) for view in views]
        away = [
            float(np.linalg.norm(view.camera.center - centre)) for view, centre in zip(views, centres, strict=True)
        ]
        self.unit = max(away) / FARTHEST_CAMERA  # m: a third of the outer sphere's radius
        self._targets = LazyViews(self._target, len(views), held=TARGETS_HELD)
        self._posed = LazyViews(self._posed_as_given, len(views), held=TARGETS_HELD)
        self._outline = avatar.outline_network()

    def _target(self, k: int) -> Target:
        view, avatar = self.training.views[k], self.avatar
        row = avatar.training_poses.row(view.frame)
        assert row is not None
        return prepare_target(view, row, self.training.body, avatar.config.scene == "network", avatar.device)

    def _posed_as_given(self, k: int) -> PosedBody:
        with torch.no_grad():
            return PosedBody(self.avatar.canonical, self.avatar.bones(self._targets[k].row))

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says how far poses have moved."""
        super().run(progress)
        if self.avatar.poses is not None:
            self.ledger.event_once(self.avatar.poses.moved(self.avatar.training_poses, self.avatar.betas))

    # --- schedules ---

    @property
    def epoch(self) -> int:
        return self.step // self.views

    @property
    def counted(self) -> float:
        """e of the terms that grow and fade: 0 to `FULL`."""
        return FULL * min(self.epoch / self.avatar.config.ramp_epochs, 1)

    def _rate_share(self) -> float:
        if self.avatar.config.decay == "cosine":
            return super()._rate_share()
        rise = min((self.step + 1) / max(self.warm_up * self.steps, 1), 1)
        return rise * math.prod(0.5 for epoch in HALVED_AT if self.epoch >= epoch)

    def _followed(self, row: int) -> Tensor | None:
        """[69] rad of the pose that shape and colour follow in this step; None for none."""
        avatar = self.avatar
        first = avatar.config.ramp_epochs * WITHOUT_POSE / FULL
        if not avatar.config.pose_conditioning or self.epoch < first or self.epoch % WITHOUT_POSE == 0:
            return None
        if avatar.poses is not None:
            return avatar.poses.poses[row, 1:].flatten()
        return torch.from_numpy(avatar.training_poses.poses[row, 1:].reshape(-1)).to(avatar.outline)

    # --- the loss ---

    def _rng(self, what: int) -> np.random.Generator:
        return np.random.default_rng((self.seed, self.step, what))

    def _loss(self, k: int) -> Tensor:
        avatar, config, target = self.avatar, self.avatar.config, self._targets[k]
        if not target.finite:
            frame = self.training.views[k].frame
            raise Diverged(self.step, f"loss is nan: frame {frame} has a pixel that is not finite")
        pixels = target.draw(config.rays, self._rng(PIXELS))
        generator = torch.Generator().manual_seed(int(self._rng(SAMPLES).integers(2**62)))
        human, occlusion, background = self._layers(k, target, pixels, generator)
        colours = together(occlusion, human, background)
        if config.layer_over == "unknown":
            bare = together(None, human, background)
            colours = torch.where(target.unknown[pixels][:, None], colours, bare)
        layer = None if occlusion is None else occlusion.alpha
        rays = Rays(pixels, colours, human.alpha, layer, human.beside)
        terms = ray_losses(rays, target, config, self.counted)
        loss = torch.stack(list(terms.values())).sum() if terms else colours.new_zeros(())
        if config.eikonal > 0:
            rng, vertices = self._rng(PLACES), avatar.canonical.vertices
            chosen = rng.integers(len(vertices), size=config.eikonal_points)
            noise = torch.from_numpy(SPREAD * rng.standard_normal((len(chosen), 3))).to(vertices)
            places = vertices[torch.from_numpy(chosen).to(vertices.device)] + noise
            gradient = avatar.field.sdf.with_gradient(places, self._followed(target.row))[2]
            loss = loss + config.eikonal * eikonal(gradient)
        return loss

    def parts(self, target: Target, pixels: Tensor) -> ThreeParts:
        """A view's rays cut at both spheres about the frame's centre, in units of a third of the outer radius."""
        rays = unit_rays(target.camera, pixels)
        origins = (rays.origins - target.center) / self.unit
        inner = inner_radius(target.reach / self.unit, origins[0].norm().item()) if len(origins) else 1.0
        return three_parts(origins, rays.directions, inner)

    def _layers(
        self, k: int, target: Target, pixels: Tensor, generator: torch.Generator | None
    ) -> tuple[HumanRays, Layer | None, Tensor]:
        """The person, the occlusion (None without it), and the colour behind them."""
        avatar, config = self.avatar, self.avatar.config
        parts = self.parts(target, pixels)
        posed = self._posed[k] if avatar.poses is None else PosedBody(avatar.canonical, avatar.bones(target.row))
        near, far = target.near[pixels], target.far[pixels]
        if config.interval == "spheres":
            near, far = parts.enter * self.unit, parts.leave * self.unit
        how = HumanMarch(
            avatar.counts,
            config.least_weight,
            cut=config.interval == "body",
            generator=generator,
            outline=self._outline,
            asked=~target.body[pixels],
        )
        rays = unit_rays(target.camera, pixels)
        human = march_human(avatar.field, posed, rays, near, far, self._followed(target.row), how)
        occlusion = None
        background = near.new_tensor(self.training.background)
        samples, scene = config.scene_samples, avatar.scene
        if scene is not None and config.occlusion:
            occlusion = occlusion_layer(scene, parts, target.row, samples, generator)
        if scene is not None and config.scene == "network":
            background = background_layer(scene, parts, target.row, samples, generator).rgb
        return human, occlusion, background

    # --- the step ---

    def _before_step(self) -> None:
        every = self.avatar.config.refresh_epochs * self.views
        if self.step > 0 and self.step % every == 0:
            self.avatar.look_at_outline()
            self._outline = self.avatar.outline_network()

    def _restore(self) -> None:
        super()._restore()
        if self.step == 0:
            self.avatar.fit_to_body()
            self._outline = self.avatar.outline_network()

    def _restored(self) -> None:
        self._outline = self.avatar.outline_network()
