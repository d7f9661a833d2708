"""Camera paths in nerfbaselines' format: what its viewer saves is read, and what is written is read back."""

import json

import numpy as np
import pytest

from ihbench.camera import Camera, look_at
from ihbench.errors import BadInput
from ihbench.show.trajectory import read_trajectory, trajectory_json

# a frame as the viewer saves it: camera to world, row by row
POSE = [0.0, 0.0, -1.0, 3.0, 0.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.5]
SAVED = {
    "format": "nerfbaselines-v1", "camera_model": "pinhole", "image_size": [128, 72], "fps": 3,
    "source": {"type": "interpolation", "keyframes": [{"pose": POSE}], "is_cycle": False},
    "frames": [{"pose": POSE, "intrinsics": [60.0, 61.0, 64.0, 36.0], "appearance_weights": []}] * 3,
}  # fmt: skip


def test_a_saved_path_is_read(tmp_path):
    (tmp_path / "path.json").write_text(json.dumps(SAVED))
    path = read_trajectory(tmp_path / "path.json")
    assert (len(path.cameras), path.fps) == (3, 3.0)
    camera = path.cameras[0]
    assert (camera.width, camera.height) == (128, 72)
    np.testing.assert_allclose(camera.center, [3, 1, 0.5], atol=1e-12)
    ahead = camera.project(np.array([0.0, 1.0, 0.5]))  # it looks along world -x
    np.testing.assert_allclose(ahead, [64, 36, 3], atol=1e-9)
    above = camera.project(np.array([0.0, 1.5, 0.5]))
    assert above[1] < 36


def test_what_is_written_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    K = np.array([[80.0, 0, 31], [0, 82, 30], [0, 0, 1]])
    cameras = [Camera(K, *look_at(rng.normal(0, 3, 3), rng.normal(0, 1, 3)), 64, 60) for _ in range(4)]
    (tmp_path / "p.json").write_text(trajectory_json(cameras, 25.0))
    back = read_trajectory(tmp_path / "p.json")
    assert back.fps == 25.0
    for a, b in zip(cameras, back.cameras, strict=True):
        for name in ("K", "R", "t"):
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9)
    with pytest.raises(ValueError, match="one size"):
        trajectory_json([cameras[0], cameras[0].scaled(32, 30)], 25.0)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"frames": []}, "1 to"),
        ({"frames": "none"}, "a camera path"),
        ({"camera_model": "opencv_fisheye"}, "pinhole"),
        ({"image_size": [0, 5]}, "image_size"),
        ({"image_size": None}, "image_size"),
        ({"fps": "fast"}, "fps"),
        ({"frames": [{"pose": POSE}]}, "frame 0.*no 'intrinsics'"),
        ({"frames": [{"pose": POSE[:9], "intrinsics": [1, 1, 1, 1]}]}, "frame 0"),
        ({"frames": [{"pose": [2 * n for n in POSE], "intrinsics": [1, 1, 1, 1]}]}, "frame 0.*rotations"),
        ({"frames": [{"pose": POSE, "intrinsics": [1, 1, 1]}]}, "frame 0"),
        ({"frames": [SAVED["frames"][0], 7]}, "frame 1"),
    ],
)
def test_other_paths_are_refused_in_a_line(tmp_path, change, word):
    (tmp_path / "path.json").write_text(json.dumps(SAVED | change))
    with pytest.raises(BadInput, match=word):
        read_trajectory(tmp_path / "path.json")
