"""The refinement loss of stage 3 (sec. 3.4): L1, SSIM and LPIPS over the complete person mask of a painted view.

Every term is a mean (the paper's sum over pixels would make its 0.2 and 0.1 depend on the image's size). The stage-1
loss of the original view stands beside it, from the same rendering.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ihbench.fit.losses import dissimilarity, where_known
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.refine_config import RefineConfig
from ihbench.scene.contracts import MaskState

Perceptual = Callable[[Tensor, Tensor], Tensor]  # two images [h, w, 3] in [0, 1] -> a distance


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
    perceptual: Perceptual | None = None,
) -> Tensor:
    """L1 + SSIM + LPIPS over M_full, plus L1 to the background where the complete mask has cleared a hidden pixel.

    Pixels that nobody knows count in no term: in what windows and networks see of both images they show the avatar
    itself. The background's L1 is divided by the number of person pixels, as in stage 1.
    """
    total = target.weight.sum().clamp(min=1)
    error = (rgb - target.image).abs()
    loss = (error * target.weight).sum() / (3 * total)
    if config.background > 0:
        loss = loss + config.background * (error * target.cleared).sum() / (3 * total)
    if config.ssim > 0 or perceptual is not None:
        seen, wanted = where_known(rgb, target.image, target.unknown)
        if config.ssim > 0:
            loss = loss + config.ssim * dissimilarity(seen, wanted, target.weight)
        if perceptual is not None:
            inside = target.weight > 0
            pair = (torch.where(inside, image, target.off) for image in (seen, wanted))
            loss = loss + config.lpips * perceptual(*pair)
    return loss


def load_perceptual(config: RefineConfig, device: torch.device) -> Perceptual | str | None:
    """LPIPS as a differentiable loss; the reason when its weights are not here; None when its weight is 0."""
    if config.lpips == 0 or config.weight == 0:
        return None
    from ihbench.metrics.lpips import MIN_SIDE, PADDING, load

    network = load(config.lpips_net)
    if isinstance(network, str):
        return network
    # the metric's own network stays as it is, on the CPU
    package = copy.deepcopy(network.package).to(device).requires_grad_(False)

    def distance(pred: Tensor, truth: Tensor) -> Tensor:
        height, width = pred.shape[:2]
        pad = (0, max(MIN_SIDE - width, 0), 0, max(MIN_SIDE - height, 0))
        x, y = (F.pad(image.permute(2, 0, 1)[None], pad, value=PADDING) for image in (pred, truth))
        return package(2 * x - 1, 2 * y - 1).sum()

    return distance
