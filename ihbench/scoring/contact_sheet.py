"""A contact sheet per run: occluded input, truth, prediction and error side by side, to be looked at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ihbench.metrics.eight_bit import as_float, displayed
from ihbench.metrics.images import as_image, bounds, check_images, grown
from ihbench.scene.contracts import MaskState, TrainView

COLUMNS = ("training input", "truth", "prediction", "error x4")
PAD, LABEL = 6, 18  # px
GREY = 70
OCCLUDER = 168


@dataclass(frozen=True)
class SheetRow:
    label: str
    training: NDArray[np.uint8]  # [H, W, 3] an occluded training image of about the same moment
    truth: NDArray[np.float32]  # [H, W, 3] in [0, 1]
    prediction: NDArray[np.float32]  # [H, W, 3] in [0, 1]
    hidden: NDArray[np.bool_] | None = None  # [H, W] where the truth is not known: drawn grey, no error

    def __post_init__(self) -> None:
        """Raises `ValueError` for other layouts; uint8 becomes float, and what is out of range is clipped later."""
        for name in ("truth", "prediction"):
            image = as_float(as_image(getattr(self, name), name, hdr=True))
            object.__setattr__(self, name, image.astype(np.float32, copy=False))
        check_images(self.prediction, self.truth)
        if self.training.dtype != np.uint8 or self.training.shape[2:] != (3,):
            raise ValueError(
                f"training: expected uint8 [H, W, 3], got {self.training.dtype} {list(self.training.shape)}"
            )


def error_image(
    prediction: NDArray[np.float32],  # [H, W, 3]
    truth: NDArray[np.float32],  # [H, W, 3]
) -> NDArray[np.uint8]:
    """[H, W, 3] mean absolute error over the channels, times four: black is right, white is wrong by a quarter or
    more. uint8 images, whose differences would wrap around, become floats first."""
    prediction, truth = (as_float(as_image(image, hdr=True)) for image in (prediction, truth))
    check_images(prediction, truth)
    error = np.abs(prediction - truth).mean(-1, keepdims=True) * 4
    return np.repeat(displayed(error), 3, -1)


def contact_sheet(rows: Sequence[SheetRow], title: str, zoom: int = 1) -> NDArray[np.uint8]:
    """[H, W, 3] one row of four images per view, cut to the person, under a title line and column heads.

    `zoom` repeats every pixel that many times in both directions, so that small images can be judged by eye.
    """
    from PIL import Image, ImageDraw

    cells = []
    for row in rows:
        truth, error = displayed(row.truth), error_image(row.prediction, row.truth)
        if row.hidden is not None:
            truth[row.hidden] = error[row.hidden] = GREY
        images = (row.training, truth, displayed(row.prediction), error)
        window = common_window([displayed(row.truth), displayed(row.prediction)])
        cut = [images[0][picture_window(row.training)]] + [image[window] for image in images[1:]]
        cells.append([image.repeat(zoom, 0).repeat(zoom, 1) for image in cut])
    height = max(cell.shape[0] for line in cells for cell in line)
    width = max(110, *(cell.shape[1] for line in cells for cell in line))
    extent = len(COLUMNS) * (width + PAD) + PAD, 2 * LABEL + len(cells) * (height + LABEL + PAD) + PAD
    sheet = Image.new("RGB", extent, (GREY, GREY, GREY))
    draw = ImageDraw.Draw(sheet)
    draw.text((PAD, 3), title, fill=(255, 255, 255))
    for c, name in enumerate(COLUMNS):
        draw.text((PAD + c * (width + PAD), LABEL + 2), name, fill=(210, 210, 210))
    for r, (row, line) in enumerate(zip(rows, cells, strict=True)):
        y = 2 * LABEL + r * (height + LABEL + PAD)
        draw.text((PAD, y + 2), row.label, fill=(210, 210, 210))
        for c, cell in enumerate(line):
            x = PAD + c * (width + PAD) + (width - cell.shape[1]) // 2
            sheet.paste(Image.fromarray(np.ascontiguousarray(cell)), (x, y + LABEL))
    return np.asarray(sheet)


def with_occluder(view: TrainView) -> NDArray[np.uint8]:
    """[H, W, 3] a training image with what the occluder hides in grey: on white it would look like background."""
    return np.where((view.mask == MaskState.UNKNOWN)[..., None], np.uint8(OCCLUDER), view.image)


def picture_window(image: NDArray[np.uint8], margin: int = 4) -> tuple[slice, slice]:
    """Rows and columns of an image [H, W, 3] that differ from its corner's colour; all of them where none does."""
    area = bounds((np.abs(image.astype(int) - image[0, 0].astype(int)) > 8).any(-1))
    return grown(area or (slice(0, image.shape[0]), slice(0, image.shape[1])), margin, image.shape)


def common_window(images: Sequence[NDArray[np.uint8]]) -> tuple[slice, slice]:
    """The smallest window that holds the windows of several images of one size."""
    rows, columns = zip(*map(picture_window, images), strict=True)

    def whole(along: Sequence[slice]) -> slice:
        return slice(min(s.start for s in along), max(s.stop for s in along))

    return whole(rows), whole(columns)
