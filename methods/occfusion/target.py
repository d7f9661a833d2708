"""What a step needs of a training view, and the losses by pixels of stages 1 and 3.

Stage 1 (stage1.py:166-193), V the visible person, M̂ the complete silhouette, box and crop as in GauHuman:

    L = mean_V |I - I*| + 2 mean_box (α - M̂)² + 0.1 (1 - SSIM_V) + 0.1 LPIPS_V

Stage 3 (stage3.py:117-169), H = M̂ and not V, G the generated image on the background:

    L = 2 mean_{box without H} |I - I*| + 0.1 mean_box (α - M̂)² + 0.2 LPIPS(I, G) + 0.1 mean_crop |I - G|
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera
from ihbench.fit.big_pose.deformation import Frame
from ihbench.fit.body_box import body_box
from ihbench.fit.losses import Perceptual, dissimilarity, masked_mean, where_known
from ihbench.methods.occfusion.avatar import OccFusionAvatar
from ihbench.methods.occfusion.config import OccFusionConfig
from ihbench.methods.occfusion.hidden import visible
from ihbench.metrics.ssim_torch import ssim_map_torch
from ihbench.scene.contracts import TrainView


@dataclass(frozen=True)
class Target:
    """A training view, cut to the window around the box."""

    camera: Camera
    width: int  # px of the whole image
    height: int
    frame: Frame
    image: Tensor  # [h, w, 3] the visible person on the background
    visible: Tensor  # [h, w, 1] V
    complete: Tensor  # [h, w, 1] M̂
    box: Tensor  # [h, w, 1] without what is undecided
    generated: Tensor | None  # [h, w, 3] G; None where nothing was generated for a view that hides something


def prepare_target(
    avatar: OccFusionAvatar,
    view: TrainView,
    background: tuple[float, float, float],
    complete: NDArray[np.bool_],  # [H, W] M̂
    generated: NDArray[np.uint8] | None = None,  # [H, W, 3]
    undecided: NDArray[np.bool_] | None = None,  # [H, W] where M̂ is not known
) -> Target:
    """Cut a view to the box around the posed body, of which what is undecided is left out. Colours of all but the
    visible person are the background's."""
    box = body_box(view.camera, avatar.body.pose(view.body_pose))
    window = box.rows, box.columns
    own, whole = visible(view)[window], complete[window]
    unsure = np.zeros_like(own) if undecided is None else undecided[window]
    behind = np.array(background, np.float32)
    image = np.where(own[..., None], view.image[window].astype(np.float32) / 255, behind)
    made = None
    if generated is not None:
        made = np.where(whole[..., None], generated[window].astype(np.float32) / 255, behind)
    elif not (whole & ~own).any() and not unsure.any():
        made = image

    def tensor(values: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values, np.float32)).to(avatar.device)

    return Target(
        camera=view.camera.cropped(*box.window),
        width=view.camera.width,
        height=view.camera.height,
        frame=avatar.deformation.frame(view.body_pose),
        image=tensor(image),
        visible=tensor(own[..., None]),
        complete=tensor(whole[..., None]),
        box=tensor((box.inside & ~unsure)[..., None]),
        generated=None if made is None else tensor(made),
    )


def visible_loss(
    rgb: Tensor,  # [h, w, 3]
    alpha: Tensor,  # [h, w]
    target: Target,
    config: OccFusionConfig,
    perceptual: Perceptual | None = None,
) -> Tensor:
    """Stage 1's, without its factor. Only colours of visible pixels count, also through the SSIM's windows."""
    loss = masked_mean((rgb - target.image).abs(), target.visible) + config.mask * _mask_error(alpha, target)
    if config.ssim > 0:
        own, image = where_known(rgb, target.image, 1 - target.visible)
        if config.ssim_pixels == "fixed":
            loss = loss + config.ssim * dissimilarity(own, image, target.visible)
        else:
            loss = loss + config.ssim * _released_dissimilarity(own, image, target.visible)
    if perceptual is not None and config.lpips > 0:
        own, image = (torch.where(target.visible > 0, each, torch.ones_like(each)) for each in (rgb, target.image))
        # fed with values of 0 to 1 where the network expects -1 to 1, as released
        loss = loss + config.lpips * perceptual((own + 1) / 2, (image + 1) / 2)
    return loss


def refine_loss(
    rgb: Tensor,  # [h, w, 3]
    alpha: Tensor,  # [h, w]
    target: Target,
    config: OccFusionConfig,
    perceptual: Perceptual | None = None,
) -> Tensor:
    """Stage 3's."""
    refine = config.refine
    known = target.box * (1 - target.complete * (1 - target.visible))
    loss = refine.colour * masked_mean((rgb - target.image).abs(), known) + refine.mask * _mask_error(alpha, target)
    if target.generated is not None:
        loss = loss + refine.generated * (rgb - target.generated).abs().mean()
        if perceptual is not None and refine.lpips > 0:
            loss = loss + refine.lpips * perceptual((rgb + 1) / 2, (target.generated + 1) / 2)
    return loss


def _mask_error(alpha: Tensor, target: Target) -> Tensor:
    error = (alpha[..., None] - target.complete).square() * target.box
    return error.sum() / target.box.sum().clamp(min=1)


def _released_dissimilarity(rgb: Tensor, image: Tensor, chosen: Tensor) -> Tensor:
    """1 - the mean of what the released code picks from the SSIM map: it reads [3, h, w] as if it were [h w, 3]."""
    similarity = ssim_map_torch(rgb.permute(2, 0, 1), image.permute(2, 0, 1)).contiguous()
    picked = similarity.reshape(-1, 3)[chosen.reshape(-1) > 0]
    return 1 - picked.mean() if len(picked) else similarity.sum() * 0
