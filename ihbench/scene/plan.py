"""What a scene needs, measured from masks, cameras and body poses alone, before anything is fitted.

Nothing here imports torch or cv2: `ihbench plan` answers fast.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.camera import Camera
from ihbench.render.triangles import triangle_areas
from ihbench.scene.contracts import Capture, MaskState
from ihbench.scene.occlusion import OcclusionPlan, withheld
from ihbench.scene.protocol import Protocol
from ihbench.scene.spread import spread
from ihbench.scene.views import OccludedScene
from ihbench.scene.visibility import texel_visibility

POINTS_A_PIXEL = 2.0  # along a side; more Gaussians than that draw the same picture
LEAST_TEXELS = 64
MEASURE_SIZE = 256  # px; visibility is measured on images reduced to about this
MEASURE_VIEWS = 50  # at most this many training views, evenly spaced
TEXELS = 128  # side of the UV grid on which visibility is measured


@dataclass(frozen=True)
class Omission:
    """Something left out of a run. `field` is a config field of the method, or a region of the protocol.

    `spares` says which share of a stage's seconds this is thought to save: ledger path -> 0 to 1.
    """

    field: str
    value: Any
    reason: str
    spares: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def seconds(self, stages: Mapping[str, float]) -> float | None:
        """What this saves in those of its stages whose seconds are known; None when none is."""
        known = [share * stages[path] for path, share in self.spares.items() if path in stages]
        return sum(known) if known else None


@dataclass(frozen=True)
class SceneMeasure:
    """What was measured of a scene under a protocol."""

    training_views: int
    covered_views: int
    test_views: int
    hidden_share: float  # of the pooled person pixels in covered frames; see `OcclusionPlan.hidden_share`
    visible_texels: float  # shares of the body's texels
    hidden_texels: float
    never_seen_texels: float
    motion_deg: float  # largest range of any joint's rotation over the training frames, root apart
    turn_deg: float  # range of the root's heading over the training frames
    pixel_mm: float  # body millimetres per pixel of the protocol's image, median over views
    surface_mm: float  # side of a square of the body's area, mm: texel_mm(R) follows from it
    occlusion: Mapping[str, str | float]
    in_scene: bool = False  # the occluder stands in the scene: test images are occluded, too

    def texel_mm(self, resolution: int) -> float:
        """Mean side of one texel of a UV map of this resolution on the body, mm."""
        return self.surface_mm / resolution


@dataclass(frozen=True)
class _MaskView:
    mask: NDArray[np.uint8]
    camera: Camera
    body_pose: BodyPose


def measure_scene(scene: OccludedScene) -> SceneMeasure:
    """Measure one capture under a protocol. Reads masks of at most `MEASURE_VIEWS` training views, no images."""
    from ihbench.body.uv import texel_table

    capture, protocol, hiding, body = scene.capture, scene.protocol, scene.hiding, scene.capture.model
    frames = hiding.frames
    chosen = spread(len(frames), MEASURE_VIEWS)
    views = [_mask_view(capture, protocol, hiding, k) for k in chosen]
    texels = texel_table(body, TEXELS)
    seen = texel_visibility(views, body, texels)
    poses = np.stack([capture.body_pose(frame).pose for frame in frames])
    camera = views[0].camera
    depth = float(np.median([camera.to_camera(body.posed_joints(view.body_pose))[:, 2].mean() for view in views]))
    focal = float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))
    focal *= protocol.image.size / max(camera.width, camera.height)
    area = triangle_areas(body.pose(views[0].body_pose)[body.faces]).sum()
    filled = len(texels.face) / TEXELS**2
    return SceneMeasure(
        training_views=len(frames),
        covered_views=0 if hiding.occlusion.hides_nothing else sum(hiding.covered),
        test_views=len(protocol.test_views(capture.name, capture.n_frames, len(capture.camera_ids))),
        hidden_share=hiding.hidden_share([frames[k] for k in chosen]),
        visible_texels=float(seen.visible.mean()),
        hidden_texels=float(seen.hidden.mean()),
        never_seen_texels=float(seen.never_seen.mean()),
        motion_deg=_motion(poses[:, 1:]),
        turn_deg=_turn(poses[:, 0]),
        pixel_mm=1000 * depth / focal,
        surface_mm=1000 * float(np.sqrt(area / filled)),
        occlusion={"rule": hiding.occlusion.rule, **hiding.occlusion.record},
        in_scene=hiding.in_scene,
    )


def useful_texels(scene: SceneMeasure, texels: int) -> int:
    """The side of the coarsest UV grid, halved from `texels`, whose Gaussians stand close enough for the pixels."""
    while texels > LEAST_TEXELS and scene.texel_mm(texels // 2) * POINTS_A_PIXEL <= scene.pixel_mm:
        texels //= 2
    return texels


def absent_regions(measure: SceneMeasure, regions: tuple[str, ...]) -> list[Omission]:
    """Regions of the protocol that hold nothing in this scene, or whose truth is not known."""
    shares = {"hidden": measure.hidden_texels, "never_seen": measure.never_seen_texels}
    reasons = {
        "hidden": "every texel that faced the training camera was also seen un-occluded",
        "never_seen": "every texel faced the training camera at least once",
    }
    unknowable = withheld(regions) if measure.in_scene else {}
    return [
        *(Omission(region, None, reason) for region, reason in unknowable.items()),
        *(Omission(r, None, reasons[r]) for r in regions if r in shares and shares[r] == 0),
    ]


def _mask_view(capture: Capture, protocol: Protocol, hiding: OcclusionPlan, k: int) -> _MaskView:
    frame = hiding.frames[k]
    state = np.where(hiding.silhouette(frame), MaskState.PERSON, MaskState.BACKGROUND).astype(np.uint8)
    if hiding.covered[k]:
        state[hiding.occlusion.hidden(frame)] = MaskState.UNKNOWN
    camera = capture.camera(protocol.train.camera)
    step = max(1, camera.width // MEASURE_SIZE)
    state = np.ascontiguousarray(state[step // 2 :: step, step // 2 :: step])
    return _MaskView(state, camera.scaled(state.shape[1], state.shape[0]), capture.body_pose(frame))


def _motion(rotations: NDArray[np.float64]) -> float:  # [F, J, 3] rad
    """Degrees of the largest rotation of any joint between any two frames, however its axis-angles are written."""
    half = np.linalg.norm(rotations, axis=-1, keepdims=True) / 2
    quaternions = np.concatenate([np.cos(half), np.sinc(half / np.pi) * rotations / 2], -1)
    cosine = min(np.abs(q @ q.T).min() for q in quaternions.transpose(1, 0, 2))
    return float(np.rad2deg(2 * np.arccos(min(cosine, 1.0))))


def _turn(roots: NDArray[np.float64]) -> float:  # [F, 3] rad
    """Degrees between the extreme headings of the body's front about its mean upright, unwrapped over the frames."""
    axes = axis_angle_to_matrix(roots)
    _, _, basis = np.linalg.svd(axes[:, :, 1].mean(0)[None])  # the upright, then two axes across it
    across = axes[:, :, 2] @ basis[1:].T
    return float(np.rad2deg(np.ptp(np.unwrap(np.arctan2(across[:, 1], across[:, 0])))))
