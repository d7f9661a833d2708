"""Score distillation on alpha (stage1.py:195-227): what the diffusion model would change about the silhouette.

Posed, in three of four steps: a training view, with gradient where the person is not visible alone. Canonical, in one
of four: the big pose from one of 18 sides, without networks. Alpha is shown to the model either by itself, as a white
silhouette on black, or by colours that are held fast: α c + (1 - α) b, so that ∂L/∂α = Σ (c - b) ∂L/∂I is geometry
only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ihbench.camera import Camera
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import EDGE, CropView, cut_view
from ihbench.diffusion.crops.diffusion_batch import batch_of
from ihbench.diffusion.crops.part_map import drawn_body, labels_of, part_colours
from ihbench.diffusion.score_distillation import Prompts, ScoreDistillation, falling_timestep, part_guide
from ihbench.fit.big_pose.deformation import Posed
from ihbench.methods.occfusion.avatar import SIDES, OccFusionAvatar, big_pose_camera
from ihbench.methods.occfusion.hidden import cut_states, visible
from ihbench.scene.contracts import TrainingSet
from ihbench.scene.views import LazyViews

MODE, SIDE, NOISE = 10, 11, 12  # what random numbers are drawn for
OPAQUE = 0.5  # alpha above which a Gaussian's own colour is believed
THERE = 0.01  # alpha above which the canonical silhouette may change: it cannot grow beyond its own support


@dataclass(frozen=True)
class ScoreView:
    """A training view, or the big pose from one side, at the model's size."""

    camera: Camera
    guide: Tensor  # [1, 7, S, W]
    condition: Tensor | None  # [1, 1 + C, h, w]
    free: Tensor  # [S, W] 1 where alpha has a gradient
    crop: CropView | None = None


def alpha_picture(
    rgb: Tensor,  # [S, W, 3] on the background
    alpha: Tensor,  # [S, W]
    picture: str,  # "silhouette" or "composite"
    background: Tensor,  # [3]
    spare: Tensor,  # [3] colour where nothing is opaque
) -> Tensor:
    """[1, 3, S, W] in [-1, 1], with the gradient of alpha alone."""
    if picture == "silhouette":
        return (2 * alpha - 1).expand(1, 3, *alpha.shape)
    share = alpha.detach()[..., None]
    own = ((rgb.detach() - (1 - share) * background) / share.clamp(min=OPAQUE)).clamp(0, 1)
    colour = torch.where(share > OPAQUE, own, spare)
    image = alpha[..., None] * colour + (1 - alpha[..., None]) * background
    return (2 * image - 1).movedim(-1, 0)[None]


def free_where(alpha: Tensor, free: Tensor) -> Tensor:
    """Alpha with a gradient only where `free` is 1."""
    return torch.where(free > 0, alpha, alpha.detach())


class AlphaScore:
    """Distils for one avatar. Random draws depend on seed and step alone, so a resumed fit repeats them."""

    def __init__(self, avatar: OccFusionAvatar, training: TrainingSet, backbone: Backbone, seed: int):
        config = avatar.config
        self.avatar, self.training, self.backbone, self.seed = avatar, training, backbone, seed
        self.own, self.score, self.steps = config.settled_score(), config.score, config.steps
        self.distil = ScoreDistillation(backbone, guidance=config.score.guidance)
        self.prompts = Prompts(self.own.positive, self.own.negative)
        device = avatar.device
        self.background = torch.tensor(training.background, device=device)
        self.spare = torch.from_numpy(_mean_visible(training)).to(device)
        self.views = LazyViews(self._view, len(training.views))
        self.sides = LazyViews(self._side, SIDES)

    def is_canonical(self, step: int) -> bool:
        """Of a step from 0; the last one is posed."""
        drawn = np.random.default_rng((self.seed, step, MODE)).uniform()
        return bool(drawn < self.score.canonical) and step + 1 < self.steps

    def posed(self, step: int, k: int, posed: Posed) -> tuple[Tensor, Tensor]:
        """The loss of training view k, whose value is 0 and whose gradient counts, and alpha at its crop [S, W]."""
        view: ScoreView = self.views[k]
        rgb, alpha = self.avatar.draw(posed, view.camera, self.training.background)
        return self._loss(step, view, rgb, free_where(alpha, view.free), view.free), alpha

    def canonical(self, step: int) -> Tensor:
        """The loss of the big pose from the side that the step draws."""
        rng = np.random.default_rng((self.seed, step, SIDE))
        view: ScoreView = self.sides[int(rng.integers(SIDES))]
        rgb, alpha = self.avatar.draw_big_pose(view.camera, self.training.background)
        return self._loss(step, view, rgb, alpha, (alpha.detach() > THERE).float())

    def _loss(self, step: int, view: ScoreView, rgb: Tensor, alpha: Tensor, where: Tensor) -> Tensor:
        images = alpha_picture(rgb, alpha, self.own.picture, self.background, self.spare)
        shape = self.distil.latent_shape(*alpha.shape)
        number = int(np.random.SeedSequence((self.seed, step, NOISE)).generate_state(1)[0])
        noise = torch.randn(shape, generator=torch.Generator().manual_seed(number))
        weight = interpolate(where[None, None], size=shape[1:], mode="bilinear", align_corners=False)
        distilled = self.distil(
            images, self.prompts, falling_timestep(step / max(self.steps - 1, 1)), noise,
            guide=view.guide, condition=view.condition, weight=weight,
        )  # fmt: skip
        # of the sum that the guard of the fit looks at, only what the avatar can lower
        return distilled.loss - distilled.loss.detach()

    def _view(self, k: int) -> ScoreView:
        training, config, backbone = self.training, self.avatar.config, self.backbone
        view = training.views[k]
        crop = cut_states(cut_view(view, k, training.body, self.own.size, backbone.square), view, config)
        hidden = ~(crop.crop.cut(visible(view)) > EDGE)
        if config.hidden == "unknown":
            hidden &= crop.unknown
        batch = batch_of([crop], backbone.device)
        condition = None
        if self.own.context == "visible":
            asked = torch.from_numpy(~crop.person[None, None]).to(batch.pixels)
            with torch.no_grad():
                condition = backbone.condition(batch.pixels.to(backbone.dtype), asked, batch.person)
        free = torch.from_numpy(hidden.astype(np.float32)).to(self.avatar.device)
        return ScoreView(crop.camera, part_guide(batch.parts), condition, free, crop)

    def _side(self, side: int) -> ScoreView:
        body, deformation = self.training.body, self.avatar.deformation
        camera = big_pose_camera(side, self.own.size)
        vertices = deformation.vertices.detach().cpu().double().numpy()
        labels = labels_of(drawn_body(vertices - vertices.mean(0), body, camera), body)
        parts = torch.from_numpy(part_colours(labels)).to(self.backbone.device)
        guide = part_guide(parts.movedim(-1, 0)[None].float() / 255)
        return ScoreView(camera, guide, None, torch.ones(camera.height, camera.width, device=self.avatar.device))


def _mean_visible(training: TrainingSet) -> np.ndarray:
    """[3] float32 mean colour of the visible person, over at most ten views; grey without any."""
    views = [training.views[k] for k in range(0, len(training.views), max(len(training.views) // 10, 1))]
    pixels = np.concatenate([view.image[visible(view)] for view in views]).astype(np.float32)
    mean = np.nan_to_num(pixels).mean(0) / 255 if len(pixels) else np.full(3, 0.5)
    return mean.astype(np.float32)
