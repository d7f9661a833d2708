"""Every switch of 3DGS-Avatar, with the value of the released code (mikeqzy/3dgs-avatar-release fc39bc5).

Steps count from 1. What `paper` says is what was released for ZJU-MoCap; `quick` and `smoke` are the same order of
events in fewer steps.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
STEP = Within(0, STEPS)
RELEASED_STEPS = 15_000
EXTENT = 3.469  # m: the released "camera extent" of ZJU-MoCap, by which sizes and position rates are multiplied
RELEASED_DENSITY = DensityConfig(
    after=1000,
    before=10_000,
    every=100,
    size=0.01 * EXTENT,
    clone="in_place",
    kl_grow=None,
    kl_merge=None,
    faint=0.05,
    largest=0.1 * EXTENT,
    size_after=3000,
    resets=(3000, 6000, 9000),
)

STATIC_DEG = 5.0  # below this no joint moves, and a deformation that depends on the pose is a constant
ONE_SIDE_DEG = 10.0  # a person who turns by less is seen from one direction: colours by direction are one colour

# shares of a step's time, measured with the quick profile
NON_RIGID_SHARE = 0.34
DIRECTION_SHARE = 0.08


@dataclass(frozen=True)
class ThreeDgsAvatarConfig:
    unknown: Literal["background", "ignore"] = "background"
    """What a hidden pixel is taken for. As released, which knows two states: background, so the occluder carves the
    person. With ignore no term of the loss looks there, and Gaussians that no known pixel showed are not pruned."""
    backdrop: Literal["protocol", "black"] = "protocol"
    """Colour behind the person while fitting: the protocol's, or black as in the released scripts."""
    steps: Annotated[int, Within(1, STEPS)] = RELEASED_STEPS
    """Optimisation steps, one training view each."""
    points: Annotated[int, Within(1, 10_000_000)] = 50_000
    """Gaussians at first, at places drawn from the body's surface."""
    opacity: Annotated[float, Within(0, 1, above=True)] = 0.1
    """Their opacity."""
    density: DensityConfig = field(default_factory=lambda: RELEASED_DENSITY)
    """Cloning, splitting, pruning and opacity resets."""
    warm_up: Annotated[int, STEP] = 0
    """Steps before the first in which the skinning field alone is fitted to the body's weights. None as released,
    where it has until `gaussians_from`; in a short fit that is too soon, and Gaussians follow the wrong bones."""
    gaussians_from: Annotated[int, STEP] = 1000
    """The first step that changes Gaussians; networks learn from the first of all."""
    non_rigid: bool = True
    """Move, scale and turn Gaussians by a hash grid and a network of the pose."""
    non_rigid_from: Annotated[int, STEP] = 3000
    """The first step that has it."""
    hash_size: Annotated[int, Within(4, 24)] = 16
    """Binary logarithm of the hash grid's rows a level."""
    hash_finest: Annotated[int, Within(16, 1_000_000)] = 2048
    """Corners along a side of its finest lattice; the coarsest has 16."""
    last_layer: Annotated[float, Within(0, 10)] = 0.0
    """Standard deviation of the first weights of its network's last layer, with biases of 0; 0: PyTorch's own, which
    shifts everything by centimetres at once."""
    refine_poses: bool = True
    """Fit the training frames' poses, translations and one shape."""
    poses_from: Annotated[int, STEP] = 5000
    """The first step that does."""
    test_poses: Literal["released", "given"] = "released"
    """A test view of a training frame: with that frame's fitted pose, as released, or with the pose it is given. Its
    colours are those of that frame's latent code either way."""
    pose_noise: Annotated[float, Within(0, 10)] = 0.1
    """Standard deviation of noise on the rotation matrices that the pose code reads, in every other step."""
    view_colours: bool = True
    """Whether colours depend on the direction of view."""
    view_noise: Literal["released", "normal", "off"] = "released"
    """Random turns of the directions of view while fitting: about x, y and z by normal angles of 45°, at most 90°;
    released draws those about y evenly from 0° to 45°."""
    neighbours_every: Annotated[int, Within(1, STEPS)] = 1
    """Steps between two searches for the four nearest Gaussians of each."""
    l1: Annotated[float, WEIGHT] = 1.0
    """Weight of the mean absolute error of colours over the whole frame."""
    mask: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean absolute error of alpha over the whole frame."""
    lpips: Annotated[float, WEIGHT] = 0.01
    """Weight of LPIPS over the rectangle around the visible person. Off, and said so, without its trunk's weights."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    lpips_px: Annotated[int, Within(0, 1_000_000)] = 0
    """Side in px of a window drawn from the rectangle, in which LPIPS is taken; 0: all of it."""
    lpips_every: Annotated[int, Within(1, STEPS)] = 1
    """Steps between two that have LPIPS, at so many times its weight."""
    skinning: Annotated[float, WEIGHT] = 0.1
    """Weight of the squared difference between the skinning field and the body's weights on the body's surface."""
    skinning_first: Annotated[float, WEIGHT] = 10.0
    """The same in the steps before `gaussians_from`."""
    surface_samples: Annotated[int, Within(1, 1_000_000)] = 1024
    """Fresh places on the body's surface for it in each step."""
    isometry: Annotated[float, WEIGHT] = 1.0
    """Weight of the change of distances between neighbours (AIAP)."""
    isometry_shape: Annotated[float, WEIGHT] = 100.0
    """Weight of the change of distances between neighbours' covariances."""
    shape_distance: Literal["released", "invariant"] = "released"
    """How far two covariances are apart: over six entries as released, which a turn changes, or over all nine."""
    lr_position: Annotated[float, RATE] = 1.6e-4 * EXTENT
    """Adam's step size of centres in m; it falls log-linearly to 1 % over `position_decay` steps."""
    position_decay: Annotated[int, Within(1, 100 * STEPS)] = 30_000
    """See `lr_position`."""
    lr_feature: Annotated[float, RATE] = 1e-3
    """Adam's step size of the Gaussians' features."""
    lr_opacity: Annotated[float, RATE] = 0.05
    """Adam's step size of opacity logits."""
    lr_scale: Annotated[float, RATE] = 5e-3
    """Adam's step size of the logarithms of scales."""
    lr_rotation: Annotated[float, RATE] = 1e-3
    """Adam's step size of quaternions."""
    lr_warm_up: Annotated[float, RATE] = 2e-3
    """Adam's step size in the warm-up; it falls to a tenth."""
    lr_skinning: Annotated[float, RATE] = 1e-4
    """Adam's step size of the skinning field. Step sizes of networks and poses fall to a tenth over the fit."""
    lr_non_rigid: Annotated[float, RATE] = 1e-3
    """Adam's step size of hash grid, pose code and their network."""
    lr_colour: Annotated[float, RATE] = 1e-3
    """Adam's step size of the colour network and the frames' latent codes."""
    lr_poses: Annotated[float, RATE] = 1e-4
    """Adam's step size of poses, translations and shape."""
    latent_decay: Annotated[float, Within(0, 1000)] = 0.05
    """What is added to the gradient of latent codes, times the codes."""
    clip: Annotated[float, Within(0, 1e9, above=True)] = 0.1
    """Largest norm of the gradient of all networks and tables together."""

    def __post_init__(self) -> None:
        check(self, "--method.")


