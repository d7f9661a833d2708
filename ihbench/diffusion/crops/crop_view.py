"""A training view cut to the person: what every inpainter is given."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.part_map import NO_PART, drawn_body, labels_of
from ihbench.diffusion.crops.person_crop import PersonCrop, person_crop
from ihbench.diffusion.crops.seen_surface import Cells, uv_cells
from ihbench.scene.contracts import MaskState, TrainView

EDGE = 1e-6  # share of a crop's pixel above which it counts


@dataclass(frozen=True)
class CropView:
    """One view at the inpainter's size. A crop's pixel is unknown if any part of it is."""

    index: int  # of the view in the training set
    image: NDArray[np.uint8]  # [S, W, 3] RGB; unknown pixels show whatever the view is painted with
    person: NDArray[np.bool_]  # [S, W] known, and mostly visible person
    unknown: NDArray[np.bool_]  # [S, W]
    parts: NDArray[np.uint8]  # [S, W] SMPL part of the posed body, 255 off it
    cells: Cells  # [S, W] of the body's UV chart
    crop: PersonCrop
    camera: Camera  # of the crop
    body_pose: BodyPose
    elsewhere: NDArray[np.uint8] | None = None  # [S, W, 4] RGB of surface that other frames show, and 255 there
    fill: NDArray[np.uint8] | None = None  # [S, W, 3] what a painter begins with in unknown pixels
    guide: NDArray[np.uint8] | None = None  # [S, W, 3] what guides it in the place of the part map's colours

    @property
    def body(self) -> NDArray[np.bool_]:
        """[S, W] where the posed body model is."""
        return self.parts != NO_PART

    @property
    def hidden_share(self) -> float:
        """Share of the posed body's pixels that are unknown; 0 for a body that is nowhere in the crop."""
        body = self.body
        return float((body & self.unknown).sum() / max(body.sum(), 1))

    def completed(self, painted: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[S, W, 3]: the original where it is known, `painted` elsewhere."""
        return np.where(self.unknown[..., None], painted, self.image)


def cut_view(view: TrainView, index: int, body: Body, size: int, square: bool = False) -> CropView:
    """Cut a training view to the padded box of its body, `size` px tall. What lies outside the image counts as known
    background: nothing can be learned or painted there."""
    return cut_to(view, index, body, person_crop(view.camera, body.pose(view.body_pose), size, square=square))


def cut_to(view: TrainView, index: int, body: Body, crop: PersonCrop) -> CropView:
    """Cut a training view to a crop, as `cut_view`."""
    vertices = body.pose(view.body_pose)
    image = crop.cut(view.image, 255)
    unknown = crop.cut(view.mask == MaskState.UNKNOWN) > EDGE
    person = crop.cut(view.mask == MaskState.PERSON) >= 0.5
    camera = crop.camera(view.camera)
    raster = drawn_body(vertices, body, camera)
    parts, cells = labels_of(raster, body), uv_cells(raster, body)
    return CropView(index, image, person & ~unknown, unknown, parts, cells, crop, camera, view.body_pose)


def with_frames(asked: list[CropView], frames: list[CropView]) -> list[CropView]:
    """The views to paint, then all other frames with nothing to paint: everything that was filmed, and nothing else.

    `frames[k]` is training view k. In `asked` only pixels that the camera showed stay known as person: what was drawn
    into a view by the avatar is no evidence, and of a turntable view (an index beyond the frames) nothing is.
    """
    nobody = [np.zeros_like(view.person) for view in asked]
    person = [
        frames[v.index].person if v.index < len(frames) else none for v, none in zip(asked, nobody, strict=True)
    ]
    indices = {view.index for view in asked}
    others = [replace(f, unknown=np.zeros_like(f.unknown)) for f in frames if f.index not in indices]
    return [replace(view, person=filmed) for view, filmed in zip(asked, person, strict=True)] + others


class Inpainter(Protocol):
    """Fills the unknown pixels of crops. Deterministic by its own seed."""

    name: str

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        """One completed crop [S, W, 3] per view, equal to the view's image where it is known."""
        ...
