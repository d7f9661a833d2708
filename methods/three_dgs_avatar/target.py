"""What a step needs of a training view, and the loss over its pixels (3DGS-Avatar, train.py:105-178)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.camera import Camera
from ihbench.fit.losses import Perceptual, where_known
from ihbench.methods.three_dgs_avatar.config import ThreeDgsAvatarConfig
from ihbench.scene.contracts import MaskState, TrainView

Colour = tuple[float, float, float]
BLACK: Colour = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Target:
    """A training view as the configuration takes its mask."""

    camera: Camera
    row: int  # of the frame's tables
    image: Tensor  # [H, W, 3]
    person: Tensor  # [H, W] 1 where alpha shall be 1
    known: Tensor | None  # [H, W] 1 where colours and alpha are compared; None for everywhere
    rectangle: tuple[int, int, int, int] | None  # y0, y1, x0, x1 px around the visible person; None for nobody


def prepare_target(
    view: TrainView, row: int, background: Colour, config: ThreeDgsAvatarConfig, device: torch.device
) -> Target:
    """`background` is what the person is to stand on: hidden pixels and known background have its colour."""
    visible = view.mask == MaskState.PERSON
    image = view.image.astype(np.float32) / 255
    image = np.where(visible[..., None], image, np.array(background, np.float32))
    unknown = (view.mask == MaskState.UNKNOWN) & (config.unknown == "ignore")
    rectangle = None
    if visible.any():
        rows, columns = (np.flatnonzero(visible.any(axis)) for axis in (1, 0))
        rectangle = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1

    def pixels(chosen: NDArray[np.bool_]) -> Tensor:
        return torch.from_numpy(chosen.astype(np.float32)).to(device)

    return Target(
        camera=view.camera,
        row=row,
        image=torch.from_numpy(image).to(device),
        person=pixels(visible),
        known=pixels(~unknown) if unknown.any() else None,
        rectangle=rectangle,
    )


def image_loss(
    rgb: Tensor,  # [H, W, 3]
    alpha: Tensor,  # [H, W]
    target: Target,
    config: ThreeDgsAvatarConfig,
) -> Tensor:
    """Mean absolute errors of colours and, times the mask's weight, alpha over all known pixels of the frame."""
    colours, alphas = (rgb - target.image).abs().mean(-1), (alpha - target.person).abs()
    errors = config.l1 * colours + config.mask * alphas
    if target.known is None:
        return errors.mean()
    # not by a product alone: what is unknown may be NaN
    return torch.where(target.known > 0, errors, 0.0).sum() / target.known.sum().clamp(min=1)


def perceptual_loss(
    rgb: Tensor,  # [H, W, 3]
    target: Target,
    distance: Perceptual,
    side: int,  # px; 0: all of the rectangle
    rng: np.random.Generator,
) -> Tensor:
    """LPIPS over the rectangle around the visible person, or a window of this side drawn from it; 0 for nobody."""
    if target.rectangle is None:
        return rgb.new_zeros(())
    y0, y1, x0, x1 = target.rectangle
    if side:
        y0, y1 = _window(y0, y1, side, rng)
        x0, x1 = _window(x0, x1, side, rng)
    cut = np.s_[y0:y1, x0:x1]
    own, image = rgb[cut], target.image[cut]
    if target.known is not None:
        own, image = where_known(own, image, 1 - target.known[cut][..., None])
    return distance(own, image)


def _window(start: int, end: int, side: int, rng: np.random.Generator) -> tuple[int, int]:
    """A piece of at most this length."""
    first = start + int(rng.integers(max(end - start - side, 0) + 1))
    return first, min(first + side, end)
