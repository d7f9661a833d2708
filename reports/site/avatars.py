"""Avatars that a page can move by itself: Gaussians at rest with skinning weights, baked from any method whose avatar
has circles to draw, small enough to travel inside the page, and what the baking costs.

A pose-dependent part cannot be skinned. It is averaged over poses of the training views (each taken back to rest by
the inverse of its own blend), and the price is measured against the method's own drawing.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.body.skinning_numpy import lbs
from ihbench.body.uv import texel_table
from ihbench.camera import Camera
from ihbench.metrics.eight_bit import displayed
from ihbench.metrics.psnr import psnr
from ihbench.reports.site.painted import painted_counts
from ihbench.scene.regions import SurfaceMap
from ihbench.scene.sightings import FINE

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.scene.visibility import Visibility
    from ihbench.show.subject import Subject

Array = NDArray[np.float64]

BONES = 4  # weights of a Gaussian that are kept
LEVELS16, LEVELS8 = 65535, 255
PAINTED = 4  # bit of a label; the lower two are those of `scene.regions`
SOLID = 0.5  # alpha from which a pixel is the person
BAKING_POSES = 6


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """N circles at rest. What a page draws is exactly this: everything is rounded to what travels."""

    rest: Array  # [N, 3] m, in the body's shaped T-pose, where its weights apply
    bones: NDArray[np.uint8]  # [N, 4] joints
    weights: NDArray[np.uint8]  # [N, 4] in 255ths, that add up to 255
    scales: Array  # [N] m
    colours: NDArray[np.uint8]  # [N, 3]
    labels: NDArray[np.uint8]  # [N] of `scene.regions`, and PAINTED
    joints: Array  # [24, 3] m, of the shaped T-pose
    betas: Array  # [B]
    low: Array  # [3] m, and size: the box that positions are rounded in
    size: Array
    scale_range: tuple[float, float]  # m

    def __len__(self) -> int:
        return len(self.rest)

    @cached_property
    def whole_weights(self) -> Array:
        """[N, 24]"""
        whole = np.zeros((len(self), 24))
        np.add.at(whole, (np.arange(len(self))[:, None], self.bones), self.weights / LEVELS8)
        return whole

    def means(self, body: Body, body_pose: BodyPose) -> Array:
        """[N, 3] m, world."""
        return lbs(self.rest, self.whole_weights, body.joint_transforms(self._own(body_pose)))

    def _own(self, body_pose: BodyPose) -> BodyPose:
        return BodyPose(body_pose.pose, self.betas, body_pose.transl)

    def render(
        self, body: Body, camera: Camera, body_pose: BodyPose, background: tuple[float, float, float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] and alpha [H, W] by the bench's own renderer."""
        import torch

        from ihbench.render.splat import render_gaussians

        means = torch.from_numpy(self.means(body, body_pose).astype(np.float32))
        scales = torch.from_numpy(self.scales.astype(np.float32))
        colours = torch.from_numpy((self.colours / LEVELS8).astype(np.float32))
        with torch.no_grad():
            rgb, alpha = render_gaussians(means, scales, colours, camera, background)
        return rgb.clamp(0, 1).numpy(), alpha.numpy()

    def packed(self) -> tuple[bytes, bytes]:
        """What travels: places, sizes, colours and labels; and bones and weights, which avatars of one body share.

        Planes of numbers, one after the other, each as differences from the number before (wrapped around), 16-bit
        ones as a plane of low and a plane of high bytes; deflated.
        """
        places = np.rint((self.rest - self.low) / self.size * LEVELS16).astype(np.uint16)
        low, high = np.log(self.scale_range)
        sizes = np.rint((np.log(self.scales) - low) / max(high - low, 1e-12) * LEVELS16).astype(np.uint16)
        own = [*(_wide(places[:, k]) for k in range(3)), _wide(sizes), *(_narrow(c) for c in self.colours.T)]
        own.append(_narrow(self.labels))
        skin = [_narrow(plane) for plane in (*self.bones.T, *self.weights.T)]
        return _deflated(b"".join(own)), _deflated(b"".join(skin))

    @property
    def about(self) -> dict[str, Any]:
        """What a page must know to unpack it."""
        return {
            "count": len(self), "low": self.low.tolist(), "size": self.size.tolist(),
            "scales": list(self.scale_range), "joints": np.round(self.joints, 7).tolist(),
        }  # fmt: skip


