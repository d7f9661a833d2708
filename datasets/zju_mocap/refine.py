"""ZJU-MoCap-refine, the repack with better cameras and poses that Instant-NVR, GauHuman and OccFusion read.

    my_377/annots.npy                  cameras and image paths, as in the original release
    my_377/images/00/000000.jpg        1024×1024, lens distortion in
    my_377/mask/00/000000.png          non-zero = person; there is no mask_cihp
    my_377/smpl_params/0.npy           poses, shapes, Rh, Th, in ZJU-MoCap's root convention
    my_377/smpl_vertices/0.npy         [V, 3] m, world

Source: tiangexiang/OccFusion scene/dataset_readers.py:666-763. Numbers on it are not those on the original release:
the record names the variant.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body
from ihbench.datasets.zju_mocap import original as zju_mocap
from ihbench.datasets.zju_mocap.original import ZjuCapture, ZjuMocap
from ihbench.errors import BadInput
from ihbench.files.pictures import write_picture

PREFIX = "my_"
PARAMS = "smpl_params"


class ZjuRefine(ZjuMocap):
    """A folder that holds `my_*` folders, or one of those folders itself."""

    layout = "refine"
    content = f"{PREFIX}* folders with annots.npy"

    @staticmethod
    def holds(folder: Path) -> bool:
        return folder.name.startswith(PREFIX) and (folder / "annots.npy").is_file()

    def name_of(self, folder: Path) -> str:
        return folder.name.removeprefix(PREFIX)

    def capture(self, subject: str, body: Body | None) -> ZjuCapture:
        return ZjuRefineCapture(self._folders[subject], body)


class ZjuRefineCapture(ZjuCapture):
    """One subject of the repack."""

    layout, prefix = "refine", PREFIX
    fits = (PARAMS,)
    mask_kinds = ("mask",)

    def image_path(self, camera: int, frame: int) -> Path:
        return self.folder / "images" / self._below_images(camera, frame)

    def mask_path(self, camera: int, frame: int, kind: str = "mask") -> Path:
        if kind != "mask":
            raise BadInput(
                f"{self.folder}: the refine repack has no {kind} masks; use a protocol whose silhouette is mask"
            )
        return self.folder / kind / self._below_images(camera, frame).with_suffix(".png")

    def _below_images(self, camera: int, frame: int) -> PurePosixPath:
        self.check_index(camera, frame)
        path = PurePosixPath(self._annots.image_paths[frame][camera])
        return path.relative_to("images") if path.parts[:1] == ("images",) else path


def write_frame(folder: Path, image_path: str, image: NDArray[np.uint8], mask: NDArray) -> None:
    """The picture files of one camera at one frame; `image_path` as annots.npy lists it, with images/ in front."""
    zju_mocap.write_frame(folder, image_path, image)
    path = folder / "mask" / PurePosixPath(image_path).relative_to("images").with_suffix(".png")
    write_picture(path, (mask != 0) * np.uint8(255))
