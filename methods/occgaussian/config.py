"""Every switch of OccGaussian. Of its paper only the abstract could be read, so all that it has beside GauHuman's
base is inferred; METHOD.md has the reasons. Steps count from 1."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.fit.big_pose.config import RATE, WEIGHT, BigPoseConfig, in_steps
from ihbench.fit.big_pose.plan import parts_of_no_use
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

GAUHUMAN_STEPS = 1200
SIZE, SHARE = Within(1, 4096), Within(0, 1)
FEATURE_SHARE = 0.4  # of a step's time, estimated


@dataclass(frozen=True)
class FeatureConfig:
    """What the training views show of each vertex, as features."""

    on: bool = True
    """Off, it is GauHuman that leaves hidden pixels alone: no feature, no query, no band."""
    channels: tuple[Annotated[int, SIZE], Annotated[int, SIZE], Annotated[int, SIZE]] = (16, 32, 32)
    """Of the encoder's three convolutions, whose maps have 1, 1/2 and 1/4 of the image's size."""
    size: Annotated[int, SIZE] = 32
    """Numbers in a feature."""
    erode: Annotated[int, Within(0, 1000)] = 2
    """Person pixels nearer than this to another pixel show no vertex: their features would contain background."""
    facing: Annotated[float, SHARE] = 0.1
    """Smallest cosine between a vertex's face and the direction to the camera at which a view shows it."""
    slack: Annotated[float, Within(0, 1e3)] = 0.02
    """How far in m behind the nearest surface a vertex may be and count as it."""
    every: Annotated[int, Within(1, STEPS)] = 50
    """Steps between two readings of the key views."""
    key_views: Annotated[int, Within(0, 1_000_000)] = 0
    """Training views, evenly spaced, that features are read from and sightings are counted in; 0: all."""
    lr: Annotated[float, RATE] = 1e-3
    """Adam's step size of encoder and decoder, …"""
    lr_last: Annotated[float, RATE] = 1e-4
    """… which falls log-linearly to this."""


@dataclass(frozen=True)
class QueryConfig:
    """What a hidden vertex asks of seen ones."""

    neighbours: Annotated[int, Within(1, 256)] = 10
    """Nearest seen vertices that are asked (the number of OccNeRF)."""
    same_part: bool = True
    """Only those of the same body part or of one beside it."""
    sigma: Annotated[float, Within(0, 1e3, above=True)] = 0.03
    """In m: weights fall with the distance d in the big pose as exp(-d² / 2σ²), and rise with ln(1 + sightings)."""


@dataclass(frozen=True)
class DecoderConfig:
    """From features to a Gaussian's attributes."""

    depth: Annotated[int, Within(1, 64)] = 4
    """Hidden layers."""
    width: Annotated[int, SIZE] = 128
    """Of each."""
    octaves: Annotated[int, Within(0, 32)] = 6
    """Frequencies of the position's encoding."""
    last: Annotated[float, Within(0, 1e3)] = 1e-5
    """Bound of the last layer's first weights: a fit begins as GauHuman's."""


@dataclass(frozen=True)
class BandConfig:
    """Hidden on purpose, so that queries are trained."""

    least: Annotated[float, SHARE] = 0.2
    """Smallest share of the visible person's pixels that a vertical band hides from the encoder, …"""
    most: Annotated[float, SHARE] = 0.5
    """… and the largest."""
    every: Annotated[int, Within(1, STEPS)] = 1
    """Steps from one with a band to the next."""
    weight: Annotated[float, WEIGHT] = 1.0
    """Of the mean L1 on the band. 0: no band."""


@dataclass(frozen=True)
class OccGaussianConfig(BigPoseConfig):
    unknown: Literal["background", "ignore"] = "ignore"
    """What a hidden pixel is taken for: nothing is known there, or (two states) background, as GauHuman does."""
    steps: Annotated[int, Within(1, STEPS)] = 3000
    """Optimisation steps, one training view each."""
    white_reset: Annotated[int, Within(0, STEPS)] = 400
    """After this step opacities are set to .01 at most if the person stands on white; 0 never."""
    sh_degree: Annotated[int, Within(0, 3)] = 0
    """Highest degree of the spherical harmonics."""
    mask: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean squared error of alpha in the box, where pixels are known."""
    ssim: Annotated[float, WEIGHT] = 0.01
    """Weight of 1 - SSIM there."""
    lpips: Annotated[float, WEIGHT] = 0.01
    """Weight of LPIPS. Off, and said so, without its trunk's weights."""
    complete: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean of (1 - alpha)² over hidden pixels that the posed body covers."""
    smooth: Annotated[float, WEIGHT] = 0.1
    """Weight of the mean difference of a queried colour from those that it was asked of."""
    spare_hidden: bool = True
    """Gaussians on vertices that are hidden more often than seen, or never seen, are not pruned."""
    features: FeatureConfig = field(default_factory=FeatureConfig)
    query: QueryConfig = field(default_factory=QueryConfig)
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    band: BandConfig = field(default_factory=BandConfig)

    @property
    def last_step(self) -> int:
        return self.steps

    @property
    def colours(self) -> str:
        """Where colours are compared (`fit.big_pose.target`)."""
        return "everywhere"

    @property
    def silhouette(self) -> str:
        """What alpha is held to there."""
        return "visible"

    @property
    def two_state(self) -> bool:
        return self.unknown == "background"

    def __post_init__(self) -> None:
        check(self, "--method.")


PAPER = OccGaussianConfig()
# LPIPS through VGG would take three times as long as all the rest of a step, at a weight of .01
ON_A_CPU = OccGaussianConfig(
    lpips=0.0,
    least_px=1.0,
    nearest_every=10,
    steps=GAUHUMAN_STEPS,
    features=FeatureConfig(every=100),
    decoder=DecoderConfig(depth=2, width=64),
    band=BandConfig(every=2),
)


def fewer(config: OccGaussianConfig, steps: int, faster: float) -> OccGaussianConfig:
    """The schedule in fewer steps (`in_steps`)."""
    share = steps / config.steps
    return in_steps(config, share, faster, steps=steps, white_reset=round(config.white_reset * share))


QUICK = fewer(ON_A_CPU, 600, 2.0)
SMOKE = replace(
    fewer(ON_A_CPU, 60, 10.0),
    lr_position=8e-4,
    lr_scale=2e-2,
    features=FeatureConfig(channels=(8, 16, 16), size=16, erode=0, every=20, lr=1e-2, lr_last=2e-3),
    decoder=DecoderConfig(depth=2, width=32),
    band=BandConfig(),
)
PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: OccGaussianConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    out = parts_of_no_use(config, scene, ("fit/gaussians",))
    if config.features.on and scene.hidden_share == 0:
        reason = "nothing is hidden: no Gaussian has anything to ask"
        out.append(Omission("features.on", False, reason, {"fit/gaussians": FEATURE_SHARE}))
    return out


def outside_files(config: OccGaussianConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, whose term is off while the file is not there."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