def bake(subject: Subject, poses: Sequence[BodyPose], seen: Visibility | None) -> BakedAvatar | str:
    """The avatar at rest, averaged over some poses; or why it cannot be had. `seen` is what the training views showed
    on the fine grid of texels; without it nothing is labelled."""
    avatar, body, betas = subject.avatar, subject.body, subject.betas
    draw = getattr(avatar, "gaussians", None)
    if not callable(draw) or hasattr(draw, "opacities"):
        return "its avatar has no opaque circles that could be skinned in a page"
    drawn = [_numbers(draw(pose)) for pose in poses]
    count = len(drawn[0][0])
    if any(len(means) != count or scales.ndim != 1 for means, scales, _ in drawn):
        return "its avatar has other Gaussians in every pose"
    weights = _weights(avatar, body, betas, drawn[0][0], poses[0])
    bones, rounded = _four(weights)
    whole = np.zeros((count, 24))
    np.add.at(whole, (np.arange(count)[:, None], bones), rounded / LEVELS8)
    rests = []
    for (means, _, _), pose in zip(drawn, poses, strict=True):
        transforms = body.joint_transforms(BodyPose(pose.pose, betas, pose.transl))
        blend = np.tensordot(whole, transforms[:, :3], 1)
        rests.append(np.linalg.solve(blend[:, :, :3], (means - blend[:, :, 3])[:, :, None])[:, :, 0])
    rest = np.mean(rests, 0)
    scales = np.exp(np.mean([np.log(np.maximum(s, 1e-6)) for _, s, _ in drawn], 0))
    colours = np.mean([c for *_, c in drawn], 0)
    labels = _labels(subject, rest, seen)
    kept = np.isfinite(np.column_stack([rest, scales, colours])).all(1)
    rest, scales, colours = rest[kept], scales[kept], colours[kept]
    if not len(rest):
        return "none of its Gaussians is finite"
    low, size = rest.min(0), np.maximum(np.ptp(rest, 0), 1e-6)
    span = float(scales.min()), float(max(scales.max(), scales.min() * 1.0001))
    log_low, log_size = math.log(span[0]), math.log(span[1] / span[0])
    return BakedAvatar(
        low + np.rint((rest - low) / size * LEVELS16) / LEVELS16 * size,
        bones[kept],
        rounded[kept],
        np.exp(log_low + np.rint((np.log(scales) - log_low) / log_size * LEVELS16) / LEVELS16 * log_size),
        displayed(np.clip(colours, 0, 1)[None])[0],
        labels[kept],
        body.shaped(betas)[1],
        np.asarray(betas, np.float64),
        low,
        size,
        span,
    )


@dataclass(frozen=True)
class Price:
    """What baking costs in one view: the baked avatar against the method's own drawing, both by the bench."""

    psnr: float  # dB in the person
    iou: float  # of the silhouettes


def price(
    baked: BakedAvatar, subject: Subject, camera: Camera, pose: BodyPose, background: tuple[float, float, float]
) -> Price:
    """Measured where either shows the person."""
    rgb, alpha = subject.avatar.render(camera, pose, background)
    drawn, drawn_alpha = baked.render(subject.body, camera, pose, background)
    ours, theirs = np.asarray(drawn_alpha) > SOLID, np.asarray(alpha) > SOLID
    either = ours | theirs
    if not either.any():
        return Price(math.nan, math.nan)
    decibels = float(psnr(displayed(drawn), displayed(np.asarray(rgb)), either))
    return Price(decibels, float((ours & theirs).sum() / either.sum()))


def _numbers(gaussians: Any) -> tuple[Array, Array, Array]:
    means, scales, colours = (np.asarray(v.detach().cpu(), np.float64) for v in gaussians[:3])
    return means, scales, colours


def _weights(avatar: Any, body: Body, betas: Array, means: Array, pose: BodyPose) -> Array:
    """[N, 24] the avatar's own, or those of the nearest point of the posed body."""
    own = getattr(avatar, "weights", None)
    if getattr(own, "shape", None) == (len(means), 24):
        return np.asarray(own.detach().cpu(), np.float64)  # pyright: ignore[reportOptionalMemberAccess]
    from scipy.spatial import KDTree

    texels = texel_table(body, FINE)
    surface = texels.interpolate(body.pose(BodyPose(pose.pose, betas, pose.transl)), body.faces)
    nearest = KDTree(surface).query(np.nan_to_num(means))[1]
    return texels.interpolate(body.weights, body.faces)[nearest]


def _four(weights: Array) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """[N, 4] joints and weights in 255ths: the largest four, which add up to 255; the largest takes the rounding."""
    bones = np.argsort(-weights, 1, kind="stable")[:, :BONES]
    kept = np.take_along_axis(weights, bones, 1)
    rounded = np.rint(kept / np.maximum(kept.sum(1, keepdims=True), 1e-12) * LEVELS8).astype(int)
    rounded[:, 0] += LEVELS8 - rounded.sum(1)
    return np.where(rounded > 0, bones, 0).astype(np.uint8), rounded.astype(np.uint8)


def _labels(subject: Subject, rest: Array, seen: Visibility | None) -> NDArray[np.uint8]:
    """[N] those of the nearest texel of the fine grid; PAINTED where what taught that texel was painted at least as
    often as it was seen."""
    if seen is None:
        return np.zeros(len(rest), np.uint8)
    from scipy.spatial import KDTree

    body = subject.run.body
    texels = texel_table(body, FINE)
    of_texels = SurfaceMap.build(body, texels, seen).labels.ravel()[texels.index].copy()
    painted = painted_counts(subject.run.folder, body, texels)
    if painted is not None:
        of_texels[(painted > 0) & (painted >= seen.seen)] |= PAINTED
    surface = texels.interpolate(body.shaped(subject.betas)[0], body.faces)
    return of_texels[KDTree(surface).query(np.nan_to_num(rest))[1]]


def _narrow(plane: NDArray[np.uint8]) -> bytes:
    return np.diff(plane, prepend=np.uint8(0)).astype(np.uint8).tobytes()


def _wide(plane: NDArray[np.uint16]) -> bytes:
    steps = np.diff(plane, prepend=np.uint16(0)).astype(np.uint16)
    return (steps & 255).astype(np.uint8).tobytes() + (steps >> 8).astype(np.uint8).tobytes()


def _deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()
