"""Avatars that a page can move by itself: Gaussians at rest with skinning weights, small enough to travel inside the
page, drawn here as the page draws them; and what it costs to draw these instead of the method's own.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.pose import BodyPose
from ihbench.camera import Camera
from ihbench.files.splat_ply import SH_C0
from ihbench.metrics.eight_bit import displayed
from ihbench.metrics.psnr import psnr
from ihbench.reports.site.corrections import corrected

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.show.subject import Subject

Array = NDArray[np.float64]

LEVELS16, LEVELS8 = 65535, 255
ZERO = 127  # the level of a harmonic that is 0
PAINTED = 4  # bit of a label; the lower two are those of `scene.regions`
SOLID = 0.5  # alpha from which a pixel is the person


@dataclass(frozen=True, eq=False)
class BakedAvatar:
    """N Gaussians at rest: opaque circles, or general ones with `turns` and `opacities`. What a page draws is exactly
    this: everything is rounded to what travels."""

    rest: Array  # [N, 3] m, in the body's shaped T-pose, where its weights apply
    bones: NDArray[np.uint8]  # [N, 4] joints
    weights: NDArray[np.uint8]  # [N, 4] in 255ths, that add up to 255
    scales: Array  # [N] m, or [N, 3] along axes of their own
    colours: NDArray[np.uint8]  # [N, 3] in 255ths of `colour_range`
    labels: NDArray[np.uint8]  # [N] of `scene.regions`, and PAINTED
    joints: Array  # [24, 3] m, of the shaped T-pose
    betas: Array  # [B]
    low: Array  # [3] m, and size: the box that positions are rounded in
    size: Array
    scale_range: tuple[float, float]  # m
    turns: Array | None = None  # [N, 3] x y z of unit quaternions whose w is not negative; None: circles
    opacities: NDArray[np.uint8] | None = None  # [N] in 255ths; None: opaque
    harmonics: NDArray[np.uint8] | None = None  # [N, K, 3] above degree 0: 0 at 127, `reach` at 254; None: none
    colour_range: tuple[float, float] = (0.0, 1.0)
    reach: float = 1.0
    turning: bool = False  # harmonics are of directions of view at rest, not in the world

    def __len__(self) -> int:
        return len(self.rest)

    @cached_property
    def whole_weights(self) -> Array:
        """[N, 24]"""
        return spread_weights(self.bones, self.weights)

    @property
    def shades(self) -> Array:
        """[N, 3] colours, or [N, 1 + K, 3] spherical harmonics."""
        low, high = self.colour_range
        plain = low + self.colours / LEVELS8 * (high - low)
        if self.harmonics is None:
            return plain
        above = (self.harmonics / ZERO - 1) * self.reach
        return np.concatenate([(plain[:, None] - 0.5) / SH_C0, above], 1)

    def blend(self, body: Body, body_pose: BodyPose, correction: Array | None = None) -> Array:
        """[N, 3, 4] rest to world; `correction` [24, 3, 4] as `corrections.corrected` takes it."""
        own = BodyPose(body_pose.pose, self.betas, body_pose.transl)
        transforms = corrected(body.joint_transforms(own)[:, :3], correction, self.joints)
        return np.asarray(np.tensordot(self.whole_weights, transforms, 1), np.float64)

    def means(self, body: Body, body_pose: BodyPose, correction: Array | None = None) -> Array:
        """[N, 3] m, world."""
        blend = self.blend(body, body_pose, correction)
        return np.einsum("nab,nb->na", blend[:, :, :3], self.rest) + blend[:, :, 3]

    def render(
        self,
        body: Body,
        camera: Camera,
        body_pose: BodyPose,
        background: tuple[float, float, float],
        correction: Array | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """rgb [H, W, 3] and alpha [H, W] by the bench's own renderer."""
        import torch

        from ihbench.render.spherical_harmonics import colors_of
        from ihbench.render.splat import render_gaussians

        def tensor(values: Array) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(values, np.float32))

        means, shades, degree = self.means(body, body_pose, correction), self.shades, self.degree
        if self.turning:
            rays = np.einsum("nba,nb->na", self.blend(body, body_pose, correction)[:, :, :3], means - camera.center)
            own, seen_along = (torch.from_numpy(np.ascontiguousarray(part)) for part in (shades, rays))
            shades, degree = colors_of(own, seen_along, torch.zeros(3), self.degree).numpy(), None
        means, colours = tensor(means), tensor(shades)
        with torch.no_grad():
            if self.turns is None or self.opacities is None:
                rgb, alpha = render_gaussians(means, tensor(self.scales), colours, camera, background)
            else:
                linear = self.blend(body, body_pose, correction)[:, :, :3]
                factor = linear @ axes_of(self.turns) * self.scales[:, None, :]
                covariances = tensor(factor @ factor.transpose(0, 2, 1))
                opacities = tensor(self.opacities / LEVELS8)
                rgb, alpha = render_gaussians(
                    means, covariances, colours, camera, background,
                    opacities=opacities, sh_degree=degree if self.harmonics is not None else None, preset="3dgs",
                )  # fmt: skip
        return rgb.clamp(0, 1).numpy(), alpha.numpy()

    def packed(self) -> tuple[bytes, bytes]:
        """What travels: places, sizes, of general ones also turns and opacities, colours, labels and harmonics; and
        bones and weights, which avatars of one body share.

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
        if self.harmonics is not None:
            own += [_narrow(plane) for plane in self.harmonics.reshape(len(self), -1).T]
        skin = [_narrow(plane) for plane in (*self.bones.T, *self.weights.T)]
        return _deflated(b"".join(own)), _deflated(b"".join(skin))

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return 0 if self.harmonics is None else math.isqrt(self.harmonics.shape[1])

    @property
    def about(self) -> dict[str, Any]:
        """What a page must know to unpack it."""
        return {
            "count": len(self), "low": self.low.tolist(), "size": self.size.tolist(),
            "scales": list(self.scale_range), "joints": np.round(self.joints, 7).tolist(),
            "general": self.turns is not None, "degree": self.degree, "colours": list(self.colour_range),
            "reach": self.reach, "turning": self.turning,
        }  # fmt: skip


@dataclass(frozen=True)
class Price:
    """What baking costs in one view: the baked avatar against the method's own drawing, both by the bench."""

    psnr: float  # dB in the person
    iou: float  # of the silhouettes


