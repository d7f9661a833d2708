"""Inpainting from the body's texture: what other frames, or its other side, show of the hidden surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ihbench.body import Body
from ihbench.body.uv import Texels, texel_table
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.part_map import NO_PART, smpl_parts
from ihbench.methods.inpainthuman.inpainting.colour_fills import mean_person, on_background
from ihbench.methods.inpainthuman.inpainting.surface_colours import counted_colours, off_the_rim, pixel_texels
from ihbench.scene.visibility import PosedSurface

Seen = tuple[NDArray[np.int64], NDArray[np.uint8]]  # texels [n], RGB [n, 3]
NEVER = -(2**40)  # index of a view that is farther away than any


@dataclass(frozen=True)
class TemporalCopy:
    """Every unknown pixel on the body takes the colour that its texel has in the view nearest in index that shows it,
    the earlier of two. Texels that no view shows get the mean colour of their body part over all views, or of the
    whole person where no view shows the part. Unknown pixels off the body get the background.

    Give it all views of a capture, also those with nothing hidden: they lend their colours.
    """

    body: Body
    background: tuple[float, float, float]  # RGB in [0, 1]
    texels: int = 256  # of the texture's side
    name = "temporal"
    mirrored = False

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        texels = texel_table(self.body, self.texels)
        seen, targets, pixels = [], [], []
        with progress.task("reading the texture", len(views)) as task:
            for view in views:
                seen.append(_seen(view, self.body, texels))
                number = pixel_texels(view, self.body, texels)
                pixels.append(view.unknown & (number >= 0))
                targets.append(number[pixels[-1]])
                task.advance()
        if self.mirrored:
            other = mirrored_texels(self.body, self.texels)
            targets = [other[texel] for texel in targets]
        index = np.array([view.index for view in views], np.int64)
        borrowed = nearest_colours(targets, seen, index, len(texels.index))
        means = _part_means(views)
        out = []
        for view, hidden, (colour, nearest) in zip(views, pixels, borrowed, strict=True):
            fill = np.where(nearest[:, None], colour, means[smpl_parts(view.parts)[hidden]])
            out.append(view.completed(on_background(hidden, fill, self.background)))
        return out


@dataclass(frozen=True)
class MirroredTexture(TemporalCopy):
    """As `TemporalCopy`, but with the texel on the other side of the body: the colour of the left hand for the right.
    The view itself counts as the nearest."""

    name = "mirror"
    mirrored = True


@lru_cache(maxsize=8)
def mirrored_texels(body: Body, resolution: int) -> NDArray[np.int32]:
    """[N] for each texel the one nearest to its rest-pose point reflected at x = 0. No symmetric mesh is needed."""
    points = texel_table(body, resolution).interpolate(body.v_template, body.faces)
    return np.asarray(KDTree(points).query(points * [-1, 1, 1])[1], np.int32)


def nearest_colours(
    wanted: list[NDArray[np.int32]],  # per view, texels [m] that want a colour
    seen: list[Seen],  # per view
    index: NDArray[np.int64],  # [V] of the views
    n_texels: int,
) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """Per view, RGB [m, 3] of the wanted texels in the view nearest in index that shows them, the earlier of two, and
    whether any does [m]. Two sweeps over the views, so that no table of all views and texels is needed."""
    best: list[tuple[NDArray[np.uint8], NDArray[np.int64]]] = [
        (np.zeros((len(texel), 3), np.uint8), np.full(len(texel), -NEVER)) for texel in wanted
    ]
    order = np.argsort(index, kind="stable")
    for sweep in (order, order[::-1]):
        colour = np.zeros((n_texels, 3), np.uint8)
        last = np.full(n_texels, NEVER)
        for k in sweep:
            texel, rgb = seen[k]
            colour[texel], last[texel] = rgb, index[k]
            old, far = best[k]
            away = np.abs(last[wanted[k]] - index[k])
            nearer = away < far
            best[k] = np.where(nearer[:, None], colour[wanted[k]], old), np.where(nearer, away, far)
    return [(colour, far < -NEVER // 2) for colour, far in best]


def _seen(view: CropView, body: Body, texels: Texels) -> Seen:
    faced = PosedSurface(body, view.camera, view.body_pose).faced(texels)
    texel, rgb = counted_colours(faced, view.image, view.person & off_the_rim(view))
    return texel, np.round(rgb).astype(np.uint8)


def _part_means(views: list[CropView]) -> NDArray[np.float64]:
    """[256, 3] RGB in 0..255, the mean visible colour of each SMPL part, the person's where it is not seen."""
    total, count = np.zeros((256, 3)), np.zeros(256)
    for view in views:
        part, rgb = smpl_parts(view.parts)[view.person], view.image[view.person]
        count += np.bincount(part, minlength=256)
        for channel in range(3):
            total[:, channel] += np.bincount(part, rgb[:, channel], minlength=256)
    count[NO_PART] = 0
    return np.where(count[:, None] > 0, total / np.maximum(count, 1)[:, None], mean_person(views))
