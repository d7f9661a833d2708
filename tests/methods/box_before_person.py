"""A person who turns a little before a wall, behind a red box in most frames, with photographs of both. For tests of
what models its occluder."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ihbench.scene.contracts import MaskState, TrainingSet, TrainView
from ihbench.scene.occlusion import grown_for_clothes
from tests.bench.fake_capture import WHITE, a_camera, a_pose, rasterized, the_body, train_view

SIZE, FRAMES = 72, 5
BOX = np.s_[30:45, 15:57]  # rows and columns: hips and hands
RED = np.array([230, 20, 20], np.uint8)
CAMERA = a_camera(0.0, SIZE)


@dataclass(frozen=True)
class Shot:
    """A frame, and the truth about it."""

    view: TrainView
    complete: NDArray[np.bool_]  # [H, W] the person's silhouette, box or not
    boxed: NDArray[np.bool_]  # [H, W] where the box is
    wall: NDArray[np.uint8]  # [H, W, 3]


def wall() -> NDArray[np.uint8]:
    """[H, W, 3] green on one side, blue on the other."""
    share = np.linspace(0, 1, SIZE)[None, :, None]
    colours = (1 - share) * np.array([60.0, 170, 90]) + share * np.array([70.0, 90, 200])
    return np.broadcast_to(colours, (SIZE, SIZE, 3)).astype(np.uint8)


@cache
def shots(hidden: bool = True) -> tuple[Shot, ...]:
    """The box stands there in four of five frames, or in none."""
    out = []
    for k in range(FRAMES):
        pose = a_pose(0.25 * (k - 2), 0.1 * k)
        plain, complete = train_view(CAMERA, pose, frame=k), rasterized(CAMERA, pose).mask
        photograph = np.where(complete[..., None], plain.image, wall())
        boxed = np.zeros_like(complete)
        mask = np.where(complete, MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
        if hidden and k != 2:
            boxed[BOX] = True
            photograph = np.where(boxed[..., None], RED, photograph)
            mask[grown_for_clothes(complete) & ~(complete & ~boxed)] = MaskState.BACKGROUND
            mask[grown_for_clothes(complete) & boxed] = MaskState.UNKNOWN
        image = np.where((mask == MaskState.PERSON)[..., None], photograph, 255).astype(np.uint8)
        view = replace(plain, image=image, mask=mask, filmed=photograph.astype(np.uint8))
        out.append(Shot(view, complete, boxed, wall()))
    return tuple(out)


def boxed_set(hidden: bool = True) -> TrainingSet:
    return TrainingSet([shot.view for shot in shots(hidden)], the_body(), WHITE, "box")
