"""Frames as one file that moves, by the file's suffix, or as a folder of PNG files.

WebP and GIF are written by Pillow. WebM (VP9) and MP4 need an encoder in OpenCV's build, which its wheels have or
have not: `check_target` tries, before anything is rendered. MP4 is H.264 where the build has it; else MPEG-4 part 2,
which players take and browsers do not.
"""

from __future__ import annotations

import io
import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput, MissingPrerequisite

Frame = NDArray[np.uint8]  # [H, W, 3] RGB

CODECS = {".webm": ("VP90", "VP80"), ".mp4": ("avc1", "mp4v")}  # by preference
SUFFIXES = (".webp", ".gif", *CODECS)
WEBP_QUALITY = 90
PALETTE_FRAMES = 8  # of a GIF, from which its one palette is made: one of each frame's own would flicker


def check_target(out: Path) -> str:
    """The suffix that a path names; "" for a folder of frames. Raises `BadInput` for another one, and
    `MissingPrerequisite` where nothing here can write it."""
    if out.is_dir() or out.suffix == "":
        if out.exists() and not out.is_dir():
            raise BadInput(f"--out {out}: is a file without a suffix; name one of {', '.join(SUFFIXES)}, or a folder")
        return ""
    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        raise BadInput(f"--out {out}: expected a name that ends in {', '.join(SUFFIXES)}, or a folder for PNG frames")
    if suffix in CODECS and codec_of(suffix) is None:
        raise MissingPrerequisite(
            f"--out {out}: OpenCV's build here has no encoder for {suffix}; write .webp or .gif, or a folder "
            "of PNG frames for ffmpeg"
        )
    return suffix


def codec_of(suffix: str) -> str | None:
    """The first of the suffix's codecs that can be opened here."""
    for codec in CODECS[suffix]:
        with tempfile.TemporaryDirectory() as folder, _quiet():
            writer = _writer(Path(folder) / f"try{suffix}", codec, 25.0, 64, 64)
            opened = writer.isOpened()
            writer.release()
        if opened:
            return codec
    return None


def encoded(frames: Iterable[Frame], suffix: str, fps: float) -> bytes:
    """The file of these frames. Raises `ValueError` for none."""
    if suffix in CODECS:
        return _video(frames, suffix, fps)
    return _animation(list(frames), suffix, fps)


def _animation(frames: Sequence[Frame], suffix: str, fps: float) -> bytes:
    from PIL import Image

    if not frames:
        raise ValueError("animation: expected at least one frame")
    images = [Image.fromarray(frame) for frame in frames]
    buffer, more = io.BytesIO(), {}
    if suffix == ".gif":
        images = _on_one_palette(images)
        more = {"optimize": False, "disposal": 1}
    else:
        more = {"quality": WEBP_QUALITY, "method": 4, "minimize_size": True}
    durations = _durations(len(frames), fps, 10 if suffix == ".gif" else 1)
    kind = suffix.removeprefix(".").upper()
    timing: dict[str, Any] = {"duration": durations, "loop": 0, "save_all": True}
    images[0].save(buffer, kind, append_images=images[1:], **timing, **more)
    return buffer.getvalue()


def _durations(count: int, fps: float, unit: int) -> list[int]:
    """[count] ms of each frame, in whole units: together they last as long as they should."""
    ends = [round(k * 1000 / fps / unit) * unit for k in range(count + 1)]
    return [max(unit, end - start) for start, end in pairwise(ends)]


def _on_one_palette(images: list[Any]) -> list[Any]:
    from PIL import Image

    chosen = sorted(
        set(np.linspace(0, len(images) - 1, min(PALETTE_FRAMES, len(images))).round().astype(int).tolist())
    )
    strip = Image.fromarray(np.concatenate([np.asarray(images[k]) for k in chosen]))
    palette = strip.quantize(256, method=Image.Quantize.MEDIANCUT)
    return [image.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for image in images]


def _video(frames: Iterable[Frame], suffix: str, fps: float) -> bytes:
    codec = codec_of(suffix)
    if codec is None:
        raise MissingPrerequisite(f"OpenCV's build here has no encoder for {suffix}")
    with tempfile.TemporaryDirectory() as folder:
        path, writer = Path(folder) / f"whole{suffix}", None
        for frame in frames:
            # encoders of 4:2:0 colour take even sizes only
            even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
            if writer is None:
                with _quiet():
                    writer = _writer(path, codec, fps, even.shape[1], even.shape[0])
            writer.write(np.ascontiguousarray(even[..., ::-1]))
        if writer is None:
            raise ValueError("video: expected at least one frame")
        writer.release()
        data = path.read_bytes() if path.is_file() else b""
    if len(data) < 100:
        raise MissingPrerequisite(f"OpenCV wrote no {suffix} here; write .webp or .gif, or PNG frames and use ffmpeg")
    return data


def _writer(path: Path, codec: str, fps: float, width: int, height: int) -> Any:
    import cv2

    fourcc: Callable[..., int] = cv2.VideoWriter.fourcc
    return cv2.VideoWriter(str(path), fourcc(*codec), fps, (width, height))


@contextmanager
def _quiet() -> Iterator[None]:
    """Without what ffmpeg says on the process's own stderr about codecs that it tries."""
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, AttributeError, ValueError):
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)
