"""Stiff training of GauHuman and OccGauHuman: what is asked of every such fit (`stress.fit_cases`), and density
control of a single Gaussian. Named in the spec."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.gauhuman.config import OCCLUDED, SMOKE, GauHumanConfig
from ihbench.methods.gauhuman.method import GauHuman
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.case import Answer
from ihbench.stress.fit_cases import FitCases
from ihbench.stress.six_views import training_set, views

# changes of the set after 12 and 15 of 18 steps; no reset, which so few steps do not outlive; without the network of
# the weights, which takes most of a step's time
TINY = replace(
    SMOKE,
    steps=18,
    density=DensityConfig(after=9, before=17, every=3),
    white_reset=0,
    lr_opacity=0.4,
    lr_colour=0.08,
    weight_network=False,
)
RATES = ("lr_position", "lr_scale", "lr_rotation", "lr_opacity", "lr_colour", "lr_networks")


def fit(config: GauHumanConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return GauHuman(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: GauHumanConfig, training: TrainingSet) -> Any:
    from ihbench.methods.gauhuman.avatar import GauHumanAvatar

    return GauHumanAvatar(config, training.body, 0)


def _one_gaussian() -> Answer:
    """Density control of a single Gaussian: it has no neighbour."""
    import torch

    from ihbench.fit.gaussians.density import divergence_to_nearest
    from ihbench.fit.gaussians.gaussian_set import Gaussians

    alone = Gaussians.on(torch.zeros(1, 3))
    return Answer(float(divergence_to_nearest(alone)[0][0]), math.inf)


OURS = FitCases("gauhuman", TINY, RATES, fit, start)
OCCLUDED_ONES = FitCases("occgauhuman", replace(TINY, **OCCLUDED), RATES, fit, start)

CASES = [
    *OURS.usual(
        replace(TINY, weight_network=True),
        replace(TINY, unknown="ignore"),
        replace(TINY, density=replace(TINY.density, faint=1.0)),
    ),
    OURS.case("one-gaussian", "the divergence of a Gaussian from its nearest neighbour, without any", _one_gaussian,
              "absolute", "infinite: it may grow, never merge"),
]  # fmt: skip

OCCLUDED_CASES = [
    OCCLUDED_ONES.helps("rate-1", "step sizes as they are", lambda: OCCLUDED_ONES.ratio(OCCLUDED_ONES.tiny)),
    OCCLUDED_ONES.helps("one-frame", "one training frame",
                        lambda: OCCLUDED_ONES.ratio(OCCLUDED_ONES.tiny, training_set(views()[1:2]))),
    OCCLUDED_ONES.helps("empty-mask", "two frames without a visible pixel",
                        lambda: OCCLUDED_ONES.empty_masks(OCCLUDED_ONES.tiny)),
]  # fmt: skip
