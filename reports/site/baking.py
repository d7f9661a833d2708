"""Baking: Gaussians at rest with skinning weights, from any avatar that gives its Gaussians in a pose.

With the weights that the method skinned with (`PosedGaussians.weights`), or else those of the nearest surface of
the body, each pose's Gaussians are taken back to rest by the inverse of their own blend, corrected where the method
turned joints itself (`corrections`), and averaged over some training poses. What else depends on the pose is lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.uv import texel_table
from ihbench.files.splat_ply import SH_C0
from ihbench.metrics.eight_bit import displayed
from ihbench.reports.site.avatars import LEVELS8, LEVELS16, PAINTED, ZERO, BakedAvatar, spread_weights
from ihbench.reports.site.corrections import Corrector, corrected
from ihbench.reports.site.painted import painted_counts
from ihbench.scene.regions import SurfaceMap
from ihbench.scene.sightings import FINE

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.scene.visibility import Visibility
    from ihbench.show.subject import Subject

Array = NDArray[np.float64]

BONES = 4  # weights of a Gaussian that are kept
ROUNDS = 3  # of rest positions and corrections, each from the other
STILL = 0.0005  # m (root mean square) by which Gaussians may miss their places before joints are corrected
BETTER = 0.8  # of that distance must be left for corrections to be worth their bytes
DIRECTIONS = 64  # in which harmonics are turned; 16 unknowns
SHADE = 0.01  # root mean square of a colour over all directions that harmonics left out may make up: 40 dB
RARE = 0.001  # share of the numbers beyond a range that are cut


@dataclass(frozen=True)
class _Drawn:
    """N Gaussians in one pose, as numbers."""

    means: Array  # [N, 3]
    scales: Array  # [N], or covariances [N, 3, 3] m²
    colours: Array  # [N, 3], or harmonics [N, K, 3]
    opacities: Array | None  # [N]
    weights: Array | None  # [N, 24]


@dataclass(frozen=True, eq=False)
class Baked:
    """An avatar that was baked, and what finds the corrections of further poses; None where none are needed."""

    avatar: BakedAvatar
    corrections: Callable[[BodyPose], Array] | None  # [24, 3, 4]


def bake(subject: Subject, poses: Sequence[BodyPose], seen: Visibility | None) -> Baked | str:
    """The avatar at rest, averaged over some poses; or why it cannot be had. `seen` is what the training views showed
    on the fine grid of texels; without it nothing is labelled."""
    avatar, body, betas = subject.avatar, subject.body, np.asarray(subject.betas, np.float64)
    draw = _drawer(avatar)
    if draw is None:
        return "its avatar has no Gaussians that could be skinned in a page"
    drawn = [_numbers(draw(pose)) for pose in poses]
    first, count = drawn[0], len(drawn[0].means)
    if any(len(d.means) != count or d.scales.ndim != first.scales.ndim for d in drawn):
        return "its avatar has other Gaussians in every pose"
    kept = np.logical_and.reduce([_drawable(d) for d in drawn])
    if not kept.any():
        return "none of its Gaussians is finite and seen"
    drawn = [d if kept.all() else _some(d, kept) for d in drawn]
    bones, rounded = _four(_weights(avatar, body, betas, first, draw)[kept])
    whole, joints = spread_weights(bones, rounded), body.shaped(betas)[1]
    seen_through = [d.opacities for d in drawn if d.opacities is not None]
    opacities = np.asarray(np.mean(seen_through, 0)) if seen_through else None

    def transforms(pose: BodyPose) -> Array:
        return body.joint_transforms(BodyPose(pose.pose, betas, pose.transl))[:, :3]

    rest, blends, corrector = _at_rest(
        whole, [transforms(pose) for pose in poses], [d.means for d in drawn], joints,
        np.ones(len(whole)) if opacities is None else opacities,
    )  # fmt: skip
    scales, turns = _shapes([d.scales for d in drawn], [blend[:, :, :3] for blend in blends])
    shared, turning = _shared([d.colours for d in drawn], [blend[:, :, :3] for blend in blends])
    colours, harmonics, colour_range, reach = _colours(shared, opacities)
    low, size = rest.min(0), np.maximum(np.ptp(rest, 0), 1e-6)
    span = float(scales.min()), float(max(scales.max(), scales.min() * 1.0001))
    log_low, log_size = math.log(span[0]), math.log(span[1] / span[0])
    made = BakedAvatar(
        low + np.rint((rest - low) / size * LEVELS16) / LEVELS16 * size,
        bones,
        rounded,
        np.exp(log_low + np.rint((np.log(scales) - log_low) / log_size * LEVELS16) / LEVELS16 * log_size),
        colours,
        _labels(subject, rest, seen),
        joints,
        betas,
        low,
        size,
        span,
        None if turns is None else np.rint((turns + 1) / 2 * LEVELS16) / LEVELS16 * 2 - 1,
        None if opacities is None else np.rint(opacities * LEVELS8).astype(np.uint8),
        harmonics,
        colour_range,
        reach,
        turning and harmonics is not None,
    )
    if corrector is None:
        return Baked(made, None)
    return Baked(made, lambda pose: corrector.of(_numbers(draw(pose)).means[kept], transforms(pose)))


def _drawer(avatar: Any) -> Callable[[BodyPose], Any] | None:
    """What gives an avatar's Gaussians in a pose: `posed_gaussians` with all that `render_gaussians` takes, or
    `gaussians` with means, scales and colours of circles."""
    posed = getattr(avatar, "posed_gaussians", None)
    if callable(posed):
        return posed
    circles = getattr(avatar, "gaussians", None)
    return circles if callable(circles) and not hasattr(circles, "opacities") else None


def _numbers(gaussians: Any) -> _Drawn:
    """Circles stay circles; others have covariances and opacities."""
    import torch

    from ihbench.render.splat_projection import covariances_of

    with torch.no_grad():
        if isinstance(gaussians, tuple):
            means, scales, colours = gaussians[:3]
            quaternions, opacities, weights = None, None, None
        else:
            means, scales, colours = gaussians.means, gaussians.scales, gaussians.colors
            quaternions, opacities = gaussians.quaternions, gaussians.opacities
            weights = getattr(gaussians, "weights", None)
            if gaussians.sh_degree is not None:
                colours = colours[:, : (gaussians.sh_degree + 1) ** 2]
        if (scales.ndim == 1 and opacities is not None) or scales.ndim == 2:
            scales = covariances_of(scales, quaternions)
        if scales.ndim == 3 and opacities is None:
            opacities = means.new_ones(len(means))

        def numbers(values: torch.Tensor | None) -> Any:
            return None if values is None else np.asarray(values.detach().cpu(), np.float64)

        return _Drawn(*(numbers(values) for values in (means, scales, colours, opacities, weights)))


def _drawable(drawn: _Drawn) -> NDArray[np.bool_]:
    """[N]: finite, and not too transparent to be drawn at all."""
    count = len(drawn.means)
    parts = [drawn.means, drawn.scales.reshape(count, -1), drawn.colours.reshape(count, -1)]
    kept = np.asarray(np.isfinite(np.column_stack(parts)).all(1), bool)
    if drawn.opacities is not None:
        kept &= np.rint(np.nan_to_num(drawn.opacities) * LEVELS8) >= 1
    return kept


def _some(drawn: _Drawn, kept: NDArray[np.bool_]) -> _Drawn:
    parts = (drawn.means, drawn.scales, drawn.colours, drawn.opacities, drawn.weights)
    return _Drawn(*(None if part is None else part[kept] for part in parts))  # pyright: ignore[reportArgumentType]


def _at_rest(
    whole: Array,  # [N, 24]
    transforms: Sequence[Array],  # [24, 3, 4] of each pose
    means: Sequence[Array],  # [N, 3] m in each
    joints: Array,  # [24, 3] m
    importance: Array,  # [N]
) -> tuple[Array, list[Array], Corrector | None]:
    """Places at rest [N, 3], blends [N, 3, 4] of the poses, and what corrects poses, where that brings Gaussians
    nearer."""

    def back(of: Sequence[Array]) -> tuple[Array, list[Array]]:
        blends = [np.tensordot(whole, one, 1) for one in of]
        rests = [
            np.linalg.solve(blend[:, :, :3], (mean - blend[:, :, 3])[:, :, None])[:, :, 0]
            for blend, mean in zip(blends, means, strict=True)
        ]
        return np.mean(rests, 0), blends

    def missed(rest: Array, blends: Sequence[Array]) -> float:
        apart = [
            (((blend[:, :, :3] @ rest[:, :, None])[:, :, 0] + blend[:, :, 3] - mean) ** 2).sum(1)
            for blend, mean in zip(blends, means, strict=True)
        ]
        return math.sqrt(float(np.average(np.mean(apart, 0), weights=importance)))

    rest, blends = back(transforms)
    as_it_is = missed(rest, blends)
    if as_it_is <= STILL:
        return rest, blends, None
    other, own = rest, blends
    for _ in range(ROUNDS):
        corrector = Corrector(other, whole, joints, importance)
        moved = [corrected(one, corrector.of(mean, one), joints) for one, mean in zip(transforms, means, strict=True)]
        other, own = back(moved)
    if missed(other, own) > BETTER * as_it_is:
        return rest, blends, None
    return other, own, Corrector(other, whole, joints, importance)


def _shapes(scales: Sequence[Array], linear: Sequence[Array]) -> tuple[Array, Array | None]:
    """The mean at rest: of circles [N] m, and None; of general ones [N, 3] m along axes of their own, and these."""
    if scales[0].ndim == 1:
        return np.exp(np.mean([np.log(np.maximum(one, 1e-6)) for one in scales], 0)), None
    backs = [np.linalg.inv(turn) for turn in linear]
    return _axes_of(np.mean([b @ one @ b.swapaxes(1, 2) for b, one in zip(backs, scales, strict=True)], 0))


def _shared(
    colours: Sequence[Array],  # of each pose [N, 3], or harmonics [N, K, 3]
    linear: Sequence[Array],  # [N, 3, 3] rest to world
) -> tuple[Array, bool]:
    """The mean over poses, and whether it is of directions of view at rest: harmonics of some methods turn with the
    body, and differ less from pose to pose there than in the world."""
    worlds = np.stack(colours)
    if worlds.ndim < 4 or worlds.shape[2] == 1 or len(worlds) == 1:
        return worlds.mean(0), False
    apart = float(((worlds - worlds.mean(0)) ** 2).mean())
    if apart < SHADE**2:
        return worlds.mean(0), False
    rests = np.stack([_at_rest_seen(one, blend) for one, blend in zip(colours, linear, strict=True)])
    turning = bool(((rests - rests.mean(0)) ** 2).mean() < apart)
    return (rests if turning else worlds).mean(0), turning


def _at_rest_seen(
    harmonics: Array,  # [N, K, 3] of directions of view in the world
    linear: Array,  # [N, 3, 3]
) -> Array:
    """[N, K, 3] the same colours by the directions that the transposed transform takes to rest."""
    import torch

    from ihbench.render.spherical_harmonics import basis

    degree = math.isqrt(harmonics.shape[1]) - 1
    rest = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    rest /= np.linalg.norm(rest, axis=1, keepdims=True)
    back = np.linalg.pinv(basis(torch.from_numpy(rest), degree).numpy())
    out = np.empty_like(harmonics)
    for some in np.array_split(np.arange(len(harmonics)), len(harmonics) // 4096 + 1):
        world = np.einsum("nba,db->nda", np.linalg.inv(linear[some]), rest)
        world /= np.linalg.norm(world, axis=2, keepdims=True)
        values = basis(torch.from_numpy(world.reshape(-1, 3)), degree).numpy().reshape(len(some), DIRECTIONS, -1)
        out[some] = back @ (values @ harmonics[some])
    return out


def _colours(
    colours: Array,  # [N, 3] or harmonics [N, K, 3]
    opacities: Array | None,
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None, tuple[float, float], float]:
    """Colours of no direction as bytes, harmonics above them likewise, as many as show, and what the bytes mean."""
    if colours.ndim == 2:
        return displayed(np.clip(colours, 0, 1)[None])[0], None, (0.0, 1.0), 1.0
    from ihbench.render.spherical_harmonics import DEGREES

    weights = np.ones(len(colours)) if opacities is None else opacities
    # the basis is orthonormal: a colour's mean square over all directions is that of its numbers by 4 pi
    squares = np.average((colours**2).sum(2), 0, weights) / 12 / np.pi
    left_out = [squares[(d + 1) ** 2 :].sum() for d in DEGREES]
    degree = next(d for d in DEGREES if left_out[d] <= SHADE**2)
    plain, above = colours[:, 0] * SH_C0 + 0.5, colours[:, 1 : (degree + 1) ** 2]
    low = min(0.0, float(np.quantile(plain, RARE))) if degree else 0.0  # what is dark from everywhere is black
    high = max(1.0, float(np.quantile(plain, 1 - RARE)))
    bytes_ = np.rint((np.clip(plain, low, high) - low) / (high - low) * LEVELS8).astype(np.uint8)
    if degree == 0:
        return bytes_, None, (low, high), 1.0
    reach = max(float(np.quantile(np.abs(above), 1 - RARE)), 1e-6)
    levels = np.rint((np.clip(above / reach, -1, 1) + 1) * ZERO).astype(np.uint8)
    return bytes_, levels, (low, high), reach


def _axes_of(covariances: Array) -> tuple[Array, Array]:
    """[N, 3] standard deviations, at least a micrometre, and [N, 3] the quaternions of their axes without w."""
    from scipy.spatial.transform import Rotation

    values, axes = np.linalg.eigh((covariances + covariances.swapaxes(1, 2)) / 2)
    axes[np.linalg.det(axes) < 0, :, 0] *= -1
    turns = Rotation.from_matrix(axes).as_quat(canonical=True)
    return np.sqrt(np.maximum(values, 1e-12)), turns[:, :3]


def _weights(avatar: Any, body: Body, betas: Array, drawn: _Drawn, draw: Callable[[BodyPose], Any]) -> Array:
    """[N, 24] what the avatar skins with, or the weights of the nearest point of the body, in a pose with its limbs
    apart."""
    if drawn.weights is not None:
        return drawn.weights
    count = len(drawn.means)
    own = getattr(avatar, "weights", None)
    if getattr(own, "shape", None) == (count, 24):
        return np.asarray(own.detach().cpu(), np.float64)  # pyright: ignore[reportOptionalMemberAccess]
    from scipy.spatial import KDTree

    texels = texel_table(body, FINE)
    apart = BodyPose(canonical_pose("a_pose"), betas, np.zeros(3))
    surface = texels.interpolate(body.pose(apart), body.faces)
    nearest = KDTree(surface).query(np.nan_to_num(_numbers(draw(apart)).means))[1]
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
