"""The losses (released: train.py:69-91): whole images, no mask, and regularisers over all decoded texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ihbench.camera import Camera
from ihbench.fit.losses import Perceptual, dissimilarity, masked_mean, where_known
from ihbench.methods.gaussianavatar.config import GaussianAvatarConfig
from ihbench.scene.contracts import MaskState, TrainView


@dataclass(frozen=True)
class Target:
    """What a step needs of a training view."""

    camera: Camera
    image: Tensor  # [H, W, 3]
    known: Tensor | None  # [H, W, 1] 1 where the image says something; None for everywhere
    transforms: Tensor  # [24, 3, 4] canonical to the view's pose
    position_map: Tensor | None  # [3, S, S] m, in stage 2


def target_image(
    view: TrainView, background: tuple[float, float, float], unknown: str
) -> tuple[Tensor, Tensor | None]:
    """The image [H, W, 3] that a fit aims at, background-coloured outside the mask, and where it counts [H, W, 1].

    With `unknown` "background" a pixel behind the occluder is outside the mask like any other.
    """
    person = (view.mask == MaskState.PERSON)[..., None]
    image = np.where(person, view.image.astype(np.float32) / 255, np.asarray(background, np.float32))
    known = None
    if unknown == "ignore":
        known = torch.from_numpy((view.mask != MaskState.UNKNOWN)[..., None].astype(np.float32))
    return torch.from_numpy(image.astype(np.float32)), known


def image_loss(
    rgb: Tensor,  # [H, W, 3]
    target: Target,
    config: GaussianAvatarConfig,
    lpips_weight: float,
    distance: Perceptual | None,
) -> Tensor:
    """L1, 1 - SSIM and LPIPS of the whole image, or of what is known of it."""
    image = target.image
    known = torch.ones_like(image[..., :1]) if target.known is None else target.known
    loss = config.l1 * masked_mean((rgb - image).abs(), known)
    if target.known is not None:
        rgb, image = where_known(rgb, image, 1 - known)
    if config.ssim > 0:
        loss = loss + config.ssim * dissimilarity(rgb, image, known)
    if distance is not None and lpips_weight > 0:
        loss = loss + lpips_weight * distance(rgb, image)
    return loss
