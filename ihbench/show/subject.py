"""A finished run as somebody to look at: its avatar, the body that it moves with, poses for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.config_fields import WHOLE, whole
from ihbench.errors import BadInput
from ihbench.record.finished_run import FinishedRun
from ihbench.runner.run_loop import load_avatar
from ihbench.show.detail import training_pixel
from ihbench.show.motion import Motion, find_motion

if TYPE_CHECKING:
    from ihbench.body import Body

CAPTURE = "capture"  # the motion that the run was trained on


@dataclass(frozen=True)
class Subject:
    """Each part is made when first asked for, and raises `BadInput` where it cannot be had."""

    run: FinishedRun
    device: str = "cpu"
    snapshot: Path | None = None  # folder of another avatar of this run, saved while it was fitted

    @cached_property
    def avatar(self) -> Any:
        """A `scene.contracts.Avatar`."""
        return load_avatar(self.run, self.device, self.snapshot)

    @cached_property
    def body(self) -> Body:
        return getattr(self.avatar, "body", None) or self.run.body

    @cached_property
    def betas(self) -> NDArray[np.float64]:
        """[B] the avatar's own shape; of a method that keeps none, the capture's."""
        own = getattr(self.avatar, "betas", None)
        if own is not None:
            return np.asarray(own.detach().cpu() if hasattr(own, "detach") else own, np.float64).reshape(-1)
        return self.run.capture.body_pose(self.training_frames[0]).betas

    @cached_property
    def pixel(self) -> float | None:
        """m at the body of a pixel of the training images; None where the data are not at hand (`no_pixel`)."""
        body = self.body  # a run without an avatar has no body either, which is not for want of data
        try:
            return training_pixel(self.run, body)
        except BadInput:
            return None

    @property
    def no_pixel(self) -> str:
        """What to say where `pixel` is None."""
        return (
            f"{self.run.folder}: its data are not at hand, and with them the size of a training image's pixel; "
            "gaps between points may show: name --data"
        )

    @property
    def training_frames(self) -> list[int]:
        capture = self.run.capture
        return self.run.protocol.training_frames(capture.name, capture.n_frames)

    def pose(self, name: str, centred: bool = False) -> BodyPose:
        """A canonical pose in SMPL's axes, or the pose of a frame, by its number, where the data set has it;
        `centred` puts the pelvis of a canonical pose at the origin. Raises `BadInput` for neither."""
        if WHOLE.fullmatch(name):
            frame, capture = whole(name), self.run.capture
            if not 0 <= frame < capture.n_frames:
                raise BadInput(f"--pose {name}: {capture.name} has frames 0 to {capture.n_frames - 1}")
            return capture.body_pose(frame)
        place = -self.body.shaped(self.betas)[1][0] if centred else np.zeros(3)
        return BodyPose(canonical_pose(name), self.betas, place)

    def motion(self, name: str, fps: float) -> Motion:
        """A built-in motion, a file's, or "capture": the training frames as they come. Raises `BadInput`."""
        if name == CAPTURE:
            poses = [self.run.capture.body_pose(frame) for frame in self.training_frames]
            return Motion(np.stack([p.pose for p in poses]), np.stack([p.transl for p in poses]), fps)
        return find_motion(name, fps, self.body, self.betas)


def names_of(runs: Sequence[FinishedRun]) -> list[str]:
    """What to call each of several runs, as short as tells them apart."""
    parts = []
    for record in (run.record for run in runs):
        who = record.identity
        parts.append((record.about.label or who.method, who.scene, who.profile, f"seed {who.seed}", record.digest))
    shown = [part[:1] for part in parts]
    for k in range(1, len(parts[0])):
        if len(set(shown)) < len(parts) and len({part[k] for part in parts}) > 1:
            shown = [(*words, part[k]) for words, part in zip(shown, parts, strict=True)]
    return [", ".join(words) for words in shown]
