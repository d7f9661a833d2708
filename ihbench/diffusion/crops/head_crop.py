"""Head crops: a head at twice the scale of a person crop, where a face has room for eyes.

In a crop of the whole person a head is 17 px tall. So heads are painted twice: coarsely with the person, then once
more in a crop of their own that begins with what was painted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.camera import Camera
from ihbench.diffusion.crops.crop_view import CropView, cut_to
from ihbench.diffusion.crops.head_places import head_guide, head_of, head_vertices
from ihbench.diffusion.crops.part_map import drawn_body
from ihbench.diffusion.crops.person_crop import PersonCrop
from ihbench.scene.contracts import TrainView

A_PERSON_CROP = 4  # so many head crops have the pixels of a person crop
WIDTH = 0.75  # of the crop, as a share of its height
ROOM = 1.7  # height of the crop over the longer side of the head's box: hair stands off
AROUND = 5  # px of a crop 64 px tall about the body model's head that are taken from its painting: hair again


def head_size(size: int) -> int:
    """px, height of the head crops of a model whose person crops are `size` px tall."""
    return size // 2


def head_crop(
    camera: Camera,
    vertices: NDArray[np.float64],  # [V, 3] m world, the posed body
    body: Body,
    size: int,
    room: float = ROOM,
) -> PersonCrop | None:
    """The window around a posed body's head, `size` px tall; None for a head that is not wholly before the camera."""
    p = camera.project(vertices[head_vertices(body)])
    if not len(p) or not (np.isfinite(p).all() and (p[:, 2] > 0).all()):
        return None
    low, high = p[:, :2].min(0), p[:, :2].max(0)
    height = int(np.ceil(max(room * (high - low).max(), 8.0)))
    width = max(round(WIDTH * height), 1)
    x0, y0 = np.round((low + high) / 2 - np.array([width, height]) / 2).astype(int)
    return PersonCrop(int(x0), int(y0), width, height, round(WIDTH * size), size)


@dataclass(frozen=True)
class PaintedHead:
    """A head crop, its pixels at twice the person crop's scale."""

    view: CropView
    image: NDArray[np.uint8]  # [S, W, 3] completed

    def onto(self, image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """A copy of an image [H, W, 3] of the whole view with the head's unknown pixels pasted, and where [H, W]."""
        crop, region = self.view.crop, head_region(self.view)
        where = crop.paste(region.astype(np.float32), np.zeros(image.shape[:2], np.float32)) >= 0.5
        return np.where(where[..., None], crop.paste(self.image.astype(np.float32), image), image), where


def head_region(view: CropView) -> NDArray[np.bool_]:
    """[S, W] pixels of a head crop that its painter answers for: unknown, on the head or close to it."""
    head = head_of(view.parts).astype(np.uint8)
    reach = 2 * round(AROUND * view.crop.height / 64) + 1
    near = cv2.dilate(head, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach)))
    return near.astype(bool) & view.unknown


def head_views(
    crops: list[CropView], shown: Mapping[int, TrainView], painted: list[NDArray[np.uint8]], body: Body
) -> dict[int, CropView]:
    """Number of a person crop -> its head crop, where some of the head is unknown. `shown` has the views by the
    crops' indices, `painted` what the crops' unknown pixels were painted with: what a head's painter begins with."""
    out = {}
    for k, (crop, image) in enumerate(zip(crops, painted, strict=True)):
        if not (head_of(crop.parts) & crop.unknown).any():
            continue
        view = shown[crop.index]
        vertices = body.pose(view.body_pose)
        window = head_crop(view.camera, vertices, body, head_size(crop.crop.height))
        if window is None:
            continue
        head = cut_to(view, crop.index, body, window)
        begun = window.cut(crop.crop.paste(image.astype(np.float32), view.image.astype(np.float32)), 255)
        guide = head_guide(drawn_body(vertices, body, head.camera), body)
        head = replace(head, fill=np.clip(np.rint(begun), 0, 255).astype(np.uint8), guide=guide)
        if head_region(head).any():
            out[k] = head
    return out


def with_head(crop: CropView, painted: NDArray[np.uint8], head: PaintedHead, view: TrainView) -> NDArray[np.uint8]:
    """[S, W, 3] a painted person crop with the head's painting in it, at the person crop's scale."""
    whole = crop.crop.paste(painted.astype(np.float32), view.image.astype(np.float32))
    image, where = head.onto(whole)
    small = np.clip(np.rint(crop.crop.cut(image, 255)), 0, 255).astype(np.uint8)
    taken = (crop.crop.cut(where) >= 0.5) & crop.unknown
    return np.where(taken[..., None], small, painted)
