"""Switches of Gaussians in the big pose, with the values of the released code (skhu101/GauHuman 732ec0d, of which
tiangexiang/OccFusion f41e091 has a copy). Steps count from 1."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal, TypeVar

from ihbench.config_fields import STEPS, Within
from ihbench.fit.gaussians.density_config import DensityConfig

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
SH_EVERY = 1000
POSITION_DECAY = 30_000


@dataclass(frozen=True)
class BigPoseConfig:
    """What the avatar and every fit of it go by. A method adds its steps and its losses."""

    density: DensityConfig = field(default_factory=DensityConfig)
    """Cloning, splitting, merging and pruning."""
    distance: Annotated[float, Within(0, 1e6, above=True)] = 0.05
    """Gaussians farther than this in m from every vertex of the canonical body are pruned with those too faint."""
    least_px: Annotated[float, Within(0, 1000)] = 0.0
    """Gaussians up to so many pixels at the body's depth count as small in density control, whatever its size in m
    says: below a pixel there is nothing to split."""
    sh_degree: Annotated[int, Within(0, 3)] = 3
    """Highest degree of the spherical harmonics."""
    sh_every: Annotated[int, Within(1, STEPS)] = SH_EVERY
    """Every so many steps the degree in use rises by one, from 0: in 1200 steps to 1, for the last 201."""
    opacity: Annotated[float, Within(0, 1, above=True)] = 0.1
    """Opacity of the first Gaussians."""
    grey: Annotated[float, Within(0, 1)] = 127 / 255
    """Their colour."""
    pose_network: bool = True
    """Correct the frames' poses by a network of the pose."""
    weight_network: bool = True
    """Correct the skinning weights by a network of the position."""
    nearest_every: Annotated[int, Within(1, STEPS)] = 1
    """Steps between two searches for the vertex that each Gaussian takes its weights from."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    lr_position: Annotated[float, RATE] = 1.6e-4
    """Adam's step size of centres in m; it falls log-linearly to 1 % over `position_decay` steps."""
    position_decay: Annotated[int, Within(1, 100 * STEPS)] = POSITION_DECAY
    """See `lr_position`: far more than there are steps, so it falls by 17 % in 1200."""
    lr_scale: Annotated[float, RATE] = 5e-3
    """Adam's step size of the logarithms of scales."""
    lr_rotation: Annotated[float, RATE] = 1e-3
    """Adam's step size of quaternions."""
    lr_opacity: Annotated[float, RATE] = 0.05
    """Adam's step size of opacity logits."""
    lr_colour: Annotated[float, RATE] = 2.5e-3
    """Adam's step size of spherical harmonics of degree 0; those above have a twentieth of it."""
    lr_networks: Annotated[float, RATE] = 5e-5
    """Adam's step size of both networks."""

    @property
    def last_step(self) -> int:
        """Of all stages together."""
        raise NotImplementedError

    @property
    def highest_degree(self) -> int:
        """The degree of the spherical harmonics in the last step; those above never have a gradient."""
        return self.degree_at(self.last_step)

    def degree_at(self, step: int) -> int:
        """The degree in use in a step."""
        return min(self.sh_degree, step // self.sh_every)


Config = TypeVar("Config", bound=BigPoseConfig)


def in_steps(config: Config, share: float, faster: float, **more: Any) -> Config:
    """The schedule of a configuration in a share of its steps, events where they were in it; `more` is what the
    method has beside it.

    Adam moves a parameter by about its rate a step, so fewer steps of the same size would not get there: what has to
    travel far (positions, scales, opacities, colours) goes `faster`.
    """
    density = config.density
    return replace(
        config,
        density=replace(
            density,
            after=round(density.after * share),
            before=round(density.before * share),
            every=max(round(density.every * share), 1),
        ),
        sh_every=max(round(config.sh_every * share), 1),
        position_decay=round(config.position_decay * share),
        lr_position=config.lr_position * faster,
        lr_scale=config.lr_scale * faster,
        lr_opacity=config.lr_opacity * faster,
        lr_colour=config.lr_colour * faster,
        **more,
    )
