"""Inpainting that knows nothing of people: one colour, the nearest ones, OpenCV's classics. Every figure's floor."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.diffusion.crops.crop_view import CropView

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
        out = []
        with progress.task("filling with the mean colour", len(views)) as task:
            for view in views:
                own = mean_person([view]) if view.person.any() else everybody
                out.append(view.completed(on_background(view.body, own, self.background)))
                task.advance()
        return out


@dataclass(frozen=True)
class Telea:
    """A. Telea, "An Image Inpainting Technique Based on the Fast Marching Method", 2004, over the whole crop."""

    name = "telea"

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        return _opencv(views, cv2.INPAINT_TELEA, progress)


@dataclass(frozen=True)
class NavierStokes:
    """Bertalmio et al., "Navier-Stokes, Fluid Dynamics, and Image and Video Inpainting", 2001, over the crop."""

    name = "navier-stokes"

    def inpaint(self, views: list[CropView], progress: Progress) -> list[NDArray[np.uint8]]:
        return _opencv(views, cv2.INPAINT_NS, progress)


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
        out = []
        with progress.task("filling by push-pull", len(views)) as task:
            for view in views:
                image = torch.from_numpy(view.image).movedim(-1, 0)[None].float()
                known = torch.from_numpy(view.person)[None, None].float()
                colours = push_pull(image, known)[0].movedim(0, -1).numpy()[view.body]
                own = colours if view.person.any() else everybody
                out.append(view.completed(on_background(view.body, own, self.background)))
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


def _opencv(views: list[CropView], method: int, progress: Progress) -> list[NDArray[np.uint8]]:
    out = []
    with progress.task("filling with OpenCV", len(views)) as task:
        for view in views:
            image = view.image
            if view.unknown.any():
                # OpenCV returns an image as it is when no pixel is known: then it is grey
                blank = np.where(view.unknown[..., None], np.uint8(GREY), image)
                painted = cv2.inpaint(blank, view.unknown.astype(np.uint8), RADIUS, method)
                image = view.completed(np.asarray(painted, np.uint8))
            out.append(image)
            task.advance()
    return out
