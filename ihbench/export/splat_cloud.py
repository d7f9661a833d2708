"""Gaussians as files keep them: scales and quaternions, spherical harmonics, in the axes that readers expect."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.files.splat_ply import OPACITY, SH_C0

if TYPE_CHECKING:
    from torch import Tensor

    from ihbench.fit.gaussians.posed import PosedGaussians

Array = NDArray[np.float64]

DIRECTIONS = 64  # in which a harmonic and its turned self are compared; 16 unknowns


@dataclass(frozen=True)
class SplatCloud:
    means: Array  # [N, 3] m
    scales: Array  # [N, 3] m, standard deviations
    quaternions: Array  # [N, 4] unit, w x y z
    opacities: Array  # [N] 0..1
    harmonics: Array  # [N, K, 3], K = 1, 4, 9 or 16; colour = 0.5 + their sum, as 3D Gaussian splatting has it

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        return round(np.sqrt(self.harmonics.shape[1])) - 1

    @property
    def colors(self) -> Array:
        """[N, 3] in [0, 1], of all directions on average."""
        return np.clip(0.5 + SH_C0 * self.harmonics[:, 0], 0, 1)

    def widened(self, blur: float) -> SplatCloud:  # m, a standard deviation
        """Each Gaussian convolved with a round one; opacities stay, as in rasterisers that widen footprints."""
        return replace(self, scales=np.sqrt(self.scales**2 + blur**2))

    def turned(
        self,
        R: Array,  # [3, 3] a rotation
        origin: Array,  # [3] m, what becomes the origin
    ) -> SplatCloud:
        """The same Gaussians with points x at R (x - origin), and seen from there as they were."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(R)
        own = self.quaternions
        if len(self):
            own = (turn * Rotation.from_quat(own[:, [1, 2, 3, 0]])).as_quat()[:, [3, 0, 1, 2]]
        harmonics = np.einsum("kl,nlc->nkc", harmonics_turn(R, self.degree), self.harmonics)
        return SplatCloud((self.means - origin) @ R.T, self.scales, own, self.opacities, harmonics)


def splat_cloud(gaussians: PosedGaussians) -> tuple[SplatCloud, int]:
    """The cloud, without Gaussians that have a value that is not finite (no renderer draws them); and how many those
    were."""
    means = _numpy(gaussians.means)
    colors = _numpy(gaussians.colors)
    if gaussians.sh_degree is None:
        harmonics = ((colors - 0.5) / SH_C0)[:, None]
    else:
        harmonics = colors[:, : (gaussians.sh_degree + 1) ** 2]
    if gaussians.opacities is None:
        opacities = np.full(len(means), OPACITY)  # the renderer's bound: opacity 1 has no finite logit
    else:
        opacities = _numpy(gaussians.opacities)
    raw = _numpy(gaussians.scales)
    flat = [values.reshape(len(means), -1) for values in (means, raw, harmonics, opacities)]
    if gaussians.quaternions is not None:
        flat.append(_numpy(gaussians.quaternions))
    finite = np.isfinite(np.concatenate(flat, 1)).all(1)
    turns = None if gaussians.quaternions is None else flat[-1][finite]
    scales, quaternions = _axes(raw[finite], turns)
    cloud = SplatCloud(means[finite], scales, quaternions, opacities[finite], harmonics[finite])
    return cloud, int((~finite).sum())


def harmonics_turn(R: Array, degree: int) -> Array:
    """[K, K] what turns coefficients of real spherical harmonics up to a degree along with a rotation: the function
    of the new coefficients at R d is that of the old ones at d. Found from its values in many directions, which is
    exact, since the space of each degree is closed under rotation."""
    import torch

    from ihbench.render.spherical_harmonics import basis

    rng = np.random.default_rng(0)
    directions = rng.normal(size=(DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = basis(torch.from_numpy(directions), degree).numpy()
    after = basis(torch.from_numpy(directions @ R.T), degree).numpy()
    return np.linalg.lstsq(after, before, rcond=None)[0]


def _axes(scales: Array, quaternions: Array | None) -> tuple[Array, Array]:
    """Scales [n, 3] and unit quaternions [n, 4] of scales [n] or [n, 3], or of covariances [n, 3, 3]."""
    from scipy.spatial.transform import Rotation

    n = len(scales)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    if scales.ndim == 1:
        return scales[:, None].repeat(3, 1), upright
    if scales.ndim == 2:
        if quaternions is None:
            return scales, upright
        length = np.linalg.norm(quaternions, axis=1, keepdims=True)
        return scales, np.where(length > 0, quaternions / np.where(length > 0, length, 1), upright)
    variances, axes = np.linalg.eigh((scales + scales.transpose(0, 2, 1)) / 2)
    axes = axes * np.where(np.linalg.det(axes) < 0, -1, 1)[:, None, None]  # a rotation, no reflection
    turns = Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]] if n else upright
    return np.sqrt(np.maximum(variances, 0)), turns


def _numpy(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()