def price(
    baked: BakedAvatar,
    subject: Subject,
    camera: Camera,
    pose: BodyPose,
    background: tuple[float, float, float],
    correction: Array | None = None,
) -> Price:
    """Measured where either shows the person."""
    rgb, alpha = subject.avatar.render(camera, pose, background)
    drawn, drawn_alpha = baked.render(subject.body, camera, pose, background, correction)
    ours, theirs = np.asarray(drawn_alpha) > SOLID, np.asarray(alpha) > SOLID
    either = ours | theirs
    if not either.any():
        return Price(math.nan, math.nan)
    decibels = float(psnr(displayed(drawn), displayed(np.asarray(rgb)), either))
    return Price(decibels, float((ours & theirs).sum() / either.sum()))


def axes_of(turns: Array) -> Array:
    """[N, 3, 3] of quaternions [N, 3] without their w."""
    from scipy.spatial.transform import Rotation

    w = np.sqrt(np.maximum(1 - (turns**2).sum(1, keepdims=True), 0))
    return Rotation.from_quat(np.concatenate([turns, w], 1)).as_matrix()


def spread_weights(bones: NDArray[np.uint8], weights: NDArray[np.uint8]) -> Array:
    """[N, 24] of four joints and their weights in 255ths."""
    whole = np.zeros((len(bones), 24))
    np.add.at(whole, (np.arange(len(bones))[:, None], bones), weights / LEVELS8)
    return whole


def _narrow(plane: NDArray[np.uint8]) -> bytes:
    return np.diff(plane, prepend=np.uint8(0)).astype(np.uint8).tobytes()


def _wide(plane: NDArray[np.uint16]) -> bytes:
    steps = np.diff(plane, prepend=np.uint16(0)).astype(np.uint16)
    return (steps & 255).astype(np.uint8).tobytes() + (steps >> 8).astype(np.uint8).tobytes()


def _deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()
