"""Stage 1, canonical initialisation (sec. 3.4): fit the avatar to what the training views show of the person."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body.uv import nearest_texels
from ihbench.camera import Camera
from ihbench.clock.ledger import Ledger
from ihbench.fit.losses import dissimilarity, masked_mean, where_known
from ihbench.fit.optimisation import Optimisation, ParameterGroup
from ihbench.fit.surface_prior import SurfacePrior
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar, PosedPoints
from ihbench.methods.inpainthuman.config import InpaintHumanConfig
from ihbench.methods.inpainthuman.spec import STAGE1
from ihbench.render.splat import render_gaussians
from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.scene.sightings import FINE
from ihbench.scene.views import LazyViews

MARGIN = 0.15  # of the projected body's box on every side: garments and pose errors stay inside the window
TARGETS_HELD = 256  # prepared views kept in memory, about 2 MB each in the paper profile


@dataclass(frozen=True)
class Target:
    """What one step needs of a training view, cut to a window around the body."""

    camera: Camera
    image: Tensor  # [h, w, 3]
    person: Tensor  # [h, w, 1] 1 where the visible person is
    background: Tensor  # [h, w, 1] 1 where the background is known, and not beside unknown pixels
    points: Tensor  # [n] points that the body does not hide
    posed: PosedPoints  # of these
    links: SurfacePrior  # between these
    evident: Tensor  # [n] 1 where some training view shows the point
    position_map: Tensor | None


def prepare_target(avatar: GaussianAvatar, view: TrainView, surface: KnownSurface | None = None) -> Target:
    """Cut a training view to the body's window and find the points it can show. Without a `surface` all of it counts
    as seen, and nothing links one point to another."""
    surface = KnownSurface.all_seen(avatar) if surface is None else surface
    vertices = avatar.body.pose(view.body_pose, blend_shapes=False)
    x0, y0, width, height = fitted_window(avatar, view.camera, vertices)
    camera = view.camera.cropped(x0, y0, width, height)
    rows, cols = slice(y0, y0 + height), slice(x0, x0 + width)
    device = avatar.device
    mask = np.ascontiguousarray(view.mask[rows, cols])
    unknown = mask == MaskState.UNKNOWN
    image = view.image[rows, cols].astype(np.float32) / 255
    image = np.where(
        unknown[..., None] & ~np.isfinite(image), 0, image
    )  # a NaN there would pass through a weight of 0
    reach = avatar.config.background_rim * max(body_window(view.camera, vertices)[2:])
    clear = (mask == MaskState.BACKGROUND) & ~beside(view.mask == MaskState.UNKNOWN, reach)[rows, cols]
    shown = avatar.unhidden(camera, view.body_pose)
    points = torch.from_numpy(np.union1d(shown, surface.unfaced)).to(device)
    return Target(
        camera=camera,
        image=torch.from_numpy(image).to(device),
        person=torch.from_numpy(mask == MaskState.PERSON).to(device)[..., None].float(),
        background=torch.from_numpy(clear).to(device)[..., None].float(),
        points=points,
        posed=avatar.posed(points, avatar.transforms(view.body_pose)),
        links=surface.prior.among(points, len(avatar)),
        evident=surface.evident[points],
        position_map=avatar.position_map(view.body_pose),
    )


def beside(unknown: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """[H, W] pixels at most so many px from an unknown one, these included. Background there is not learned: it would
    pull hair and clothes at an occluder's edge to its own colour, and these would carry that into what is hidden."""
    if reach <= 0 or not unknown.any():
        return unknown
    return cv2.distanceTransform((~unknown).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach


def fitted_window(avatar: GaussianAvatar, camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """x0, y0, width, height in px of what a step draws: `body_window`, or the whole image where that is asked for."""
    return body_window(camera, vertices) if avatar.config.crop else (0, 0, camera.width, camera.height)


def body_window(camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """x0, y0, width, height in px of the projected body's box with a margin, inside the image; the whole image when
    the body is not wholly in front of the camera."""
    p = camera.project(vertices)
    if not (p[:, 2] > 0).all():
        return 0, 0, camera.width, camera.height
    low, high = p[:, :2].min(0), p[:, :2].max(0)
    pad = MARGIN * (high - low).max()
    x0, y0 = (
        int(np.clip(np.floor(v - pad), 0, limit - 1))
        for v, limit in zip(low, (camera.width, camera.height), strict=True)
    )
    x1, y1 = (
        int(np.clip(np.ceil(v + pad), 1, limit)) for v, limit in zip(high, (camera.width, camera.height), strict=True)
    )
    return x0, y0, max(x1 - x0, 1), max(y1 - y0, 1)


@dataclass(frozen=True)
class Drawn:
    """What the avatar shows of a target, and what it was decoded to."""

    rgb: Tensor  # [h, w, 3]
    offset: Tensor  # [n, 3] m
    scale: Tensor  # [n] m
    color: Tensor  # [n, 3]


def draw(avatar: GaussianAvatar, target: Target, background: tuple[float, float, float]) -> Drawn:
    """Decode, pose and splat the points of a target. Differentiable in the avatar's parameters."""
    config = avatar.config
    decay = 0.0 if config.paper_strict else 2 * config.feature_weight / avatar.features.table.numel()
    offset, scale, color = avatar.decode(target.points, target.position_map, decay)
    means = target.posed.moved(offset)
    return Drawn(render_gaussians(means, scale, color, target.camera, background)[0], offset, scale, color)


def initial_loss(avatar: GaussianAvatar, drawn: Drawn, target: Target) -> Tensor:
    """Mean L1 over visible person pixels, plus what the config adds to it. Unknown pixels never count.

    Both L1 terms are divided by the number of visible pixels, so a spill of one pixel into known background weighs
    as much as one wrong person pixel, whatever the window's size.
    """
    config = avatar.config
    error = (drawn.rgb - target.image).abs()
    visible = target.person.sum().clamp(min=1) * 3
    loss = masked_mean(error, target.person)
    if config.paper_strict:
        return loss
    loss = loss + config.background_weight * (error * target.background).sum() / visible
    n = target.evident.sum().clamp(min=1)  # a body behind the camera leaves no point
    loss = (
        loss
        + config.offset_weight * (drawn.offset.square().sum(1) * target.evident).sum() / (3 * n)
        + config.scale_weight * (drawn.scale * target.evident).sum() / n
    )
    return loss + prior_loss(avatar, drawn, target) if config.prior.on else loss


def prior_loss(avatar: GaussianAvatar, drawn: Drawn, target: Target) -> Tensor:
    """What it costs that neighbouring points differ where few views look, in colour, offset and scale."""
    prior = avatar.config.prior
    size = (drawn.scale / avatar.base_scale[target.points]).clamp(min=1e-6).log()[:, None]
    columns = [prior.color**0.5 * drawn.color, prior.offset**0.5 * drawn.offset, prior.scale**0.5 * size]
    return target.links.roughness(torch.cat(columns, 1))


@dataclass(frozen=True)
class KnownSurface:
    """What the training views show of the avatar's points."""

    prior: SurfacePrior
    evident: Tensor  # [N] 1 where some view shows the point, else 0
    unfaced: NDArray[np.int64]  # points that face no view: drawn in every step, for the prior alone to reach them

    @classmethod
    def all_seen(cls, avatar: GaussianAvatar) -> KnownSurface:
        ones = torch.ones(len(avatar), device=avatar.device)
        return cls(SurfacePrior(ones.new_empty(0, 2, dtype=torch.int32), ones[:0]), ones, np.empty(0, np.int64))

    @classmethod
    def of(cls, avatar: GaussianAvatar, training: TrainingSet) -> KnownSurface:
        sightings = training.sightings[FINE]
        texel = nearest_texels(sightings.texels, avatar.texels.uv)
        shown = sightings.visibility.seen[texel] / max(len(training.views), 1)
        points, normals = avatar.canonical_points.cpu().numpy(), avatar.normals.cpu().numpy()
        config = avatar.config.prior
        prior = SurfacePrior.of(points, normals, shown, config.views, config.power)
        evident = torch.from_numpy((shown > 0).astype(np.float32))
        unfaced = np.flatnonzero(sightings.visibility.faced[texel] == 0) if config.on else np.empty(0, np.int64)
        return cls(prior.to(avatar.device), evident.to(avatar.device), unfaced)


def loss_of(avatar: GaussianAvatar, target: Target, background: tuple[float, float, float], step: int = 0) -> Tensor:
    """`initial_loss` of what the avatar shows of a target, and in some steps 1 - SSIM over visible person pixels."""
    drawn = draw(avatar, target, background)
    loss, weight = initial_loss(avatar, drawn, target), ssim_weight(avatar.config, avatar.config.ssim, step)
    if weight == 0 or avatar.config.paper_strict:
        return loss
    unknown = 1 - target.person - target.background
    return loss + weight * dissimilarity(*where_known(drawn.rgb, target.image, unknown), target.person)


def ssim_weight(config: InpaintHumanConfig, weight: float, step: int) -> float:
    """The weight of the SSIM in this step: all of it in one of `ssim_every`, where it is paid for."""
    return weight * config.ssim_every if (step + 1) % config.ssim_every == 0 else 0.0


def parameter_groups(avatar: GaussianAvatar, lr_share: float = 1.0, maps_only: bool = False) -> list[ParameterGroup]:
    """With the configured step sizes times `lr_share`; with `maps_only` the UV feature maps alone."""
    config = avatar.config
    groups = [ParameterGroup(list(avatar.features.parameters()), config.lr_maps * lr_share)]
    networks = [] if maps_only else [(avatar.decoder, config.lr_decoder)]
    if config.pose_residual and not maps_only:
        networks.append((avatar.encoder, config.lr_encoder))
    return groups + [
        ParameterGroup(list(network.parameters()), lr * lr_share, weight_decay=0.01) for network, lr in networks
    ]


class Stage1(Optimisation[GaussianAvatar]):
    """The optimisation, step by step, with everything needed to stop after any step and go on later."""

    name, title = STAGE1, "stage 1"

    def __init__(self, avatar: GaussianAvatar, training: TrainingSet, seed: int, ledger: Ledger):
        views = training.views
        config = avatar.config
        super().__init__(
            avatar,
            training,
            seed,
            ledger,
            parameter_groups(avatar),
            steps=config.fit_steps,
            views=len(views),
            lr_final=config.lr_final,
            clip_gradient=config.clip_gradient,
        )
        surface = KnownSurface.of(avatar, training)
        self._targets = LazyViews(lambda k: prepare_target(avatar, views[k], surface), len(views), held=TARGETS_HELD)

    def _loss(self, k: int) -> Tensor:
        return loss_of(self.avatar, self._targets[k], self.training.background, self.step)

    def _before_step(self) -> None:
        self._join_residual(self.step)

    def _restored(self) -> None:
        self._join_residual(self.step - 1)  # as the last step had it

    def _join_residual(self, step: int) -> None:
        config = self.avatar.config
        self.avatar.residual_on = config.pose_residual and step / self.steps >= config.residual_start
