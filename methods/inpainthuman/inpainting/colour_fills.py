"""Inpainting that knows nothing of people: one colour, the nearest ones, the classics of OpenCV and
scikit-image. Every figure's floor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView
from ihbench.errors import BadInput

Image = NDArray[np.uint8]  # [S, W, 3] RGB
RADIUS = 3.0  # px, the neighbourhood that OpenCV's methods look at
GREY = 128  # where nothing at all is known


@dataclass(frozen=True)
class MeanColour:
    """Unknown pixels on the posed body get the mean colour of the view's visible person (of all views' where it shows
    none, grey where none does), unknown pixels off it the background."""

    background: tuple[float, float, float]  # RGB in [0, 1]
    name = "mean"

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        everybody = mean_person(views)

        def paint(view: CropView) -> Image:
            own = mean_person([view]) if view.person.any() else everybody
            return on_background(view.body, own, self.background)

        return _filled(views, progress, "with the mean colour", paint)


@dataclass(frozen=True)
class ImageFill:
    """A classic of whole images, over the whole crop."""

    name: str
    paint: Callable[[Image, NDArray[np.bool_]], Image]  # image [S, W, 3], unknown [S, W] -> painted [S, W, 3]

    def inpaint(self, views: list[CropView], progress: Progress) -> list[Image]:
        def paint(view: CropView) -> Image:
            # with no known pixel the image stays as it is: grey
            blank = np.where(view.unknown[..., None], np.uint8(GREY), view.image)
            some = view.unknown.any() and not view.unknown.all()
            return self.paint(blank, view.unknown) if some else blank

        return _filled(views, progress, f"by {self.name}", paint)


def _opencv(method: int, image: Image, unknown: NDArray[np.bool_]) -> Image:
    return np.asarray(cv2.inpaint(image, unknown.astype(np.uint8), RADIUS, method), np.uint8)


def _xphoto(method: str, image: Image, unknown: NDArray[np.bool_]) -> Image:
    """Raises `BadInput` where OpenCV comes without its contributed modules."""
    module = getattr(cv2, "xphoto", None)
    if module is None:
        raise BadInput("filler: this OpenCV has no cv2.xphoto; pip install opencv-contrib-python-headless")
    lab = method == "INPAINT_SHIFTMAP"  # compares patches in CIE Lab
    given = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2Lab), np.uint8) if lab else image
    out = np.zeros_like(given)
    module.inpaint(given, np.where(unknown, np.uint8(0), np.uint8(255)), out, getattr(module, method))
    return np.asarray(cv2.cvtColor(out, cv2.COLOR_Lab2RGB) if lab else out, np.uint8)


def _biharmonic(image: Image, unknown: NDArray[np.bool_]) -> Image:
    from skimage.restoration import inpaint_biharmonic

    return np.round(255 * inpaint_biharmonic(image, unknown, channel_axis=-1)).astype(np.uint8)


IMAGE_FILLS = (
    # A. Telea, "An Image Inpainting Technique Based on the Fast Marching Method", 2004
    ImageFill("telea", partial(_opencv, cv2.INPAINT_TELEA)),
    # Bertalmio et al., "Navier-Stokes, Fluid Dynamics, and Image and Video Inpainting", 2001
    ImageFill("navier-stokes", partial(_opencv, cv2.INPAINT_NS)),
    # He and Sun, "Statistics of Patch Offsets for Image Completion", 2012
    ImageFill("shift-map", partial(_xphoto, "INPAINT_SHIFTMAP")),
    # Genser et al., "Spectral Constrained Frequency Selective Extrapolation for Rapid Image Error Concealment", 2018
    ImageFill("fsr", partial(_xphoto, "INPAINT_FSR_FAST")),
    # Damelin and Hoang, "On Surface Completion and Image Inpainting by Biharmonic Functions", 2018
    ImageFill("biharmonic", _biharmonic),
)


@dataclass(frozen=True)
class PushPull:
    """Unknown pixels on the posed body get the colours of the visible person around them (`push_pull`), unknown
    pixels off it the background."""

    background: tuple[float, float, float]  # RGB in [0, 1]
    name = "push-pull"

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        import torch

        from ihbench.diffusion.crops.push_pull import push_pull

        everybody = mean_person(views)

        def paint(view: CropView) -> Image:
            image = torch.from_numpy(view.image).movedim(-1, 0)[None].float()
            known = torch.from_numpy(view.person)[None, None].float()
            colours = push_pull(image, known)[0].movedim(0, -1).numpy()[view.body]
            return on_background(view.body, colours if view.person.any() else everybody, self.background)

        return _filled(views, progress, "by push-pull", paint)


def _filled(views: list[CropView], progress: Progress, how: str, paint: Callable[[CropView], Image]) -> list[Image]:
    """Every view, completed by what is painted of it."""
    out = []
    with progress.task(f"filling {how}", len(views)) as task:
        for view in views:
            out.append(view.completed(paint(view)))
            task.advance()
    return out


def mean_person(views: list[CropView]) -> NDArray[np.float64]:
    """[3] RGB in 0..255, the mean over the visible person's pixels of all views; grey if there are none."""
    total = sum((view.image[view.person].sum(0, dtype=np.float64) for view in views), np.zeros(3))
    count = sum(int(view.person.sum()) for view in views)
    return total / count if count else np.full(3, float(GREY))


def on_background(
    body: NDArray[np.bool_],  # [S, W]
    colour: NDArray[np.floating],  # [3], or [n, 3] for the True pixels of body; 0..255
    background: tuple[float, float, float],  # RGB in [0, 1]
) -> NDArray[np.uint8]:
    """[S, W, 3] the body in this colour before the background."""
    out = np.empty((*body.shape, 3), np.uint8)
    out[:] = np.round(255 * np.asarray(background))
    out[body] = np.round(colour)
    return out
