"""What an avatar shows where the occluder hid the surface in most of the training frames: alpha and colour."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.scene.contracts import Avatar, TrainingSet
from ihbench.scene.sightings import COARSE
from ihbench.scene.visibility import PosedSurface


@dataclass(frozen=True)
class Signature:
    """Of the pixels, over all views, in which the surface hidden in more than a share of its frames is nearest."""

    pixels: int
    alpha: float  # mean
    from_background: float  # median distance of the colour from the background's, largest channel, in 0..1
    colored_alike: float  # share of the pixels within 0.15 of the background


def hidden_signature(
    avatar: Avatar,
    training: TrainingSet,
    views: Sequence[tuple[Camera, BodyPose]],
    share: float = 0.7,
) -> Signature:
    sightings = training.sightings[COARSE]
    faced, seen = sightings.visibility.faced, sightings.visibility.seen
    often = (faced > 0) & (faced - seen > share * np.maximum(faced, 1))
    alphas: list[NDArray] = []
    colors: list[NDArray] = []
    for camera, body_pose in views:
        surface = PosedSurface(training.body, camera, body_pose).faced(sightings.texels)
        chosen = often[surface.texel]
        row, column = (axis[chosen] for axis in surface.pixel)
        rgb, alpha = avatar.render(camera, body_pose, training.background)
        alphas.append(alpha[row, column])
        colors.append(np.abs(rgb[row, column] - np.asarray(training.background)).max(1))
    alpha, color = np.concatenate(alphas), np.concatenate(colors)
    return Signature(len(alpha), float(alpha.mean()), float(np.median(color)), float((color <= 0.15).mean()))


def silhouette_iou(avatar: Avatar, body, views: Sequence[tuple[Camera, BodyPose]]) -> float:
    """Of alpha above one half and the body's own silhouette, over all views."""
    from ihbench.render.zbuffer import rasterize

    both = either = 0
    for camera, body_pose in views:
        drawn = avatar.render(camera, body_pose)[1] > 0.5
        own = rasterize(camera.project(body.pose(body_pose)), body.faces, camera.height, camera.width).mask
        both, either = both + int((drawn & own).sum()), either + int((drawn | own).sum())
    return both / max(either, 1)
