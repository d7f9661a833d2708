"""EasyMocap's files: `intri.yml` and `extri.yml` as cameras, the fits of `output/smpl` as poses.

The YAML files are OpenCV's: names in a list, then `K_<name>` [3, 3] px, `dist_<name>` (`D_<name>` in some) as a row
or a column, `R_<name>` a rotation vector and `Rot_<name>` the same as a matrix, rounded, `T_<name>` a column. A fit
is a list of persons a frame, in newer versions under "annots".
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose_estimators import from_easymocap
from ihbench.camera import Camera
from ihbench.errors import BadInput
from ihbench.files import atomic

if TYPE_CHECKING:
    from ihbench.body.model import Body
    from ihbench.body.pose import BodyPose

FIT = ("poses", "shapes", "Rh", "Th")


def easymocap_cameras(
    intri: str | Path, extri: str | Path, width: int | None = None, height: int | None = None
) -> dict[str, Camera]:
    """The cameras by name, in the file's order. Raises `BadInput`.

    `width` and `height` in px are those of the images, for files that do not name them (`W_<name>`, `H_<name>`).
    """
    inner, outer = _Storage(Path(intri)), _Storage(Path(extri))
    names = inner.names() or outer.names()
    if not names:
        raise BadInput(f"{intri}: expected a list of camera names under 'names', as EasyMocap writes it")
    cameras = {}
    for name in names:
        K, R, t = inner.matrix(f"K_{name}"), outer.matrix(f"R_{name}", f"Rot_{name}"), outer.matrix(f"T_{name}")
        lens = inner.matrix(f"dist_{name}", f"D_{name}", needed=False)
        w, h = width or inner.whole(f"W_{name}"), height or inner.whole(f"H_{name}")
        if not w or not h:
            raise BadInput(
                f"{intri}: camera {name!r} has no W_{name} and H_{name}; give the images' width and height"
            )
        try:
            cameras[name] = Camera.from_opencv(K, R, t, w, h, lens)
        except BadInput as error:
            raise BadInput(f"{intri}: camera {name!r}: {error}") from error
    return cameras


def easymocap_poses(folder: str | Path, body: Body, person: int = 0) -> dict[int, BodyPose]:
    """Frame number -> the pose of one person, from a folder of fits named by their frames; frames without this
    person are left out. Raises `BadInput`, also where no frame has them."""
    files = sorted(path for path in Path(folder).glob("*.json") if path.stem.isascii() and path.stem.isdigit())
    poses = {}
    for path in files:
        for record in _people(atomic.read_json(path), path):
            if record.get("id", 0) == person:
                try:
                    poses[int(path.stem)] = from_easymocap(*(record[key] for key in FIT), body=body)
                except BadInput as error:
                    raise BadInput(f"{path}: {error}") from error
    if not poses:
        raise BadInput(f"{folder}: expected fits like 000000.json with person {person} in them, found none")
    return poses


def _people(content: Any, path: Path) -> list[Mapping[str, Any]]:
    people = content.get("annots", [content]) if isinstance(content, dict) else content
    for record in people if isinstance(people, list) else [None]:
        if not isinstance(record, dict) or not all(key in record for key in FIT):
            raise BadInput(f"{path}: expected a list of persons with {', '.join(FIT)} (EasyMocap's output/smpl)")
    return people


class _Storage:
    """An OpenCV YAML file. Raises `BadInput` for one that is missing or damaged."""

    def __init__(self, path: Path):
        import cv2

        self.path = path.expanduser()
        if not self.path.is_file():
            raise BadInput(f"{path}: no such file; expected EasyMocap's intri.yml or extri.yml")
        try:
            text = self.path.read_text(encoding="utf-8-sig")
            self.storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
            if not self.storage.isOpened():
                raise OSError
        except (cv2.error, SystemError, OSError, UnicodeDecodeError):
            raise BadInput(f"{path}: not a YAML file as OpenCV writes it; copy it again") from None

    def names(self) -> list[str]:
        node = self.storage.getNode("names")
        if node.empty() or not node.isSeq():
            return []
        entries = [node.at(k) for k in range(node.size())]
        # a name of digits without quotes is a number to YAML
        return [entry.string() if entry.isString() else str(int(entry.real())) for entry in entries]

    def matrix(self, *keys: str, needed: bool = True) -> NDArray[np.float64] | None:
        """The first of these matrices that is there. Raises `BadInput` where one is needed and none is there."""
        for key in keys:
            node = self.storage.getNode(key)
            values = None if node.empty() or not node.isMap() else node.mat()
            if values is not None and values.size:
                return values.astype(np.float64)
        if needed:
            raise BadInput(f"{self.path}: expected a matrix {' or '.join(keys)}; calibrate this camera as well")
        return None

    def whole(self, key: str) -> int | None:
        node = self.storage.getNode(key)
        return None if node.empty() or not (node.isInt() or node.isReal()) or node.real() < 1 else int(node.real())
