"""The refinement loss of stage 3 (sec. 3.4): L1, SSIM and LPIPS over the complete person mask of a painted view.

Every term is a mean (the paper's sum over pixels would make its 0.2 and 0.1 depend on the image's size). The stage-1
loss of the original view stands beside it, from the same rendering.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ihbench.fit.losses import Perceptual, dissimilarity, masked_mean, perceptual, where_known
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.refine_config import RefineConfig
from ihbench.scene.contracts import MaskState


@dataclass(frozen=True)
class PaintedTarget:
    """A painted view, cut to the body's window."""

    image: Tensor  # [h, w, 3]; the background's colour in `cleared`
    weight: Tensor  # [h, w, 1] over the believed person: 1 where original, the config's where generated
    cleared: Tensor  # [h, w, 1] 1 where nobody knew and the complete mask now says background
    unknown: Tensor  # [h, w, 1] 1 where still nobody knows
    off: Tensor  # [h, w, 3] the background's colour


def prepare_painted(
    painted: PaintedView,
    rows: slice,
    cols: slice,
    background: tuple[float, float, float],
    generated: float,
    device: torch.device,
) -> PaintedTarget:
    """Cut a painted view to the rows and columns of a target's window. `generated` is the weight of a pixel that the
    painter made."""
    image = painted.view.image[rows, cols].astype(np.float32) / 255
    mask, made = painted.view.mask[rows, cols], painted.generated[rows, cols]
    off = np.broadcast_to(np.asarray(background, np.float32), image.shape)
    cleared = made & (mask == MaskState.BACKGROUND)
    weight = np.where(made, np.float32(generated), np.float32(1)) * (mask == MaskState.PERSON)

    def tensor(value: np.ndarray) -> Tensor:
        value = np.ascontiguousarray(value if value.ndim == 3 else value[..., None], np.float32)
        return torch.from_numpy(value).to(device)

    return PaintedTarget(
        tensor(np.where(cleared[..., None], off, image)),
        tensor(weight),
        tensor(cleared),
        tensor(mask == MaskState.UNKNOWN),
        tensor(off),
    )


def refine_loss(
    rgb: Tensor,  # [h, w, 3] what the avatar shows
    target: PaintedTarget,
    config: RefineConfig,
    distance: Perceptual | None = None,
) -> Tensor:
    """L1 + SSIM + LPIPS over M_full, plus L1 to the background where the complete mask has cleared a hidden pixel.

    Pixels that nobody knows count in no term: in what windows and networks see of both images they show the avatar
    itself. The background's L1 is divided by the number of person pixels, as in stage 1.
    """
    total = target.weight.sum().clamp(min=1)
    error = (rgb - target.image).abs()
    loss = masked_mean(error, target.weight)
    if config.background > 0:
        loss = loss + config.background * (error * target.cleared).sum() / (3 * total)
    if config.ssim > 0 or distance is not None:
        seen, target_seen = where_known(rgb, target.image, target.unknown)
        if config.ssim > 0:
            loss = loss + config.ssim * dissimilarity(seen, target_seen, target.weight)
        if distance is not None:
            inside = target.weight > 0
            pair = (torch.where(inside, image, target.off) for image in (seen, target_seen))
            loss = loss + config.lpips * distance(*pair)
    return loss


def load_perceptual(config: RefineConfig, device: torch.device) -> Perceptual | str | None:
    """LPIPS as a differentiable loss; the reason when its weights are not here; None when its weight is 0."""
    return None if config.lpips == 0 or config.weight == 0 else perceptual(config.lpips_net, device)
