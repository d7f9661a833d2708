"""Frames as files: they can be read back, last as long as they should, and what cannot be written is said first."""

import io

import numpy as np
import pytest
from PIL import Image

from ihbench.errors import BadInput, MissingPrerequisite
from ihbench.show import movie


def moving(count=7, height=33, width=48):
    """A red square that goes over a grey ramp."""
    frames = []
    for k in range(count):
        frame = np.empty((height, width, 3), np.uint8)
        frame[:] = np.linspace(90, 160, width).astype(np.uint8)[None, :, None]
        frame[8:24, 4 * k : 4 * k + 16] = (220, 30, 20)
        frames.append(frame)
    return frames


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
@pytest.mark.parametrize("fps", [10, 24, 30])
def test_animations_are_read_back(suffix, fps):
    frames = moving()
    file = Image.open(io.BytesIO(movie.encoded(iter(frames), suffix, fps)))
    assert (file.n_frames, file.size) == (7, (48, 33))
    lasted = 0
    for k, frame in enumerate(frames):
        file.seek(k)
        shown = np.asarray(file.convert("RGB")).astype(int)
        lasted += file.info["duration"]
        assert np.abs(shown - frame).mean() < 8
    assert lasted == pytest.approx(7000 / fps, abs=5)
    assert file.info["loop"] == 0


@pytest.mark.parametrize("suffix", list(movie.CODECS))
def test_videos_are_read_back_or_refused_in_a_line(suffix, tmp_path, capfd):
    import cv2

    path = tmp_path / f"film{suffix}"
    if movie.codec_of(suffix) is None:
        with pytest.raises(MissingPrerequisite, match="no encoder"):
            movie.check_target(path)
        return
    assert movie.check_target(path) == suffix
    path.write_bytes(movie.encoded(iter(moving()), suffix, 10))
    film, shown = cv2.VideoCapture(str(path)), []
    while (got := film.read())[0]:
        shown.append(got[1][..., ::-1])
    assert len(shown) == 7
    assert shown[0].shape == (34, 48, 3)  # an odd height is filled up
    for frame, seen in zip(moving(), shown, strict=True):
        assert np.abs(seen[:33].astype(int) - frame).mean() < 16
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    assert capfd.readouterr().err == ""


def test_without_an_encoder_the_line_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr(movie, "codec_of", lambda suffix: None)
    with pytest.raises(MissingPrerequisite, match=r"\.webp or \.gif"):
        movie.check_target(tmp_path / "film.mp4")


def test_targets(tmp_path):
    assert movie.check_target(tmp_path) == ""
    assert movie.check_target(tmp_path / "frames") == ""
    assert movie.check_target(tmp_path / "A.WEBP") == ".webp"
    (tmp_path / "file").touch()
    for name in ("film.avi", "file"):
        with pytest.raises(BadInput, match="folder"):
            movie.check_target(tmp_path / name)
