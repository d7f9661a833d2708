"""Images as arrays: predictions read with their alpha composited, and PNG written.

What the colours of half transparent pixels are, file formats do not say for sure: "straight" (the colour itself),
"premultiplied" (times alpha) or "composited" (on the background already, beside an alpha channel).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.files.atomic import write_bytes
from ihbench.files.pictures import encoded, read_picture
from ihbench.files.safe_pickle import load_npy

ALPHAS = ("straight", "premultiplied", "composited")


def read_image(path: Path, background: tuple[float, float, float], alpha: str = ALPHAS[0]) -> NDArray:
    """[H, W, 3]: uint8 from 8-bit files, float in [0, 1] from 16-bit PNG and float arrays (.npy).

    Transparent images are composited on `background`, see ALPHAS; grey ones get three equal channels. Raises
    `BadInput` for what cannot be read or is no image.
    """
    image = read_channels(path)
    if image.shape[2] in (2, 4):
        image = _composited(image[..., :-1], image[..., -1:], background, alpha)
    return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else np.ascontiguousarray(image)


def _composited(color: NDArray, share: NDArray, background: tuple[float, float, float], alpha: str) -> NDArray:
    """[H, W, 1 or 3] colours [H, W, 1 or 3] with alpha `share` [H, W, 1] on the background."""
    if alpha == "composited" or (color.dtype == np.uint8 and (share == 255).all()):
        return color
    if color.dtype == np.uint8:
        color, share = color / 255.0, share / 255.0
    painted = color * share if alpha == "straight" else color
    return painted + np.asarray(background, color.dtype) * (1 - share)


def read_channels(path: Path) -> NDArray:
    """[H, W, 1 to 4] as `read_image` says, with its alpha channel."""
    if path.suffix.lower() == ".npy":
        image = _read_array(path)
    else:
        image = read_picture(path, f"prediction {path}").values
        image = image if image.dtype == np.uint8 else image.astype(np.float32) / 65535
    if image.ndim == 2:
        image = image[..., None]
    if image.ndim != 3 or image.shape[2] not in (1, 2, 3, 4) or 0 in image.shape:
        hint = "; move its channels last" if image.ndim == 3 and image.shape[0] in (1, 2, 3, 4) else ""
        raise BadInput(
            f"prediction {path}: expected an image [H, W], [H, W, 3] or [H, W, 4], got shape {image.shape}{hint}"
        )
    return image


def _read_array(path: Path) -> NDArray:
    try:
        array = load_npy(path)
    except BadInput as error:
        raise BadInput(f"prediction {error}") from error
    if array.dtype != np.uint8 and array.dtype.kind != "f":
        raise BadInput(f"prediction {path}: expected uint8, or floats in [0, 1], got {array.dtype}")
    return array.astype(np.float32) if array.dtype.itemsize > 8 else array


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an RGB image whole or not at all. Raises `BadInput` when the disk does not take it."""
    write_bytes(path, encoded(image, "PNG", compress_level=1), durable=False)
