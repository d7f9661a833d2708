"""Avatars that a page can move by itself: Gaussians at rest with skinning weights, baked from any method whose avatar
gives its Gaussians in a pose, small enough to travel inside the page, and what the baking costs.

What depends on the pose or on the direction of view cannot be skinned. It is averaged over some training views (each
taken back to rest by the inverse of its own blend), and the price is measured against the method's own drawing.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
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


@dataclass(frozen=True)
class Sight:
    """A pose that an avatar is baked from, and where the camera stood that saw it."""

    pose: BodyPose
    center: Array | None = None  # [3] m, world; None: from nowhere, colours are those of no direction


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """N Gaussians at rest: opaque circles, or general ones with `turns` and `opacities`. What a page draws is exactly
    this: everything is rounded to what travels."""

    rest: Array  # [N, 3] m, in the body's shaped T-pose, where its weights apply
    bones: NDArray[np.uint8]  # [N, 4] joints
    weights: NDArray[np.uint8]  # [N, 4] in 255ths, that add up to 255
    scales: Array  # [N] m, or [N, 3] along axes of their own
    colours: NDArray[np.uint8]  # [N, 3]
    labels: NDArray[np.uint8]  # [N] of `scene.regions`, and PAINTED
    joints: Array  # [24, 3] m, of the shaped T-pose
    betas: Array  # [B]
    low: Array  # [3] m, and size: the box that positions are rounded in
    size: Array
    scale_range: tuple[float, float]  # m
    turns: Array | None = None  # [N, 3] x y z of unit quaternions whose w is not negative; None: circles
    opacities: NDArray[np.uint8] | None = None  # [N] in 255ths; None: opaque

    def __len__(self) -> int:
        return len(self.rest)

    @cached_property
    def whole_weights(self) -> Array:
        """[N, 24]"""
        return _spread(self.bones, self.weights)

    def blend(self, body: Body, body_pose: BodyPose) -> Array:
        """[N, 3, 4] rest to world."""
        own = BodyPose(body_pose.pose, self.betas, body_pose.transl)
        return np.tensordot(self.whole_weights, body.joint_transforms(own)[:, :3], 1)

    def means(self, body: Body, body_pose: BodyPose) -> Array:
        """[N, 3] m, world."""
        blend = self.blend(body, body_pose)
        return np.einsum("nab,nb->na", blend[:, :, :3], self.rest) + blend[:, :, 3]

    def render(
        self, body: Body, camera: Camera, body_pose: BodyPose, background: tuple[float, float, float]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] and alpha [H, W] by the bench's own renderer."""
        import torch

        from ihbench.render.splat import render_gaussians

        def tensor(values: Array) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, np.float32))

        means, colours = tensor(self.means(body, body_pose)), tensor(self.colours / LEVELS8)
        with torch.no_grad():
            if self.turns is None or self.opacities is None:
                rgb, alpha = render_gaussians(means, tensor(self.scales), colours, camera, background)
            else:
                factor = self.blend(body, body_pose)[:, :, :3] @ _axes(self.turns) * self.scales[:, None, :]
                covariances = tensor(factor @ factor.transpose(0, 2, 1))
                opacities = tensor(self.opacities / LEVELS8)
                rgb, alpha = render_gaussians(
                    means, covariances, colours, camera, background, opacities=opacities, preset="3dgs"
                )
        return rgb.clamp(0, 1).numpy(), alpha.numpy()

    def packed(self) -> tuple[bytes, bytes]:
        """What travels: places, sizes, colours and labels, of general ones also turns and opacities; and bones and
        weights, which avatars of one body share.

        Planes of numbers, one after the other, each as differences from the number before (wrapped around), 16-bit
        ones as a plane of low and a plane of high bytes; deflated.
        """
        places = np.rint((self.rest - self.low) / self.size * LEVELS16).astype(np.uint16)
        own = [_wide(places[:, k]) for k in range(3)]
        low, high = np.log(self.scale_range)
        sizes = np.rint((np.log(self.scales.reshape(len(self), -1)) - low) / (high - low) * LEVELS16)
        own += [_wide(plane.astype(np.uint16)) for plane in sizes.T]
        if self.turns is not None and self.opacities is not None:
            own += [_wide(np.rint((plane + 1) / 2 * LEVELS16).astype(np.uint16)) for plane in self.turns.T]
            own.append(_narrow(self.opacities))
        own += [*(_narrow(plane) for plane in self.colours.T), _narrow(self.labels)]
        skin = [_narrow(plane) for plane in (*self.bones.T, *self.weights.T)]
        return _deflated(b"".join(own)), _deflated(b"".join(skin))

    @property
    def about(self) -> dict[str, Any]:
        """What a page must know to unpack it."""
        return {
            "count": len(self), "low": self.low.tolist(), "size": self.size.tolist(),
            "scales": list(self.scale_range), "joints": np.round(self.joints, 7).tolist(),
            "general": self.turns is not None,
        }  # fmt: skip


