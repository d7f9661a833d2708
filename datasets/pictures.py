"""Picture files of captures: decoded with a clear word about what is wrong, encoded in memory."""

from __future__ import annotations

import io
import warnings
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput

if TYPE_CHECKING:
    from PIL import Image


def opened(path: Path) -> Image.Image:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            return Image.open(path)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise BadInput(f"{path}: not a readable image ({one_line(error)}); copy the file again") from error


def decoded(path: Path, mode: str | None) -> NDArray[np.uint8]:
    with opened(path) as picture:
        try:
            picture.load()
        except (OSError, SyntaxError, ValueError, zlib.error) as error:
            raise BadInput(f"{path}: damaged or cut short ({one_line(error)}); copy the file again") from error
        if mode is None and picture.mode in ("LA", "RGBA"):  # an opaque alpha channel is no label
            mode = picture.mode.removesuffix("A")
        return np.array(picture if mode is None else picture.convert(mode))


def encoded(picture: NDArray[np.uint8], kind: str, **options: int) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, **options)
    return buffer.getvalue()


def one_line(error: object) -> str:
    return " ".join(str(error).split())[:120]
