"""Every switch of GauHuman and OccGauHuman, with the value of the released code (skhu101/GauHuman 732ec0d).

Steps count from 1. What `paper` says is what was released; `quick` and `smoke` are the same schedule in fewer steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.fit.big_pose.config import WEIGHT, BigPoseConfig, in_steps
from ihbench.fit.big_pose.plan import parts_of_no_use
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

RELEASED_STEPS = 1200
OPACITY_RESET = 400


@dataclass(frozen=True)
class GauHumanConfig(BigPoseConfig):
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
    white_reset: Annotated[int, Within(0, STEPS)] = OPACITY_RESET
    """After this step opacities are set to .01 at most if the person stands on white; 0 never. As released, which
    never does it on black."""
    mask: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean squared error of alpha in the box."""
    ssim: Annotated[float, WEIGHT] = 0.01
    """Weight of 1 - SSIM."""
    lpips: Annotated[float, WEIGHT] = 0.01
    """Weight of LPIPS. Off, and said so, without its trunk's weights."""

    @property
    def last_step(self) -> int:
        return self.steps

    def __post_init__(self) -> None:
        check(self, "--method.")


def fewer(config: GauHumanConfig, steps: int, faster: float) -> GauHumanConfig:
    """The schedule in fewer steps (`in_steps`)."""
    share = steps / config.steps
    return in_steps(config, share, faster, steps=steps, white_reset=round(config.white_reset * share))


# LPIPS through VGG would take three times as long as all the rest of a step, at a weight of .01
ON_A_CPU = GauHumanConfig(lpips=0.0, least_px=1.0, nearest_every=10)
# losses of OccFusion's first stage (tiangexiang/OccFusion f41e091, stage1.py:166-192) without score distillation
OCCLUDED = {"colours": "visible", "silhouette": "complete", "mask": 2.0, "ssim": 0.1}

PAPER = GauHumanConfig()
QUICK = fewer(ON_A_CPU, 600, 2.0)
SMOKE = replace(fewer(ON_A_CPU, 60, 10.0), lr_position=8e-4, lr_scale=2e-2)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}
OCCGAUHUMAN_PROFILES = {
    "smoke": replace(SMOKE, **OCCLUDED),
    "quick": replace(QUICK, **OCCLUDED),
    "paper": replace(PAPER, **OCCLUDED, lpips=0.1),
}


def leave_out(config: GauHumanConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = parts_of_no_use(config, scene, ("fit/gaussians",))
    if config.silhouette == "complete" and scene.hidden_share == 0:
        out.append(Omission("silhouette", "visible", "nothing is hidden: the visible person is the complete one"))
    return out


def outside_files(config: GauHumanConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, whose term is off while the file is not there."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
