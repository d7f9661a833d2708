"""What an iteration needs of a training view, and the losses of photos (gtu/main/train_combined.py:438-613)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.fit.losses import Perceptual, dissimilarity
from ihbench.methods.gtu.avatar import GtuAvatar
from ihbench.methods.gtu.config import GtuConfig
from ihbench.render.zbuffer import rasterize
from ihbench.scene.contracts import MaskState, TrainView

# keeps R(0) and R(1) at 0: ln(1 + 1/e)
R_OFFSET = float(np.log1p(np.exp(-1.0)))


@dataclass(frozen=True)
class Target:
    """A training view, cut to the box around the body."""

    camera: Camera
    width: int  # px of the whole image
    height: int
    joints: Tensor  # [24, 3] m of the T-pose
    transl: Tensor  # [3] m
    image: Tensor  # [h, w, 3] 0..1
    person: Tensor  # [h, w, 1] 1 where the person is visible
    keep: Tensor  # [h, w, 1] 0 where the occluder is, or near


def prepare_target(avatar: GtuAvatar, view: TrainView) -> Target:
    """Cut a view to the box, as the configuration takes its mask."""
    config, camera = avatar.config, view.camera
    rows, columns = person_box(camera, avatar.body.pose(view.body_pose), config.box)
    joints = avatar.deformation.joints(view.body_pose.betas)
    keep = ~left_out(view, avatar.body, config)

    def pixels(chosen: NDArray[np.bool_]) -> Tensor:
        return torch.from_numpy(chosen[rows, columns, None].astype(np.float32)).to(avatar.device)

    person = view.mask == MaskState.PERSON
    # no value of a pixel that counts as hidden, finite or not, goes any further
    image = np.where((person & keep)[..., None], view.image, 0)[rows, columns].astype(np.float32) / 255
    return Target(
        camera=camera.cropped(columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start),
        width=camera.width,
        height=camera.height,
        joints=joints,
        transl=torch.from_numpy(np.array(view.body_pose.transl)).to(joints),
        image=torch.from_numpy(image).to(avatar.device),
        person=pixels(person),
        keep=pixels(keep),
    )


def left_out(view: TrainView, body: Body, config: GtuConfig) -> NDArray[np.bool_]:
    """[H, W] pixels that are in no loss: the occluder, and what is near to where it hides the body.

    Only there is it grown. Beside an occluder that stands in the scene the mask leaves a ring about the whole body
    unknown, which may be clothes; grown, it would take the visible limbs.
    """
    occluder = view.mask == MaskState.UNKNOWN
    if config.unknown != "ignore" or not occluder.any():
        return np.zeros_like(occluder)
    camera = view.camera
    points = camera.project(body.pose(view.body_pose))
    behind = rasterize(points, body.faces, camera.height, camera.width).mask & occluder
    return occluder | grown(behind, round(config.dilation * (camera.width + camera.height)))


def person_box(
    camera: Camera,
    vertices: NDArray[np.float64],  # [V, 3] m, world
    grown_by: float,
) -> tuple[slice, slice]:
    """Rows and columns of the projected vertices' box, so many times as wide and high, in the image; all of it where
    the body is not wholly in front of the camera or the box is beside the image."""
    p = camera.project(vertices)
    if (p[:, 2] > 0).all():
        low, high = p[:, :2].min(0), p[:, :2].max(0)
        middle, half = (low + high) / 2, grown_by * (high - low) / 2
        size = np.array([camera.width, camera.height], np.float64)
        x0, y0 = np.clip(np.floor(middle - half), 0, size).astype(int)
        x1, y1 = np.clip(np.ceil(middle + half), 0, size).astype(int)
        if x1 > x0 and y1 > y0:
            return slice(y0, y1), slice(x0, x1)
    return slice(0, camera.height), slice(0, camera.width)


def grown(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """A mask [H, W] dilated by a square of so many px; as it is by less than two."""
    if side < 2 or not mask.any():
        return mask
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)).astype(bool)


def reconstruction_loss(
    rgb: Tensor,  # [h, w, 3] drawn on the backdrop
    target: Target,
    backdrop: Tensor,  # [3] 0..1
    config: GtuConfig,
    perceptual: Perceptual | None = None,
) -> Tensor:
    """Of the person on this backdrop: L1, 1 - SSIM and LPIPS as means over the whole box, hidden pixels black in
    both pictures."""
    image = torch.lerp(backdrop.expand_as(target.image), target.image, target.person) * target.keep
    own = rgb * target.keep
    loss = (1 - config.ssim) * (own - image).abs().mean()
    if config.ssim > 0:
        loss = loss + config.ssim * dissimilarity(own, image, torch.ones_like(target.keep))
    if perceptual is not None and config.lpips > 0:
        # fed with values of 0 to 1 where the network expects -1 to 1, as released
        loss = loss + config.lpips * perceptual((own + 1) / 2, (image + 1) / 2)
    return loss


def undecided(
    alpha: Tensor,  # of any shape, 0..1
) -> Tensor:
    """R: the mean of ln(1 + 1/e) - ln(e^-a + e^(a - 1)), 0 at 0 and 1, largest, .12011, in the middle between."""
    return (R_OFFSET - torch.logaddexp(-alpha, alpha - 1)).mean()
