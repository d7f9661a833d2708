"""Stiff training of OccFusion: few steps, a person of six small frames, and everything that goes wrong.

Named in the spec: what is asked of every such fit (`stress.fit_cases`). All but one case leave the diffusion model
out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.occfusion.config import SMOKE, InpaintConfig, OccFusionConfig, ScoreConfig
from ihbench.methods.occfusion.method import OccFusion
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.fit_cases import FitCases

# changes of the set after 12 and 15 of 16 steps; without the network of the weights, which takes most of the time
TINY = replace(
    SMOKE,
    steps=8,
    refine=replace(SMOKE.refine, steps=8),
    density=DensityConfig(after=9, before=16, every=3),
    inpaint=InpaintConfig(on=False),
    lr_opacity=0.4,
    lr_colour=0.08,
    weight_network=False,
)
PAINTS = {"inpaint": InpaintConfig(key_frames=2, mask_steps=1, steps=1), "score": ScoreConfig(every=4)}
RATES = ("lr_position", "lr_scale", "lr_rotation", "lr_opacity", "lr_colour", "lr_networks")


def fit(config: OccFusionConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return OccFusion(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: OccFusionConfig, training: TrainingSet) -> Any:
    from ihbench.methods.occfusion.avatar import OccFusionAvatar

    return OccFusionAvatar(config, training.body, 0)


OURS = FitCases("occfusion", TINY, RATES, fit, start)
CASES = OURS.usual(replace(TINY, **PAINTS), TINY, replace(TINY, density=replace(TINY.density, faint=1.0)))
