"""Every switch of GauHuman and OccGauHuman, with the value of the released code (skhu101/GauHuman 732ec0d).

Steps count from 1. What `paper` says is what was released; `quick` and `smoke` are the same schedule in fewer steps.
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
RELEASED_STEPS = 1200
RELEASED_EVENTS = DensityConfig()  # after 400, before 1000, every 100
OPACITY_RESET = 400
SH_EVERY = 1000
POSITION_DECAY = 30_000

STATIC_DEG = 5.0  # below this no joint moves, and no network learns anything from the pose
ONE_SIDE_DEG = 10.0  # a person who turns by less is seen from one direction: colours by direction are one colour
NOTHING_HIDDEN = 0.002  # share of the texels that no frame shows although one faces them; fewer are specks

# shares of a step's time, estimated
POSE_SHARE = 0.03
DIRECTION_SHARE = 0.01


@dataclass(frozen=True)
class GauHumanConfig:
    unknown: Literal["background", "ignore"] = "background"
    """What a hidden pixel is taken for. As released, which knows two states: background, so the occluder carves the
    person. With ignore no term of the loss looks there."""
    colours: Literal["everywhere", "visible"] = "everywhere"
    """Where colours are compared: in the whole box around the body, or (OccGauHuman) on visible person pixels."""
    silhouette: Literal["visible", "complete"] = "visible"
    """What alpha is held to: the visible person, or (OccGauHuman) that and what the posed body covers of the hidden
    pixels."""
    backdrop: Literal["protocol", "black"] = "protocol"
    """Colour behind the person while fitting: the protocol's, or black as in the released scripts."""
    steps: Annotated[int, Within(1, STEPS)] = RELEASED_STEPS
    """Optimisation steps, one training view each."""
    density: DensityConfig = field(default_factory=lambda: RELEASED_EVENTS)
    """Cloning, splitting, merging and pruning."""
    distance: Annotated[float, Within(0, 1e6, above=True)] = 0.05
    """Gaussians farther than this in m from every vertex of the canonical body are pruned with those too faint."""
    least_px: Annotated[float, Within(0, 1000)] = 0.0
    """Gaussians up to so many pixels at the body's depth count as small in density control, whatever its size in m
    says: below a pixel there is nothing to split."""
    white_reset: Annotated[int, Within(0, STEPS)] = OPACITY_RESET
    """After this step opacities are set to .01 at most if the person stands on white; 0 never. As released, which
    never does it on black."""
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
    mask: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean squared error of alpha in the box."""
    ssim: Annotated[float, WEIGHT] = 0.01
    """Weight of 1 - SSIM."""
    lpips: Annotated[float, WEIGHT] = 0.01
    """Weight of LPIPS. Off, and said so, without its trunk's weights."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    lr_position: Annotated[float, RATE] = 1.6e-4
    """Adam's step size of centres in m; it falls log-linearly to 1 % over `position_decay` steps."""
    position_decay: Annotated[int, Within(1, 100 * STEPS)] = POSITION_DECAY
    """See `lr_position`: far more than there are steps, so it falls by 17 %."""
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
    def highest_degree(self) -> int:
        """The degree of the spherical harmonics in the last step; those above never have a gradient."""
        return min(self.sh_degree, self.steps // self.sh_every)

    def degree_at(self, step: int) -> int:
        """The degree in use in a step."""
        return min(self.sh_degree, step // self.sh_every)

    def __post_init__(self) -> None:
        check(self, "--method.")


def in_steps(config: GauHumanConfig, steps: int, faster: float) -> GauHumanConfig:
    """The schedule of a configuration with the released number of steps in fewer, events at the same shares of them.

    Adam moves a parameter by about its rate a step, so fewer steps of the same size would not get there: what has to
    travel far (positions, scales, opacities, colours) goes `faster`.
    """
    share = steps / config.steps
    density = config.density
    return replace(
        config,
        steps=steps,
        density=replace(
            density,
            after=round(density.after * share),
            before=round(density.before * share),
            every=max(round(density.every * share), 1),
        ),
        white_reset=round(config.white_reset * share),
        sh_every=max(round(config.sh_every * share), 1),
        position_decay=round(config.position_decay * share),
        lr_position=config.lr_position * faster,
        lr_scale=config.lr_scale * faster,
        lr_opacity=config.lr_opacity * faster,
        lr_colour=config.lr_colour * faster,
    )


# LPIPS through VGG would take three times as long as all the rest of a step, at a weight of .01
ON_A_CPU = GauHumanConfig(lpips=0.0, least_px=1.0, nearest_every=10)
# losses of OccFusion's first stage (tiangexiang/OccFusion f41e091, stage1.py:166-192) without score distillation
OCCLUDED = {"colours": "visible", "silhouette": "complete", "mask": 2.0, "ssim": 0.1}

PAPER = GauHumanConfig()
QUICK = in_steps(ON_A_CPU, 600, 2.0)
SMOKE = replace(in_steps(ON_A_CPU, 60, 10.0), lr_position=8e-4, lr_scale=2e-2)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}
OCCGAUHUMAN_PROFILES = {
    "smoke": replace(SMOKE, **OCCLUDED),
    "quick": replace(QUICK, **OCCLUDED),
    "paper": replace(PAPER, **OCCLUDED, lpips=0.1),
}


def leave_out(config: GauHumanConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = []
    if config.pose_network and scene.motion_deg < STATIC_DEG:
        reason = f"no joint turns more than {scene.motion_deg:.1f}° over the training frames (limit {STATIC_DEG}°)"
        out.append(Omission("pose_network", False, reason, {"fit/gaussians": POSE_SHARE}))
    if config.highest_degree > 0 and max(scene.turn_deg, scene.motion_deg) < ONE_SIDE_DEG:
        reason = (
            f"the person turns by {scene.turn_deg:.1f}° and moves by {scene.motion_deg:.1f}°: every point is seen "
            "from one direction"
        )
        out.append(Omission("sh_degree", 0, reason, {"fit/gaussians": DIRECTION_SHARE}))
    if config.silhouette == "complete" and scene.hidden_share == 0:
        out.append(Omission("silhouette", "visible", "nothing is hidden: the visible person is the complete one"))
    return out


def outside_files(config: GauHumanConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, whose term is off while the file is not there."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