@dataclass(frozen=True)
class _Drawn:
    """Gaussians in one pose, as numbers."""

    means: Array  # [N, 3]
    scales: Array  # [N], or covariances [N, 3, 3] m²
    colours: Array  # [N, 3]
    opacities: Array | None  # [N]


def bake(subject: Subject, sights: Sequence[Sight], seen: Visibility | None) -> BakedAvatar | str:
    """The avatar at rest, averaged over some poses; or why it cannot be had. `seen` is what the training views showed
    on the fine grid of texels; without it nothing is labelled."""
    avatar, body, betas = subject.avatar, subject.body, subject.betas
    draw = _drawer(avatar)
    if draw is None:
        return "its avatar has no Gaussians that could be skinned in a page"
    drawn = [_numbers(draw(sight.pose), sight.center) for sight in sights]
    first, count = drawn[0], len(drawn[0].means)
    if any(len(d.means) != count or d.scales.ndim != first.scales.ndim for d in drawn):
        return "its avatar has other Gaussians in every pose"
    bones, rounded = _four(_weights(avatar, body, betas, count, draw))
    whole = _spread(bones, rounded)
    rests, shapes = [], []
    for d, sight in zip(drawn, sights, strict=True):
        transforms = body.joint_transforms(BodyPose(sight.pose.pose, betas, sight.pose.transl))
        blend = np.tensordot(whole, transforms[:, :3], 1)
        back = np.linalg.inv(blend[:, :, :3])
        rests.append(np.einsum("nab,nb->na", back, d.means - blend[:, :, 3]))
        shapes.append(
            np.log(np.maximum(d.scales, 1e-6)) if d.scales.ndim == 1 else back @ d.scales @ back.swapaxes(1, 2)
        )
    rest, shape, colours = np.mean(rests, 0), np.mean(shapes, 0), np.mean([d.colours for d in drawn], 0)
    opacities = (
        None if first.opacities is None else np.mean([d.opacities for d in drawn if d.opacities is not None], 0)
    )
    flat = [
        rest,
        shape.reshape(count, -1),
        colours,
        np.zeros((count, 0)) if opacities is None else opacities[:, None],
    ]
    kept = np.isfinite(np.column_stack(flat)).all(1)
    if opacities is not None:
        kept &= np.rint(opacities * LEVELS8) >= 1  # the rest is not drawn
    if not kept.any():
        return "none of its Gaussians is finite and seen"
    rest, shape = rest[kept], shape[kept]
    scales, turns = (np.exp(shape), None) if shape.ndim == 1 else _axes_of(shape)
    low, size = rest.min(0), np.maximum(np.ptp(rest, 0), 1e-6)
    span = float(scales.min()), float(max(scales.max(), scales.min() * 1.0001))
    log_low, log_size = math.log(span[0]), math.log(span[1] / span[0])
    return BakedAvatar(
        low + np.rint((rest - low) / size * LEVELS16) / LEVELS16 * size,
        bones[kept],
        rounded[kept],
        np.exp(log_low + np.rint((np.log(scales) - log_low) / log_size * LEVELS16) / LEVELS16 * log_size),
        displayed(np.clip(colours[kept], 0, 1)[None])[0],
        _labels(subject, rest, seen),
        body.shaped(betas)[1],
        np.asarray(betas, np.float64),
        low,
        size,
        span,
        None if turns is None else np.rint((turns + 1) / 2 * LEVELS16) / LEVELS16 * 2 - 1,
        None if opacities is None else np.rint(opacities[kept] * LEVELS8).astype(np.uint8),
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


def _drawer(avatar: Any) -> Callable[[BodyPose], Any] | None:
    """What gives an avatar's Gaussians in a pose: `posed_gaussians` with all that `render_gaussians` takes, or
    `gaussians` with means, scales and colours of circles."""
    posed = getattr(avatar, "posed_gaussians", None)
    if callable(posed):
        return posed
    circles = getattr(avatar, "gaussians", None)
    return circles if callable(circles) and not hasattr(circles, "opacities") else None


def _numbers(gaussians: Any, center: Array | None) -> _Drawn:
    """Circles stay circles; others have covariances and opacities. Spherical harmonics become the colours that a
    camera at `center` sees, or those of no direction."""
    import torch

    from ihbench.render.spherical_harmonics import colors_of
    from ihbench.render.splat_projection import covariances_of

    with torch.no_grad():
        if isinstance(gaussians, tuple):
            means, scales, colours = gaussians[:3]
            quaternions, opacities, degree = None, None, None
        else:
            means, scales, colours = gaussians.means, gaussians.scales, gaussians.colors
            quaternions, opacities, degree = gaussians.quaternions, gaussians.opacities, gaussians.sh_degree
        if degree is not None:
            far = means.mean(0) + 1.0 if center is None else torch.from_numpy(np.asarray(center)).to(means.device)
            colours = colors_of(colours, means, far, 0 if center is None else degree)
        if (scales.ndim == 1 and opacities is not None) or scales.ndim == 2:
            scales = covariances_of(scales, quaternions)
        if scales.ndim == 3 and opacities is None:
            opacities = means.new_ones(len(means))

        def numbers(values: torch.Tensor) -> Array:
            return np.asarray(values.detach().cpu(), np.float64)

        return _Drawn(
            numbers(means), numbers(scales), numbers(colours), None if opacities is None else numbers(opacities)
        )


def _axes(turns: Array) -> Array:
    """[N, 3, 3] of quaternions [N, 3] without their w."""
    from scipy.spatial.transform import Rotation

    w = np.sqrt(np.maximum(1 - (turns**2).sum(1, keepdims=True), 0))
    return Rotation.from_quat(np.concatenate([turns, w], 1)).as_matrix()


def _axes_of(covariances: Array) -> tuple[Array, Array]:
    """[N, 3] standard deviations, at least a micrometre, and [N, 3] the quaternions of their axes without w."""
    from scipy.spatial.transform import Rotation

    values, axes = np.linalg.eigh((covariances + covariances.swapaxes(1, 2)) / 2)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    turns = Rotation.from_matrix(axes).as_quat(canonical=True)
    return np.sqrt(np.maximum(values, 1e-12)), turns[:, :3]


def _weights(avatar: Any, body: Body, betas: Array, count: int, draw: Callable[[BodyPose], Any]) -> Array:
    """[N, 24] the avatar's own, or those of the nearest point of the body, in a pose with its limbs apart."""
    own = getattr(avatar, "weights", None)
    if getattr(own, "shape", None) == (count, 24):
        return np.asarray(own.detach().cpu(), np.float64)  # pyright: ignore[reportOptionalMemberAccess]
    from scipy.spatial import KDTree

    texels = texel_table(body, FINE)
    apart = BodyPose(canonical_pose("a_pose"), betas, np.zeros(3))
    surface = texels.interpolate(body.pose(apart), body.faces)
    nearest = KDTree(surface).query(np.nan_to_num(_numbers(draw(apart), None).means))[1]
    return texels.interpolate(body.weights, body.faces)[nearest]


def _spread(bones: NDArray[np.uint8], weights: NDArray[np.uint8]) -> Array:
    """[N, 24] of four joints and their weights in 255ths."""
    whole = np.zeros((len(bones), 24))
    np.add.at(whole, (np.arange(len(bones))[:, None], bones), weights / LEVELS8)
    return whole


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
