"""Hidden faces as painters leave them, at the scale of head crops."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.diffusion.crops.head_crop import PaintedHead, head_views
from ihbench.diffusion.crops.head_places import head_of, marked
from ihbench.scene.contracts import TrainView

Image = NDArray[np.uint8]


class HiddenFaces:
    """The head crops of views in which an eye, a brow, the nose or the mouth is hidden."""

    def __init__(
        self,
        crops: list[CropView],
        occluded: Mapping[int, TrainView],
        whole: Mapping[int, TrainView],  # the same views without the occluder
        body: Body,
    ):
        self.crops, self.occluded, self.body = crops, occluded, body
        blank = [crop.image for crop in crops]
        self.views = {k: view for k, view in head_views(crops, occluded, blank, body).items() if _face(view).any()}
        self.truths = {k: view.crop.cut(whole[view.index].image, 255) for k, view in self.views.items()}

    def images(self, painted: list[Image], heads: Mapping[int, PaintedHead]) -> dict[int, Image]:
        """Number of a crop -> its head crop: as it was painted at that scale, else with the crop enlarged."""
        begun = head_views(self.crops, self.occluded, painted, self.body)
        out = {}
        for k in self.views:
            fill = begun[k].fill
            assert fill is not None, "head views begin with something"
            out[k] = heads[k].image if k in heads else begun[k].completed(fill)
        return out

    def psnr(self, images: Mapping[int, Image]) -> float:
        """dB over hidden pixels of the heads, pooled; NaN where no face is hidden."""
        error, count = 0.0, 0
        for k, view in self.views.items():
            where = head_of(view.parts) & view.unknown
            error += float(np.square((images[k][where].astype(float) - self.truths[k][where]) / 255).sum())
            count += 3 * int(where.sum())
        return float(-10 * np.log10(max(error / count, 1e-10))) if count else float("nan")

    def row(self, images: Mapping[int, Image], most: int) -> Sequence[Image]:
        """At most so many of the images, evenly spread over the views."""
        order = sorted(images)
        return [
            images[order[n]] for n in np.unique(np.linspace(0, len(order) - 1, min(most, len(order))).astype(int))
        ]


def _face(view: CropView) -> NDArray[np.bool_]:
    """[S, W] hidden features of the face."""
    return marked(view.guide) & head_of(view.parts) & view.unknown
