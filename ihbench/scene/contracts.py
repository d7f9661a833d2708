"""The common currency: what a loader yields, what a method is given, what it gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.scene.mask_state import MaskState as MaskState

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.clock.ledger import Ledger
    from ihbench.clock.progress import Progress
    from ihbench.scene.copy_report import CopyReport
    from ihbench.scene.sightings import Sightings


@dataclass(frozen=True)
class TrainView:
    """One training image as a method may see it: undistorted, hidden pixels painted with the background colour."""

    image: NDArray[np.uint8]  # [H, W, 3] RGB
    mask: NDArray[np.uint8]  # [H, W] MaskState
    camera: Camera
    body_pose: BodyPose
    frame: int  # frame number in the capture
    camera_id: str
    filmed: NDArray[np.uint8] | None = None  # [H, W, 3] RGB as photographed, occluder and room included; only where
    # the occluder stands in the scene: elsewhere it would show what a drawn occluder hides


@dataclass(frozen=True)
class TestView:
    """One test image with its truth. Methods never see it; camera, body pose and the number of a frame that was
    trained on reach `Avatar.render`, nothing else."""

    __test__ = False  # pytest: not a test class

    image: NDArray[np.float32]  # [H, W, 3] RGB in [0, 1], un-occluded, on the protocol's background
    silhouette: NDArray[np.bool_]  # [H, W] the true silhouette, complete but for `hidden`
    camera: Camera
    body_pose: BodyPose
    frame: int
    camera_id: str
    hidden: NDArray[np.bool_] | None = None  # [H, W] nobody knows what is there: in no region; None for nowhere


@dataclass(frozen=True)
class TrainingSet:
    """Everything `Method.fit` gets. `views` loads lazily; index it as often as you like."""

    views: Sequence[TrainView]
    body: Body
    background: tuple[float, float, float]  # RGB in [0, 1]
    name: str  # the scene's name, for messages only

    @cached_property
    def sightings(self) -> dict[int, Sightings]:
        """What the views show of the body's surface, on a UV grid of each side in `scene.sightings`."""
        from ihbench.scene.sightings import look_through

        return look_through(self.views, self.body)


class Capture(Protocol):
    """One subject of a data set, opened lazily: headers at once, pixels when asked.

    Images and silhouettes are as stored: original size, lens distortion in. Frames and cameras are the data set's
    own indices, from 0. `BadInput` names the file when something is missing, truncated or mis-shaped.
    """

    name: str  # the subject, e.g. "377"
    dataset: str  # registered name of the format, e.g. "zju_mocap"
    variant: str  # which of the layouts this copy is, e.g. "original/new_params"
    standin: str  # "" for real data, else what made it, e.g. "stand-in v1 seed 0"
    body: str  # "smpl", or "procedural" for the bench's own body
    n_frames: int
    camera_ids: tuple[str, ...]
    visible_masks: bool  # silhouettes are of visible pixels: what stands before the person is not in them

    @property
    def model(self) -> Body:
        """The body model that the poses belong to. Raises `BadInput` when it is needed and was not given."""
        ...

    def camera(self, camera: int) -> Camera: ...

    def body_pose(self, frame: int) -> BodyPose: ...

    def image(self, camera: int, frame: int) -> NDArray[np.uint8]:
        """[H, W, 3] RGB."""
        ...

    def content_digest(self, camera: int, frame: int, source: str = "mask") -> bytes:
        """Hash of one view's stored image and masks, undecoded: other files are other data. Never raises for a file
        that is missing; reading it will."""
        ...

    def lacks(self, camera: int, frame: int, source: str = "mask") -> bool:
        """Whether an image or mask file of this view is missing. Decodes nothing, never raises."""
        ...

    def silhouette(self, camera: int, frame: int, source: str = "mask") -> NDArray[np.bool_]:
        """[H, W]. `source` is a data-set specific choice of mask files; a protocol names it."""
        ...


class Dataset(Protocol):
    """A folder of captures in one on-disk format. The constructor checks the layout and raises `BadInput`."""

    root: Path

    def __init__(self, root: Path): ...

    @staticmethod
    def check(root: Path, body: Body | None = None) -> CopyReport:
        """What a folder holds and lacks; with a body model also whether its poses fit the masks. Raises `BadInput`
        for another layout."""
        ...

    def subjects(self) -> list[str]: ...

    def open(self, subject: str, body: Body | None = None) -> Capture:
        """One subject. `body` is the model its poses belong to; poses of real data cannot be read without it."""
        ...


class Avatar(Protocol):
    """A fitted person that can be drawn in any pose from any camera.

    More is asked of none, but `ihbench export` and `render` use what there is: `betas` [B] and `body`, its shape and
    the body that it moves with; `posed_gaussians(body_pose)`, a `fit.gaussians.posed.PosedGaussians`; and, where
    Gaussian k lies at texel k of the body's UV map, that map's table `texels` (`body.uv.Texels`).
    """

    def render(
        self,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float] = (1.0, 1.0, 1.0),  # RGB in [0, 1]
        frame: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] in [0, 1] composited on `background`, and alpha [H, W] in [0, 1].

        `frame` is the number of the training frame whose pose this is (`TrainView.frame`), for methods that learn
        something for each frame; None for every other pose.
        """
        ...

    def save(self, folder: Path) -> None: ...


class Method(Protocol):
    """A system under test, registered by a `scene.method_spec.MethodSpec`. `config` is a frozen dataclass; its fields
    become `--method.*` switches.

    A method sees no folder. `ledger` is all it has of the run: `ledger.stage(name)` times, `ledger.offer(step,
    avatar)` draws quality against time, `ledger.save_state` and `ledger.load_state` let a killed run go on,
    `ledger.event` notes what happened (`clock.events`), `ledger.artifact` leaves a picture. `fit` raises
    `Diverged(step, reason)` where the loss stops being finite.
    """

    config: Any

    def __init__(self, config: Any): ...

    def fit(self, training: TrainingSet, *, device: str, seed: int, ledger: Ledger, progress: Progress) -> Avatar: ...

    def load(self, folder: Path, body: Body, device: str = "cpu") -> Avatar: ...
