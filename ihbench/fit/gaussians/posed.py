"""An avatar's Gaussians in one pose, as they are drawn: what `ihbench export` writes into files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ihbench.camera import Camera
from ihbench.render.splat import render_gaussians


@dataclass(frozen=True)
class PosedGaussians:
    """The arguments of `render.splat.render_gaussians` but for camera and background; world, metres.

    `weights` are what the Gaussians were skinned with, where they were: a viewer can then move them by itself.
    """

    means: Tensor  # [N, 3] m
    scales: Tensor  # [N] or [N, 3] m, standard deviations, or [N, 3, 3] m², covariances
    colors: Tensor  # [N, 3], or spherical harmonics [N, K, 3]
    quaternions: Tensor | None = None  # [N, 4] w x y z, of scales [N, 3]
    opacities: Tensor | None = None  # [N] 0..1; None: opaque
    sh_degree: int | None = None  # None: `colors` are colours
    weights: Tensor | None = None  # [N, 24] of the joints, rows sum to 1

    def draw(
        self, camera: Camera, background: Sequence[float] | Tensor, outputs: Sequence[str] = ("rgb", "alpha")
    ) -> tuple[Any, ...]:
        """What `render_gaussians` gives of them by the rules of 3DGS."""
        return render_gaussians(
            self.means,
            self.scales,
            self.colors,
            camera,
            background,
            quaternions=self.quaternions,
            opacities=self.opacities,
            sh_degree=self.sh_degree,
            preset="3dgs",
            outputs=outputs,
        )
