"""One guess at what nobody saw: a random view of the Gaussians and what the diffusion model would change about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body import Body
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.part_map import drawn_body, labels_of, part_colours
from ihbench.diffusion.crops.seen_surface import SurfaceColours, uv_cells
from ihbench.diffusion.score_distillation import ScoreDistillation, drawn_timestep, part_guide
from ihbench.methods.gtu.avatar import GtuAvatar
from ihbench.methods.gtu.prompts import prompts_of
from ihbench.methods.gtu.random_views import RandomView, drawn, view_from
from ihbench.methods.gtu.schedule import noise_range
from ihbench.render.splats import Screen

CONTROL_SCALE = {"mini": 1.0, "sd2": 0.7}  # as it was trained; as released
RIM = 0.06  # of the picture's side, around the body: clothes and hair stand off it, and are not known either


@dataclass(frozen=True)
class Guess:
    """Of one SDS step."""

    loss: Tensor  # score distillation alone
    alpha: Tensor  # [S, S] of the drawn view
    screen: Screen
    size: int  # px of the drawn view
    view: RandomView
    image: Tensor  # [S', S', 3] as the model was shown it
    clean: Tensor  # [1, C, h, w] what the model takes it for


class Guesser:
    """Draws and asks. What is drawn depends on the seed, the step and the avatar alone."""

    def __init__(
        self,
        backbone: Backbone,
        words: Sequence[str],  # the person's; none for anybody
        avatar: GtuAvatar,
        frames: Sequence[CropView],  # what was filmed, for context "seen"
        backdrop: tuple[float, float, float],  # the protocol's
        seed: int,
    ):
        self.backbone, self.words, self.avatar, self.backdrop, self.seed = backbone, words, avatar, backdrop, seed
        config = avatar.config
        self.distil = ScoreDistillation(
            backbone, guidance=config.settled().guidance, control_scale=CONTROL_SCALE[backbone.name]
        )
        self.seen: SurfaceColours | None = None
        if config.settled().context == "seen":
            self.seen = SurfaceColours()
            for frame in frames:
                self.seen.show(frame.cells, frame.image, frame.person, frame.index)

    def __call__(self, k: int, frame: int) -> Guess:
        """SDS step k, with the pose of a training frame."""
        avatar, config, device = self.avatar, self.avatar.config, self.avatar.device
        rng = np.random.default_rng((self.seed, *b"sds", k))
        full = self.backbone.size
        size = full // 2 if k < config.coarse_steps else full
        pose = avatar.poses[frame].detach().cpu().double().numpy()
        view = view_from(*drawn(rng, config, k), avatar.body, pose, avatar.betas, size)
        backdrop = self._backdrop(rng).to(device)
        joints = avatar.deformation.joints(view.body_pose.betas)
        rgb, alpha, screen = avatar.draw(
            torch.from_numpy(np.array(view.body_pose.pose)).to(joints), joints,
            torch.from_numpy(np.array(view.body_pose.transl)).to(joints), view.camera, backdrop,
            ("rgb", "alpha", "screen"),
        )  # fmt: skip
        image = F.interpolate(rgb.clamp(max=1).movedim(-1, 0)[None], (full, full), mode="bilinear")
        image = 2 * image - 1
        guide, condition = self._shown(view, image.detach(), avatar.body, full)
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        last = int(self.backbone.scheduler.config.num_train_timesteps)
        low, high = noise_range(config, k)
        timestep = drawn_timestep(low, high, generator, last)
        noise = torch.randn(self.distil.latent_shape(full, full), generator=generator).to(device)
        prompts = prompts_of(self.backbone.name, self.words, view.kind, view.azimuth)
        distilled = self.distil(image, prompts, timestep, noise, guide=guide, condition=condition)
        return Guess(distilled.loss, alpha, screen, size, view, image.detach()[0].movedim(0, -1), distilled.clean)

    def _backdrop(self, rng: np.random.Generator) -> Tensor:
        """[3]: uniform, or its complement, which is uniform too; or the protocol's."""
        colour = rng.uniform(size=3)
        if self.avatar.config.settled().sds_backdrop == "protocol":
            colour = np.array(self.backdrop)
        return torch.from_numpy(colour).float()

    def _shown(self, view: RandomView, image: Tensor, body: Body, size: int) -> tuple[Tensor, Tensor | None]:
        """The ControlNet's guide [1, 7, S, S], and what the model is shown of the picture; None for nothing."""
        device = image.device
        raster = drawn_body(body.pose(view.body_pose), body, view.camera.scaled(size, size))
        parts = _pixels(part_colours(labels_of(raster, body)), device)
        if self.seen is None:
            return part_guide(parts), None
        colours, _ = self.seen.drawn(uv_cells(raster, body))
        seen = _pixels(colours, device)
        body_mask = torch.from_numpy(raster.mask).to(device).float()[None, None]
        reach = 2 * round(RIM * size) + 1
        near = F.max_pool2d(body_mask, reach, 1, reach // 2)
        hidden = near * (1 - seen[:, 3:])
        return part_guide(parts, seen), self.backbone.condition(image, hidden, seen[:, 3:])


def _pixels(picture: NDArray[np.uint8], device: torch.device) -> Tensor:
    """[H, W, C] 0..255 -> [1, C, H, W] 0..1."""
    return torch.from_numpy(picture).to(device).movedim(-1, 0)[None].float() / 255
