"""Pictures beside each other under their names."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

GAP = 4  # px between two pictures
SMALLEST, LARGEST = 10, 28  # px of the letters


def beside(
    pictures: Sequence[NDArray[np.uint8]], names: Sequence[str], background: Sequence[float]
) -> NDArray[np.uint8]:
    """[h, w, 3] of pictures [H, W, 3], top edges level, in the order given; without names without a line above."""
    height = max(picture.shape[0] for picture in pictures)
    paint = np.array([round(255 * c) for c in background], np.uint8)
    gap = np.broadcast_to(paint, (height, GAP, 3))
    row: list[NDArray[np.uint8]] = []
    for picture in pictures:
        below = height - picture.shape[0]
        filled = np.concatenate([picture, np.broadcast_to(paint, (below, picture.shape[1], 3))]) if below else picture
        row += [gap, filled] if row else [filled]
    whole = np.concatenate(row, 1)
    if not names:
        return whole
    return np.concatenate([_captions([p.shape[1] for p in pictures], names, paint), whole])


def _captions(widths: Sequence[int], names: Sequence[str], paint: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[h, w, 3] a line with each name over the middle of its picture; long ones are cut."""
    from PIL import Image, ImageDraw, ImageFont

    size = int(np.clip(min(widths) / 14, SMALLEST, LARGEST))
    font = ImageFont.load_default(size)
    line = Image.new("RGB", (sum(widths) + GAP * (len(widths) - 1), round(1.7 * size)), tuple(map(int, paint)))
    draw = ImageDraw.Draw(line)
    ink = (32, 32, 32) if paint.mean() > 127 else (224, 224, 224)
    x = 0
    for width, name in zip(widths, names, strict=True):
        shown = name
        while len(shown) > 1 and draw.textlength(shown, font) > width - 4:
            shown = shown[:-2] + "…"
        draw.text((x + width / 2, round(0.85 * size)), shown, fill=ink, font=font, anchor="mm")
        x += width + GAP
    return np.asarray(line)
