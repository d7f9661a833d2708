"""What captures of every format share: a name, whether they are a stand-in, the body their poses belong to."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ihbench.body import Body, load_body
from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.datasets.reading.standin_mark import standin_mark
from ihbench.errors import BadInput
from ihbench.files.pictures import read_rgb, size_of
from ihbench.files.spelling import missing_file
from ihbench.registry import nearest

PICTURES = (".png", ".jpg", ".jpeg")
Picture = TypeVar("Picture", bound=NDArray[Any])

BY_OPTIONS = "(--train-frames, --test-frames)"  # how a frame of a fixed recording is left out


class CaptureFolder(ABC):
    """One subject's folder. A format adds what `scene.contracts.Capture` asks for."""

    dataset: str
    variant: str
    n_frames: int
    camera_ids: tuple[str, ...]
    visible_masks: bool = False
    silhouettes: tuple[str, ...] = ("mask",)  # names of the sources
    image_hint = "expected the image of frame {}"  # for messages

    def __init__(self, folder: Path, name: str, body: Body | None = None, root: Path | None = None):
        """`root` holds the stand-in's mark, the folder's parent by default. Raises `BadInput` for a body of another
        kind than the capture's."""
        self.folder, self.name = folder, name
        self._mark = standin_mark(root or folder.parent)
        self.standin = f"stand-in v{self._mark['version']} seed {self._mark['seed']}" if self._mark else ""
        self.body = "procedural" if self.standin else "smpl"
        if body is not None and body.name != self.body:
            raise BadInput(
                f"{folder}: its parameters belong to the {self.body} body, but the {body.name} body was given; "
                f"{'give no body file' if self.standin else 'give an SMPL file (--body or IHBENCH_BODY)'}"
            )
        self._given_body = body

    @cached_property
    def model(self) -> Body:
        """The body model of the capture's poses. Raises `BadInput` when it is needed and was not given."""
        if self._given_body is None and not self._mark:
            raise BadInput(
                f"{self.folder}: its poses need the SMPL model, which ihbench may not ship; "
                f"give your SMPL file with --body FILE or IHBENCH_BODY"
            )
        body = self._given_body or load_body()
        if self._mark and self._mark["body_sha"] != body.content_sha():
            raise BadInput(
                f"{self.folder}: made with another version of the procedural body than this ihbench has; "
                f"make it anew in another folder"
            )
        return body

    @property
    def has_model(self) -> bool:
        """Whether `model` can be had: a stand-in's always, real data's when it was given."""
        return self._given_body is not None or bool(self._mark)

    def lacks(self, camera: int, frame: int, source: str = "mask") -> bool:
        """Whether an image or mask file of this view is missing."""
        if not (0 <= camera < len(self.camera_ids) and 0 <= frame < self.n_frames):
            return True
        try:
            return not all(path.is_file() for path in self.files_of(camera, frame, source))
        except BadInput:
            return True

    def files_of(self, camera: int, frame: int, source: str) -> tuple[Path, ...]:
        """The picture files of one view. Formats whose frames share files have none. Raises `BadInput`."""
        return ()

    def content_digest(self, camera: int, frame: int, source: str = "mask") -> bytes:
        """Hash of the bytes of one view's image and mask files; a missing or unreadable file counts as empty."""
        self.check_index(camera, frame)
        digest = hashlib.sha256()
        paths: tuple[Path, ...] = ()
        with suppress(BadInput):  # the copy does not list it
            paths = self.files_of(camera, frame, source)
        for path in paths:
            content = b""
            with suppress(OSError):
                content = path.read_bytes()
            digest.update(self.digest_prefix(len(content)) + content)
        return digest.digest()

    @staticmethod
    def digest_prefix(size: int) -> bytes:
        """What stands in a digest before a file of this size."""
        return b""

    @abstractmethod
    def camera(self, camera: int) -> Camera: ...

    @abstractmethod
    def body_pose(self, frame: int) -> BodyPose: ...

    def image(self, camera: int, frame: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB, as stored."""
        self.check_index(camera, frame)
        path = self.files_of(camera, frame, self.silhouettes[0])[0]
        return self.read_picture(path, camera, read_rgb, self.image_hint.format(frame))

    @abstractmethod
    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]: ...

    def image_size(self, camera: int) -> tuple[int, int]:
        """(width, height) px of a camera's pictures."""
        view = self.camera(camera)
        return view.width, view.height

    def size_of_first(self, paths: Iterable[Path], camera: int) -> tuple[int, int]:
        """(width, height) px of the first of a camera's images that is there. Raises `BadInput` where none is."""
        folder = Path()
        for path in paths:
            if path.is_file():
                return size_of(path)
            folder = path.parent
        state = "no image in it" if folder.is_dir() else "no such folder"
        raise BadInput(f"{folder}: {state}; expected the images of camera {camera}{self.standin_hint}")

    size_source = "the camera's images are"  # what says so, for messages

    def check_size(self, path: Path, picture: Picture, camera: int = 0) -> Picture:
        """The picture or mask [H, W, …] itself. Raises `BadInput` when it is not of the camera's size."""
        width, height = self.image_size(camera)
        if picture.shape[:2] != (height, width):
            raise BadInput(
                f"{path}: {picture.shape[1]}×{picture.shape[0]} px, but {self.size_source} {width}×{height} px; "
                f"expected one size for a camera's images and masks, make them anew"
            )
        return picture

    def read_picture(self, path: Path, camera: int, read: Callable[[Path], Picture], expected: str) -> Picture:
        """A picture file by its reader. Raises `BadInput` when it is missing, damaged or of another size."""
        if not path.is_file():
            missing = "file" if path.parent.is_dir() else f"file, nor its folder {path.parent.name}"
            raise missing_file(path, f"{expected}{self.standin_hint}", f"no such {missing}")
        return self.check_size(path, read(path), camera)

    def stored_pose(self, frame: int) -> BodyPose:
        """The numbers of a frame as the files hold them, whatever their root convention: needs no body model."""
        return self.body_pose(frame)

    def label(self, frame: int) -> str:
        """What the files call a frame."""
        return str(frame)

    def check_source(self, source: str) -> None:
        """Raise `BadInput` for a silhouette source that the capture does not have."""
        if source not in self.silhouettes:
            raise BadInput(f"silhouette source {source!r}: {nearest(source, list(self.silhouettes))}")

    def check_index(self, camera: int, frame: int) -> None:
        """Raise `BadInput` for a camera or frame that the capture does not have."""
        if not 0 <= camera < len(self.camera_ids):
            n = len(self.camera_ids)
            raise BadInput(f"{self.folder}: no camera {camera}; it has {n} cameras, 0 to {n - 1}")
        if not 0 <= frame < self.n_frames:
            raise BadInput(
                f"{self.folder}: no frame {frame}; it has {self.n_frames} frames, 0 to {self.n_frames - 1}"
            )

    @property
    def standin_hint(self) -> str:
        return "; a stand-in holds only the images it was asked for, ask for this one too" if self.standin else ""


def picture_files(folder: Path, endings: tuple[str, ...] = PICTURES) -> list[Path]:
    """Files with one of these endings, sorted by name; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in endings and path.name[0] != ".")
