"""The optimisation of OccGaussian: GauHuman's loss where pixels are known, and what trains the query.

L = L_box(known pixels, band excepted) + complete mean_hidden (1 - α)² + band mean_band |I - I*| + smooth roughness
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.big_pose.avatar import VERTEX
from ihbench.fit.big_pose.fitting import TARGETS_HELD, BigPoseFit, Colour, with_pixels
from ihbench.fit.big_pose.target import Target, body_silhouette, box_loss, prepare_target
from ihbench.fit.gaussians.adam import Rate
from ihbench.fit.gaussians.density import Mask
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.fit.gaussians.gaussian_set import Gaussians
from ihbench.fit.losses import masked_mean
from ihbench.methods.occgaussian.avatar import OccGaussianAvatar, Shown
from ihbench.methods.occgaussian.band import Band, draw_band
from ihbench.methods.occgaussian.config import OccGaussianConfig
from ihbench.methods.occgaussian.sightings import Sightings
from ihbench.methods.occgaussian.spec import STATE
from ihbench.scene.contracts import MaskState, TrainingSet
from ihbench.scene.views import LazyViews

WHITE: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class OccludedTarget:
    """A training view, and where the occluder hides the posed body in it."""

    known: Target
    hidden: Tensor  # [h, w, 1] 1 where it is UNKNOWN and the body covers it


def density(config: OccGaussianConfig, training: TrainingSet) -> DensityConfig:
    """Density control as the scene has it (as GauHuman's)."""
    resets = set(config.density.resets)
    if training.background == WHITE and config.white_reset > 0:
        resets.add(config.white_reset)
    return replace(with_pixels(config.density, config.least_px, training), resets=tuple(sorted(resets)))


class OccGaussianFit(BigPoseFit[OccGaussianAvatar]):
    """Each step draws one view; every few steps a band of it is hidden from the encoder."""

    name, title = STATE, "gaussians"

    def __init__(
        self,
        avatar: OccGaussianAvatar,
        training: TrainingSet,
        seed: int,
        ledger: Ledger,
        sightings: Sightings | None,  # None: without features
    ):
        config, views = avatar.config, training.views
        super().__init__(
            avatar, training, seed, ledger, density(config, training), steps=config.steps, views=len(views)
        )
        self.background: Colour = training.background
        self.sightings = sightings
        self._targets = LazyViews(self._target, len(views), held=TARGETS_HELD)
        if sightings is None:
            return
        own = [p for net in (avatar.encoder, avatar.decoder) if net is not None for p in net.parameters()]
        self.optimizer.add_param_group({"params": own, "lr": config.features.lr, "weight_decay": 0.0, "eps": 1e-8})
        self.rates.append(config.features.lr)
        self._frozen = [p for p in self._frozen if all(p is not mine for mine in own)]
        self._rate = _falling(config)
        for name, counts in (("seen", sightings.seen), ("hidden", sightings.hidden)):
            avatar.get_buffer(name).copy_(torch.from_numpy(counts))
        spared = config.spare_hidden and not config.two_state
        self.density.rules = replace(
            self.density.rules,
            may_grow=self._on(avatar.seen > 0),
            spared=self._on((avatar.seen <= 0) | (avatar.hidden > avatar.seen)) if spared else None,
        )

    def run(self, progress: Progress) -> None:
        """As `Optimisation.run`; an event says so when LPIPS is wanted and its weights are missing."""
        self._load_perceptual(self.avatar.config.lpips)
        super().run(progress)

    def _on(self, vertices: Tensor) -> Mask:  # [V] bool
        """The Gaussians that carry one of these vertices."""

        def chosen(gaussians: Gaussians) -> Tensor:
            return vertices[gaussians.carried(VERTEX)]

        return chosen

    def _target(self, k: int) -> OccludedTarget:
        avatar, view = self.avatar, self.training.views[k]
        known = prepare_target(avatar, view, self.background)
        height, width = known.image.shape[:2]
        # the window's place in the image, from the shift of the principal point
        x0, y0 = (round(float(view.camera.K[axis, 2] - known.camera.K[axis, 2])) for axis in (0, 1))
        unknown = view.mask[y0 : y0 + height, x0 : x0 + width] == MaskState.UNKNOWN
        hidden = unknown & body_silhouette(avatar, known.camera, view.body_pose)
        return OccludedTarget(known, torch.from_numpy(hidden[..., None].astype(np.float32)).to(avatar.device))

    # --- the loss ---

    def _loss(self, k: int) -> Tensor:
        target = self._targets[k]
        band = self._band(k, target.known)
        return self._loss_with(k, target, band)

    def _loss_with(self, k: int, target: OccludedTarget, band: Band | None) -> Tensor:
        config, known = self.avatar.config, target.known
        under = None if band is None else band.mask(known.colours)
        shown = None if self.sightings is None else self._shown(k, known, band)
        rgb, alpha = self._picture(known, shown)
        if under is not None:
            known = _without(known, under)
        loss = box_loss(rgb, alpha, known, config, self._perceptual)
        if config.complete > 0 and not config.two_state:
            missing = ((1 - alpha[..., None]).square() * target.hidden).sum()
            loss = loss + config.complete * missing / target.hidden.sum().clamp(min=1)
        if under is not None:
            person = under * target.known.person
            loss = loss + config.band.weight * masked_mean((rgb - known.image).abs(), person)
        if shown is not None and config.smooth > 0:
            loss = loss + config.smooth * shown.roughness
        return loss

    def _picture(self, known: Target, shown: Shown | None) -> tuple[Tensor, Tensor]:
        """rgb and alpha of the window; density control sees the screen gradient."""
        avatar, posed = self.avatar, self.avatar.posed(known.frame)
        outputs = ("rgb", "alpha", "screen")
        rgb, alpha, screen = avatar.drawn(posed, shown).draw(known.camera, self.background, outputs)
        if torch.is_grad_enabled():
            self.observe(screen, known.width, known.height)
        return rgb, alpha

    def _band(self, k: int, known: Target) -> Band | None:
        config = self.avatar.config.band
        if self.sightings is None or config.weight == 0 or config.most == 0 or self.step % config.every:
            return None
        person = (known.person[..., 0] > 0).cpu().numpy()
        return draw_band(config, person, self.sightings.views[k], self.seed, self.step)

    def _shown(self, k: int, known: Target, band: Band | None) -> Shown:
        """Attributes in a training view: what the occluder or the band hides in it asks, though others show it."""
        assert self.sightings is not None
        look = self.sightings.views[k]
        dropped = None if band is None else band.vertices
        more = look.hidden if dropped is None else np.concatenate([look.hidden, dropped])
        query = self.avatar.ask(more, dropped)
        return self.avatar.shown(query, self._features(k, known, band))

    def _features(self, k: int, known: Target, band: Band | None) -> Tensor:
        """[V, size] the memory with this view's features added, through which alone gradients go."""
        assert self.sightings is not None
        avatar, look = self.avatar, self.sightings.views[k]
        features, weight = self._read(known, band, look.xy), torch.from_numpy(look.cosine).to(avatar.device)
        vertices = torch.from_numpy(look.seen).to(avatar.device)
        total = avatar.memory.index_add(0, vertices, weight[:, None] * features)
        number = avatar.memory_weight.index_add(0, vertices, weight)
        return total / number.clamp(min=1e-6)[:, None]

    def _read(self, known: Target, band: Band | None, xy: np.ndarray) -> Tensor:
        """[n, size] of a masked image; the band is masked, too."""
        assert self.avatar.encoder is not None
        image, person = known.image, known.person
        if band is not None:
            under = band.mask(person)
            image = torch.where(under > 0, image.new_tensor(self.background), image)
            person = person * (1 - under)
        return self.avatar.encoder(torch.cat([image, person], 2), torch.from_numpy(xy).to(image.device))

    # --- the memory ---

    def _before_step(self) -> None:
        super()._before_step()
        if self.sightings is not None:
            self.rates[-1] = self._rate.at(self.step)
            if self.step % self.avatar.config.features.every == 0:
                self.remember()

    @torch.no_grad()
    def remember(self) -> None:
        """Read the features of all key views anew."""
        assert self.sightings is not None
        avatar = self.avatar
        avatar.memory.zero_()
        avatar.memory_weight.zero_()
        for k in self.sightings.key.tolist():
            look = self.sightings.views[k]
            if len(look.seen):
                vertices, weight = torch.from_numpy(look.seen), torch.from_numpy(look.cosine)
                vertices, weight = vertices.to(avatar.device), weight.to(avatar.device)
                features = self._read(self._targets[k].known, None, look.xy)
                avatar.memory.index_add_(0, vertices, weight[:, None] * features)
                avatar.memory_weight.index_add_(0, vertices, weight)

    def _check_end(self) -> None:
        if self.sightings is not None:
            self.remember()  # what is drawn from now on has the features of the last encoder
        super()._check_end()


def _falling(config: OccGaussianConfig) -> Rate:
    first, last = config.features.lr, config.features.lr_last
    return Rate(first, last, config.steps) if first > 0 and last > 0 else Rate(first)


def _without(known: Target, under: Tensor) -> Target:
    """The target without colours and windows under a band."""
    rest = 1 - under
    blind = torch.maximum(known.blind, under)
    return replace(known, colours=known.colours * rest, window=known.window * rest, blind=blind)
