"""What an occlusion rule is asked and what it answers. The rules themselves are registered content."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.protocol import OcclusionRule, Protocol
from ihbench.scene import Capture

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class OcclusionRequest:
    subject: str
    rule: OcclusionRule
    frames: Sequence[int]  # raw frame numbers of the training images
    covered: Sequence[bool]  # which of them the occluder covers
    width: int  # px, original image
    height: int
    silhouette: Callable[[int], Mask]  # raw frame number -> [H, W], original image
    body_mask: Callable[[int], Mask]  # raw frame number -> [H, W] the projected body, original image

    @property
    def covered_frames(self) -> list[int]:
        return [frame for frame, covered in zip(self.frames, self.covered, strict=True) if covered]


@dataclass(frozen=True)
class Occlusion:
    """A rule's answer: the pixels it hides in each covered frame, and what to write into the run record."""

    rule: str
    hidden: Callable[[int], Mask]  # raw frame number -> [H, W], original image; not to be written to
    record: dict[str, Any]
    hides_nothing: bool = False  # in any frame


@dataclass(frozen=True)
class OcclusionPlan:
    """A protocol's occlusion of one capture."""

    occlusion: Occlusion
    frames: tuple[int, ...]  # training frames
    covered: tuple[bool, ...]
    silhouette: Callable[[int], Mask]  # raw frame number -> [H, W] of the training camera, original image

    def hidden_share(self, frames: Sequence[int] | None = None) -> float:
        """Share of the pooled person pixels of the covered training frames that is hidden, original pixels; over some
        of the training frames where they are named."""
        chosen = self.frames if frames is None else frames
        person = hidden = 0
        for frame, covered in zip(self.frames, self.covered, strict=True):
            if covered and frame in chosen:
                silhouette = self.silhouette(frame)
                person += int(silhouette.sum())
                hidden += int((silhouette & self.occlusion.hidden(frame)).sum())
        return hidden / person if person else 0.0


def apply_rule(protocol: Protocol, capture: Capture) -> OcclusionPlan:
    """What a protocol hides of one capture. Raises `BadInput` where the rule does not fit the data."""
    frames = protocol.training_frames(capture.name, capture.n_frames)
    covered = protocol.covered(capture.name, frames, capture.n_frames)
    camera = capture.camera(protocol.train_camera)
    rule = protocol.occlusion.rule
    if rule == "fixed-strip" and capture.name not in protocol.occlusion.strips:
        rule = protocol.occlusion.unlisted

    def silhouette(frame: int) -> Mask:
        return capture.silhouette(protocol.train_camera, frame, protocol.silhouette)

    def body_mask(frame: int) -> Mask:
        from ihbench.render.zbuffer import rasterize

        points = camera.project(capture.model.pose(capture.body_pose(frame)))
        return rasterize(points, capture.model.faces, camera.height, camera.width).mask

    request = OcclusionRequest(
        subject=capture.name,
        rule=protocol.occlusion,
        frames=frames,
        covered=covered,
        width=camera.width,
        height=camera.height,
        silhouette=silhouette,
        body_mask=body_mask,
    )
    occlusion = registry.load("occlusion", rule)(request)
    return OcclusionPlan(occlusion, tuple(frames), tuple(covered), silhouette)
