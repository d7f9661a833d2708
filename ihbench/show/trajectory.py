"""Camera paths as nerfbaselines' viewer saves them (`nerfbaselines/io.py`), read and written.

    {"format": "nerfbaselines-v1", "camera_model": "pinhole", "image_size": [w, h], "fps": 25,
     "frames": [{"pose": [12 numbers: camera to world, 3 x 4, row by row], "intrinsics": [fx, fy, cx, cy]}, ...]}

Cameras look along +z with y down; metres, in the world of the body that is shown.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ihbench.camera import Camera
from ihbench.errors import BadInput
from ihbench.files import atomic

FORMAT = "nerfbaselines-v1"
MOST = 100_000  # cameras of a path


@dataclass(frozen=True)
class Trajectory:
    cameras: tuple[Camera, ...]
    fps: float | None = None  # None where the file does not say


def read_trajectory(path: Path) -> Trajectory:
    """Raises `BadInput` for another file, and for cameras that are none, with their number."""
    content = atomic.read_json(path)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise BadInput(f"{path}: expected a camera path: an object with 'frames', as nerfbaselines' viewer saves it")
    model, frames = content.get("camera_model", "pinhole"), content["frames"]
    if model != "pinhole":
        raise BadInput(f"{path}: camera_model {str(model)[:40]!r}: expected 'pinhole'")
    if not 1 <= len(frames) <= MOST:
        raise BadInput(f"{path}: expected 1 to {MOST} frames, got {len(frames)}")
    width, height = _size(path, content.get("image_size"))
    cameras = tuple(_camera(f"{path}: frame {k}", frame, width, height) for k, frame in enumerate(frames))
    fps = content.get("fps")
    if fps is not None and not (isinstance(fps, int | float) and 0.1 <= fps <= 1000):
        raise BadInput(f"{path}: fps {str(fps)[:40]}: expected 0.1 to 1000")
    return Trajectory(cameras, None if fps is None else float(fps))


def _size(path: Path, size: Any) -> tuple[int, int]:
    """One size for all frames; nerfbaselines has no other."""
    if not (isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) and 1 <= n <= 16384 for n in size)):
        raise BadInput(f"{path}: image_size {str(size)[:40]}: expected [width, height] in pixels")
    return size[0], size[1]


def _camera(where: str, frame: Any, width: int, height: int) -> Camera:
    try:
        pose = np.array(frame["pose"], np.float64).reshape(-1)
        fx, fy, cx, cy = np.array(frame["intrinsics"], np.float64).reshape(-1)
        to_world = pose[:12].reshape(3, 4)
        if pose.size not in (12, 16):
            raise ValueError(f"a pose of {pose.size} numbers, expected 12")
        R = to_world[:, :3].T
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return Camera(K, R, -R @ to_world[:, 3], width, height)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else " ".join(str(error).split())[:160]
        raise BadInput(
            f"{where}: expected 'pose' (12 numbers, camera to world) and 'intrinsics' [fx, fy, cx, cy]: {reason}"
        ) from error


def trajectory_json(cameras: Sequence[Camera], fps: float) -> str:
    """The file of a path. Cameras must be of one size, without lens distortion: else `ValueError`."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) != 1 or any(camera.distortion is not None for camera in cameras):
        raise ValueError(f"camera path: expected pinhole cameras of one size, got sizes {sorted(sizes)}")
    frames = []
    for camera in cameras:
        to_world = np.column_stack([camera.R.T, camera.center])
        intrinsics = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
        frames.append({"pose": to_world.reshape(-1).tolist(), "intrinsics": intrinsics, "appearance_weights": []})
    (size,) = sizes
    whole = {"format": FORMAT, "camera_model": "pinhole", "image_size": list(size), "fps": fps, "frames": frames}
    return json.dumps(whole, indent=1) + "\n"
