"""What an occlusion rule is asked and what it answers. The rules themselves are registered content."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.errors import BadInput
from ihbench.scene.contracts import Capture
from ihbench.scene.protocol import OcclusionRule, Protocol

Mask = NDArray[np.bool_]

CLOTHES = 0.02  # share of the projected body's height by which garments may stand off it
UNKNOWABLE = (
    "the occluder stands in the test images, too: what it hides of the person is not known, whoever left that out "
    "would be ahead"
)
BODIES_HELD = 8  # projected bodies kept: a frame's is asked for by the rule and by whoever counts pixels


@dataclass(frozen=True)
class OcclusionRequest:
    subject: str
    rule: OcclusionRule
    frames: Sequence[int]  # raw frame numbers of the training images; of the test images where those are asked about
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
    record: Mapping[str, float]
    hides_nothing: bool = False  # in any frame


Rule = Callable[[OcclusionRequest], Occlusion]


def occluder(*, in_scene: bool = False, takes_fraction: bool = True) -> Callable[[Rule], Rule]:
    """What a rule says of itself, as a decorator. Without it a rule draws an occluder of the protocol's fraction.

    `in_scene`: the occluder stood before the camera and the masks show what it left. It cannot be lifted from some
    frames, so it covers all; it hides parts of the test images, too, which belong to no region. Such a rule is asked
    about test frames of any camera as well. `takes_fraction`: how much is hidden follows `occlusion.fraction`.
    """

    def marked(rule: Rule) -> Rule:
        vars(rule).update(in_scene=in_scene, takes_fraction=takes_fraction)
        return rule

    return marked


@dataclass(frozen=True)
class OcclusionPlan:
    """A protocol's occlusion of one capture."""

    occlusion: Occlusion
    frames: tuple[int, ...]  # training frames
    covered: tuple[bool, ...]
    silhouette: Callable[[int], Mask]  # raw frame number -> [H, W] of the training camera, original image
    in_scene: bool  # the occluder stands in the scene; see `occluder`
    in_test: Callable[[int], Occlusion]  # camera -> what the occluder hides of its test images; only where in_scene
    pixels: Callable[[int], tuple[int, int]]  # raw frame number -> person pixels, and how many of them are hidden

    def hidden_share(self, frames: Sequence[int] | None = None) -> float:
        """Share of the pooled person pixels of the covered training frames that is hidden, original pixels; over some
        of the training frames where they are named. Where the occluder stands in the scene nobody knows the person
        behind it: the projected body stands for what is hidden of them."""
        chosen = set(self.frames if frames is None else frames)
        counts = [
            self.pixels(frame)
            for frame, covered in zip(self.frames, self.covered, strict=True)
            if covered and frame in chosen
        ]
        person = sum(count for count, _ in counts)
        return sum(hidden for _, hidden in counts) / person if person else 0.0


def apply_rule(protocol: Protocol, capture: Capture) -> OcclusionPlan:
    """What a protocol hides of one capture. Raises `BadInput` where the rule does not fit the data."""
    frames = protocol.training_frames(capture.name, capture.n_frames)
    name = protocol.occlusion.of(capture.name)
    rule: Rule = registry.load("occlusion", name)
    in_scene = bool(getattr(rule, "in_scene", False))
    if getattr(capture, "visible_masks", False) and not in_scene:
        raise BadInput(
            f"{capture.dataset} {capture.name}: its masks show what furniture leaves of the person; occlusion rule "
            f"{name!r} would take the rest for background: use --occlusion.rule natural"
        )
    covered = [True] * len(frames) if in_scene else protocol.covered(capture.name, frames, capture.n_frames)

    def request(camera: int, frames: Sequence[int], covered: Sequence[bool]) -> OcclusionRequest:
        view = capture.camera(camera)

        @lru_cache(BODIES_HELD)
        def body_mask(frame: int) -> Mask:
            from ihbench.render.zbuffer import rasterize

            points = view.project(capture.model.pose(capture.body_pose(frame)))
            return rasterize(points, capture.model.faces, view.height, view.width).mask

        return OcclusionRequest(
            subject=capture.name,
            rule=protocol.occlusion,
            frames=frames,
            covered=covered,
            width=view.width,
            height=view.height,
            silhouette=lambda frame: capture.silhouette(camera, frame, protocol.subjects.silhouette),
            body_mask=body_mask,
        )

    @cache
    def in_test(camera: int) -> Occlusion:
        views = protocol.test_views(capture.name, capture.n_frames, len(capture.camera_ids))
        own = sorted({frame for k, frame, _ in views if k == camera})
        return rule(request(camera, own, [True] * len(own)))

    training = request(protocol.train.camera, frames, covered)
    occlusion = rule(training)

    @cache
    def pixels(frame: int) -> tuple[int, int]:
        silhouette = training.silhouette(frame)
        if in_scene:
            silhouette = silhouette | training.body_mask(frame)
        return int(silhouette.sum()), int((silhouette & occlusion.hidden(frame)).sum())

    silhouette = training.silhouette
    return OcclusionPlan(occlusion, tuple(frames), tuple(covered), silhouette, in_scene, in_test, pixels)


def withheld(regions: Iterable[str]) -> dict[str, str]:
    """Those of some regions that have no number where the occluder stands in the scene, with the reason: the ones
    that reach beyond the masks of what is seen."""
    return {region: UNKNOWABLE for region in regions if region == "full" or region.startswith("box")}


def grown_for_clothes(body: Mask) -> Mask:
    """[H, W] where the person of a projected body [H, W] may be: garments and hair stand off it."""
    from scipy.ndimage import binary_dilation

    rows = np.flatnonzero(body.any(1))
    if len(rows) == 0:
        return body
    margin = max(1, round(CLOTHES * (rows[-1] - rows[0] + 1)))
    return np.asarray(binary_dilation(body, iterations=margin), bool)