def in_steps(config: ThreeDgsAvatarConfig, steps: int, every: int, resets: int) -> ThreeDgsAvatarConfig:
    """The schedule of a configuration in fewer steps, events at the same shares of them; the set of Gaussians changes
    `every` so many steps all the same, and only the first `resets` of the opacity resets are kept: what survives
    one must have time to become opaque again before it is pruned."""
    share = steps / config.steps
    density = config.density

    def scaled(step: int) -> int:
        return round(step * share)

    return replace(
        config,
        steps=steps,
        density=replace(
            density,
            after=scaled(density.after),
            before=scaled(density.before),
            every=every,
            size_after=scaled(density.size_after),
            resets=tuple(scaled(step) for step in density.resets[:resets]),
        ),
        gaussians_from=scaled(config.gaussians_from),
        non_rigid_from=scaled(config.non_rigid_from),
        poses_from=scaled(config.poses_from),
        position_decay=scaled(config.position_decay),
    )


ON_A_CPU = ThreeDgsAvatarConfig(
    points=10_000,
    hash_size=14,
    hash_finest=512,
    last_layer=1e-5,
    neighbours_every=50,
    lpips_px=64,
    lpips_every=4,
)

PAPER = ThreeDgsAvatarConfig()
QUICK = replace(
    in_steps(ON_A_CPU, 750, every=50, resets=1),
    warm_up=800,
    lr_feature=5e-3,
    lr_colour=4e-3,
    lr_skinning=5e-4,
)
SMOKE = replace(
    in_steps(ON_A_CPU, 60, every=10, resets=0),
    points=3000,
    warm_up=200,
    hash_size=10,
    hash_finest=64,
    neighbours_every=20,
    lpips=0.0,
    lr_position=2e-3,
    lr_opacity=0.2,
    lr_scale=0.02,
    lr_feature=0.03,
    lr_colour=0.01,
    lr_warm_up=4e-3,
    lr_skinning=1e-3,
)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: ThreeDgsAvatarConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    if config.non_rigid and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("non_rigid", False, reason, {"fit/gaussians": NON_RIGID_SHARE}))
    if config.view_colours and max(scene.turn_deg, scene.motion_deg) < ONE_SIDE_DEG:
        reason = (
            f"the person turns by {scene.turn_deg:.1f}° and moves by {scene.motion_deg:.1f}°: every point is seen "
            "from one direction"
        )
        out.append(Omission("view_colours", False, reason, {"fit/gaussians": DIRECTION_SHARE}))
    return out


def outside_files(config: ThreeDgsAvatarConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, whose term is off while the file is not there."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
