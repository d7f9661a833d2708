"""What a step needs of a training view, and the loss inside the projected box (GauHuman, train.py:111-123)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.fit.big_pose.avatar import BigPoseAvatar
from ihbench.fit.big_pose.deformation import Frame
from ihbench.fit.body_box import body_box
from ihbench.fit.losses import Perceptual, dissimilarity, masked_mean, where_known
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState, TrainView

Colour = tuple[float, float, float]
BLACK: Colour = (0.0, 0.0, 0.0)


class BoxLossConfig(Protocol):
    """Switches of a method whose loss this is."""

    @property
    def unknown(self) -> str: ...  # what a hidden pixel is taken for: background, or ignore: nothing

    @property
    def colours(self) -> str: ...  # where colours are compared: everywhere in the box, or where the person is visible

    @property
    def silhouette(self) -> str: ...  # what alpha is held to: the visible person, or the complete one

    @property
    def mask(self) -> float: ...

    @property
    def ssim(self) -> float: ...

    @property
    def lpips(self) -> float: ...


@dataclass(frozen=True)
class Target:
    """A training view, cut to the window around the box."""

    camera: Camera
    width: int  # px of the whole image
    height: int
    frame: Frame
    image: Tensor  # [h, w, 3]
    person: Tensor  # [h, w, 1] 1 where alpha shall be 1
    colours: Tensor  # [h, w, 1] 1 where colours are compared
    alphas: Tensor  # [h, w, 1] 1 where alpha is compared
    window: Tensor  # [h, w, 1] 1 where a window's SSIM counts
    blind: Tensor  # [h, w, 1] 1 where a window compares the rendering with itself


def prepare_target(avatar: BigPoseAvatar[Any], view: TrainView, background: Colour) -> Target:
    """Cut a view to the box around the posed body, as the configuration takes its mask. `background` is what the
    person is to stand on."""
    config: BoxLossConfig = avatar.config
    body_pose = view.body_pose
    box = body_box(view.camera, avatar.body.pose(body_pose))
    x0, y0, width, height = box.window
    camera = view.camera.cropped(x0, y0, width, height)
    mask = view.mask[box.rows, box.columns]
    visible, unknown = mask == MaskState.PERSON, mask == MaskState.UNKNOWN
    image = view.image[box.rows, box.columns].astype(np.float32) / 255
    # hidden pixels and known background are one colour in the images already, unless it shall be another
    image = np.where(visible[..., None], image, np.array(background, np.float32))
    person = visible
    if config.silhouette == "complete":
        person = visible | (unknown & body_silhouette(avatar, camera, body_pose))
    ignored = unknown & (config.unknown == "ignore")
    colours = box.inside & (visible if config.colours == "visible" else ~ignored)
    # alpha of hidden pixels is known where the silhouette is complete
    alphas = box.inside & ~(ignored & (config.silhouette == "visible"))

    def pixels(chosen: NDArray[np.bool_]) -> Tensor:
        return torch.from_numpy(chosen[..., None].astype(np.float32)).to(avatar.device)

    counts = visible if config.colours == "visible" else ~ignored
    return Target(
        camera=camera,
        width=view.camera.width,
        height=view.camera.height,
        frame=avatar.deformation.frame(body_pose),
        image=torch.from_numpy(image).to(avatar.device),
        person=pixels(person),
        colours=pixels(colours),
        alphas=pixels(alphas),
        window=pixels(counts),
        blind=pixels(~counts),
    )


def body_silhouette(avatar: BigPoseAvatar[Any], camera: Camera, body_pose: BodyPose) -> NDArray[np.bool_]:
    """[h, w] what the posed body covers."""
    vertices = camera.project(avatar.body.pose(body_pose))
    return rasterize(vertices, avatar.body.faces, camera.height, camera.width).mask


def box_loss(
    rgb: Tensor,  # [h, w, 3]
    alpha: Tensor,  # [h, w]
    target: Target,
    config: BoxLossConfig,
    perceptual: Perceptual | None = None,
) -> Tensor:
    """Mean L1 and squared error of alpha over pixels of the box, 1 - SSIM and LPIPS over the window around it."""
    loss = masked_mean((rgb - target.image).abs(), target.colours)
    held = target.alphas.sum().clamp(min=1)
    loss = loss + config.mask * ((alpha[..., None] - target.person).square() * target.alphas).sum() / held
    if config.ssim == 0 and (perceptual is None or config.lpips == 0):
        return loss
    own, image = where_known(rgb, target.image, target.blind)
    if config.ssim > 0:
        loss = loss + config.ssim * dissimilarity(own, image, target.window)
    if perceptual is not None and config.lpips > 0:
        # fed with values of 0 to 1 where the network expects -1 to 1, as released
        loss = loss + config.lpips * perceptual((own + 1) / 2, (image + 1) / 2)
    return loss
