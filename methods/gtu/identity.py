"""Identity: a word and the UNet's cross-attention are tuned to the person (gtu/diffusion_inversion).

Custom Diffusion on the frames: the person over a uniform random colour, pasted small or zoomed in, under the
skeleton's (here the part map's) ControlNet. A pixel of the person weighs 1, one known to be background .5, and one
that is hidden nothing: in the released two states it is background, which teaches that the person has a hole.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.diffusion.backbone import Backbone
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.diffusion_batch import batch_of
from ihbench.diffusion.personalise import channel_weight, timestep_weight
from ihbench.diffusion.score_distillation import part_guide
from ihbench.diffusion.subject_token import ANYBODY, SubjectToken
from ihbench.diffusion.tuning import Tuning, trainable
from ihbench.errors import BadInput
from ihbench.methods.gtu.config import GtuConfig
from ihbench.methods.gtu.prompts import azimuth_of, caption
from ihbench.methods.gtu.spec import IDENTITY

SMALL, SMALLER_SHARE, LARGE = (170 / 512, 1.0), 0.66, (614 / 512, 818 / 512)  # sizes of the paste, of the picture's
EDGE = 5 / 512  # of the picture: the mask is eroded by this, and blurred by it
CROSS_ATTENTION = ("attn2.to_k", "attn2.to_v")


class IdentityTuning(Tuning):
    """Tunes a backbone in place."""

    def __init__(
        self, backbone: Backbone, views: list[CropView], config: GtuConfig, seed: int, ledger: Ledger
    ) -> None:
        """Raises `BadInput` for views that never show the person, and for a word that the vocabulary has."""
        super().__init__(backbone, seed, ledger)
        self.views = [view for view in views if view.person.any()]
        if not self.views:
            raise BadInput("identity: no frame shows a visible pixel of the person; nothing to learn from")
        self.config, self.settled = config, config.settled()
        initial = "ktn" if backbone.name == "sd2" else "person"
        self.token = SubjectToken(
            backbone, config.identity.token, self.settled.vectors, initial, option="--method.identity.token"
        )
        self._azimuths = [azimuth_of(v.camera, v.body_pose.pose, v.body_pose.transl) for v in self.views]

    def run(self, progress: Progress) -> None:
        """Tune; a state that was saved is gone on with."""
        identity, unet = self.config.identity, self.backbone.unet
        for name, p in unet.named_parameters():
            p.requires_grad_(any(part in name for part in CROSS_ATTENTION))
        named: dict[str, nn.Parameter] = trainable(unet, "unet")
        rates = {name: self.settled.lr for name in named} | {"vectors": self.settled.word_lr}
        named["vectors"] = self.token.vectors
        self._tune(
            IDENTITY, "identity", named, rates, identity.steps, identity.batch, self.loss, progress,
            weight_decay=identity.weight_decay, falling=False,
        )  # fmt: skip
        for p in named.values():
            p.requires_grad_(False)

    def loss(self, rng: np.random.Generator, batch: int) -> Tensor:
        """Denoising loss over the pasted area by the pixels' weights, of a batch drawn from the views."""
        backbone = self.backbone
        chosen = [(int(k), _scale(rng)) for k in rng.integers(len(self.views), size=batch)]
        prompts = [caption(backbone.name, self.token.words, scale, self._azimuths[k], rng) for k, scale in chosen]
        pictures = [self._picture(self.views[k], scale, rng) for k, scale in chosen]
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        with torch.no_grad():
            pixels, parts, weight = (torch.cat(each) for each in zip(*pictures, strict=True))
            pixels = pixels.to(self.dtype)
            latents = backbone.codec.encode(pixels)
            # an inpainting model that is shown nothing makes pictures of words
            condition = backbone.condition(pixels, torch.ones_like(weight))
            weight = F.interpolate(weight, latents.shape[-2:], mode="area")
            noise = torch.randn(latents.shape, generator=generator).to(latents)
            last = backbone.scheduler.config.num_train_timesteps
            timesteps = torch.randint(0, last, (batch,), generator=generator).to(backbone.device)
            noisy = backbone.scheduler.add_noise(latents, noise, timesteps)
            told = backbone.text([ANYBODY]).expand(batch, -1, -1)
            guide = part_guide(parts)
        with torch.autocast(backbone.device.type, self.dtype, enabled=self.dtype != torch.float32):
            text = backbone.text(prompts)
            predicted = backbone.predict(noisy, timesteps, condition, text, guide, control_text=told)
        error = (predicted - backbone.target(latents, noise, timesteps)).float().square()
        error = (error * channel_weight(backbone)).sum(1, keepdim=True)
        each = (error * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3)).clamp(min=1e-6)
        return (each * timestep_weight(backbone, timesteps)).mean()

    def _picture(self, view: CropView, scale: float, rng: np.random.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Pixels [1, 3, S, S] in -1..1, part map [1, 3, S, S] in 0..1, and weights [1, 1, S, S]: 0 beside the paste
        and where nothing is known."""
        device = self.backbone.device
        crop = batch_of([view], device)
        size = crop.pixels.shape[-1]
        mask = torch.from_numpy(_soft(view.person, round(EDGE * size)))[None, None].to(device)
        colour = torch.from_numpy(rng.uniform(-1, 1, (1, 3, 1, 1))).to(crop.pixels)
        pixels = torch.lerp(colour.expand_as(crop.pixels), crop.pixels, mask)
        weight = mask + self.config.identity.background * (1 - mask)
        if self.config.unknown == "ignore":
            weight = weight * (1 - crop.unknown)
        side = max(round(scale * size), 8)
        x, y = (int(rng.integers(abs(size - side) + 1)) for _ in range(2))
        return (
            _pasted(pixels, size, side, x, y, "bilinear"),
            _pasted(crop.parts, size, side, x, y, "nearest"),
            _pasted(weight, size, side, x, y, "nearest"),
        )


def _scale(rng: np.random.Generator) -> float:
    return float(rng.uniform(*(SMALL if rng.random() < SMALLER_SHARE else LARGE)))


def _soft(mask: NDArray[np.bool_], by: int) -> NDArray[np.float32]:
    """[H, W] eroded by an ellipse and blurred."""
    if by < 2:
        return mask.astype(np.float32)
    side = by | 1
    inner = cv2.erode(mask.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
    return np.asarray(cv2.GaussianBlur(inner.astype(np.float32), (side, side), 0), np.float32)


def _pasted(picture: Tensor, size: int, side: int, x: int, y: int, how: str) -> Tensor:
    """A picture [1, C, S, S] brought to `side` px, on an empty one of `size` px at x, y, or where it is larger the
    window there."""
    scaled = F.interpolate(picture, (side, side), mode=how)
    if side >= size:
        return scaled[..., y : y + size, x : x + size]
    return F.pad(scaled, (x, size - side - x, y, size - side - y))
