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


@dataclass(frozen=True)
class OcclusionRequest:
    subject: str
    rule: OcclusionRule
    frames: Sequence[int]  # raw frame numbers of the training images
    covered: Sequence[bool]  # which of them the occluder covers
    width: int  # px, original image
    height: int
    silhouette: Callable[[int], NDArray[np.bool_]]  # raw frame number -> [H, W], original image


@dataclass(frozen=True)
class Occlusion:
    """A rule's answer: the image columns it hides in every covered frame, and what to write into the run record."""

    rule: str
    columns: NDArray[np.bool_]  # [W] original image
    record: dict[str, Any]

    def hidden(self, height: int) -> NDArray[np.bool_]:
        """[H, W] pixels hidden in a covered frame."""
        return np.broadcast_to(self.columns, (height, len(self.columns)))


def apply_rule(protocol: Protocol, capture: Capture) -> tuple[Occlusion, list[int], list[bool]]:
    """(occlusion, training frames, covered flags) of one capture under a protocol."""
    frames = protocol.training_frames(capture.name, capture.n_frames)
    covered = protocol.covered(capture.name, frames, capture.n_frames)
    camera = capture.camera(protocol.train_camera)
    rule = protocol.occlusion.rule
    if rule == "fixed-strip" and capture.name not in protocol.occlusion.strips:
        rule = protocol.occlusion.unlisted
    request = OcclusionRequest(
        subject=capture.name,
        rule=protocol.occlusion,
        frames=frames,
        covered=covered,
        width=camera.width,
        height=camera.height,
        silhouette=lambda frame: capture.silhouette(protocol.train_camera, frame, protocol.silhouette),
    )
    return registry.load("occlusion", rule)(request), frames, covered
