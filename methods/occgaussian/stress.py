"""Stiff training of OccGaussian: what is asked of every such fit (`stress.fit_cases`), and a person of whom nothing
is seen clearly enough to be asked. Named in the spec."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.fit.gaussians.density_config import DensityConfig
from ihbench.methods.occgaussian.config import SMOKE, OccGaussianConfig
from ihbench.methods.occgaussian.method import OccGaussian
from ihbench.scene.contracts import TrainingSet
from ihbench.stress.fit_cases import FitCases

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
    features=replace(SMOKE.features, channels=(4, 4, 4), size=4, every=6),
)
RATES = ("lr_position", "lr_scale", "lr_rotation", "lr_opacity", "lr_colour", "lr_networks")


def fit(config: OccGaussianConfig, training: TrainingSet, ledger: Ledger) -> Any:
    return OccGaussian(config).fit(training, device="cpu", seed=0, ledger=ledger, progress=Progress.silent())


def start(config: OccGaussianConfig, training: TrainingSet) -> Any:
    """Before the fit nobody has looked at the views, so everything asks and nobody answers: grey, as it begins."""
    from ihbench.methods.occgaussian.avatar import OccGaussianAvatar

    return OccGaussianAvatar(config, training.body, 0)


OURS = FitCases("occgaussian", TINY, RATES, fit, start)
PRUNED = replace(TINY, density=replace(TINY.density, faint=1.0), spare_hidden=False)

CASES = [
    *OURS.usual(replace(TINY, weight_network=True), TINY, PRUNED),
    OURS.helps("nobody-to-ask", "no vertex is seen clearly enough to be asked",
               lambda: OURS.ratio(replace(TINY, features=replace(TINY.features, erode=40)))),
]  # fmt: skip
