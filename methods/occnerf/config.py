"""Every switch of OccNeRF, with the value of the released code (tiangexiang/OccNeRF 1cb1ef3).

Steps count from 1. What `paper` says is what was released for ZJU-MoCap.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check
from ihbench.metrics.weights import FILES, locate
from ihbench.scene.plan import Omission, SceneMeasure

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
COUNT = Within(1, 10_000)
RELEASED_STEPS = 100_000
DECAY_STEPS = 500_000  # over which released learning rates fall to a tenth
COUNTING_SHARE = 0.04  # of a step's time, measured with the quick profile


@dataclass(frozen=True)
class OccNerfConfig:
    unknown: Literal["background", "ignore"] = "background"
    """What a hidden pixel is taken for. As released, which knows two states: background, in this step's random
    colour. With ignore no patch begins there and no term of the loss looks there."""
    steps: Annotated[int, Within(1, STEPS)] = RELEASED_STEPS
    """Optimisation steps, patches of one training view each."""
    patches: Annotated[int, COUNT] = 6
    """Patches of a step."""
    patch_px: Annotated[int, Within(4, 1024)] = 32
    """Their side."""
    samples: Annotated[int, Within(2, 4096)] = 128
    """Samples of a ray between the faces of the person's box."""
    inside: Annotated[int, Within(0, 4096)] = 0
    """While fitting, samples of a second pass between the first and the last of them that is not empty; 0: none."""
    least: Annotated[float, Within(0, 1)] = 1e-3
    """Samples less likely than this to be of the person are empty and no network sees them. A pixel is off by at most
    their sum; 0 as released."""
    least_weight: Annotated[float, Within(0, 1)] = 1e-4
    """A bone is asked only inside the box beyond which its weights are all under this; 0 as released."""
    stop: Annotated[float, Within(0, 1)] = 1e-3
    """When drawing, rays that let through less than this are done; 0 as released."""
    neighbour_cell: Annotated[float, Within(0, 1)] = 0.0
    """Side in m of cells whose places share the neighbours of the cell's centre; 0: each has its own, as released."""
    clamp: bool = True
    """Hold likelihoods at 1 or under: where two limbs are close they sum to more, and a ray would let through a
    negative share. Not so in the released code."""
    completeness: Literal["released", "body", "off"] = "released"
    """Whose density the completeness prior asks for: that of every sample inside the body, or, as released, also of
    every sample without motion weights, which the warp drops onto the origin, inside the torso."""
    completeness_weight: Annotated[float, WEIGHT] = 1.0
    """Its weight."""
    visibility: bool = True
    """Count which vertices end rays, and borrow more from those that end many."""
    displacement: Literal["released", "normal"] = "released"
    """Where learned displacements move vertices: by the same amount along x, y and z, as released, or along their
    normals."""
    levels: Annotated[int, Within(1, 32)] = 16
    """Levels of the hash grid."""
    hash_size: Annotated[int, Within(4, 24)] = 19
    """Binary logarithm of its rows a level."""
    hash_finest: Annotated[int, Within(16, 1_000_000)] = 2048
    """Cells of its finest lattice in a metre of the canonical box's half side; the coarsest has 16 altogether."""
    width: Annotated[int, COUNT] = 256
    """Width of the hidden layers of both networks."""
    depth: Annotated[int, Within(1, 100)] = 4
    """How many hidden layers each has."""
    weight_code: Annotated[int, COUNT] = 256
    """Numbers of the learned vector that the motion weights are decoded from."""
    weight_channels: Annotated[int, Within(8, 4096)] = 1024
    """Channels of their decoder's first layer; a half, a half, a quarter and a quarter in the next ones."""
    lpips: Annotated[float, WEIGHT] = 1.0
    """Weight of the perceptual distance of patches: LPIPS where its trunk's weights are, else `without_lpips`."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    mse: Annotated[float, WEIGHT] = 0.2
    """Weight of the mean squared error on patches."""
    without_lpips: Literal["pyramid", "none"] = "pyramid"
    """What takes its place where the weights are missing, and the record says so: absolute differences over bands of
    a pyramid, or nothing."""
    lr: Annotated[float, RATE] = 5e-4
    """Adam's step size of both networks."""
    lr_grid: Annotated[float, RATE] = 5e-4
    """Adam's step size of the hash grid."""
    lr_displacement: Annotated[float, RATE] = 1e-4
    """Adam's step size of displacements in m."""
    lr_motion: Annotated[float, RATE] = 5e-5
    """Adam's step size of the motion weights."""
    second_moment: Annotated[float, Within(0, 0.9999)] = 0.999
    """Adam's decay of squared gradients."""
    decay_steps: Annotated[int, Within(1, 100 * STEPS)] = DECAY_STEPS
    """Steps in which all step sizes fall to a tenth."""
    clip: Annotated[float, Within(0, 1e9, above=True)] = 1.0
    """Largest norm of the gradient of everything together."""

    def __post_init__(self) -> None:
        check(self, "--method.")


PAPER = OccNerfConfig()
ON_A_CPU = replace(
    PAPER,
    patches=2,
    inside=16,
    least=5e-3,
    neighbour_cell=0.01,
    completeness="body",
    levels=8,
    hash_size=15,
    hash_finest=512,
    width=64,
    depth=3,
    weight_code=64,
    weight_channels=128,
    second_moment=0.99,
)
QUICK = replace(ON_A_CPU, steps=400, decay_steps=400, lr=4e-3, lr_grid=2e-2, lr_motion=5e-3)
SMOKE = replace(
    ON_A_CPU,
    steps=60,
    patch_px=16,
    samples=64,
    levels=5,
    hash_size=12,
    hash_finest=128,
    width=32,
    depth=2,
    weight_code=32,
    weight_channels=64,
    neighbour_cell=0.02,
    decay_steps=60,
    lr=5e-3,
    lr_grid=2e-2,
    lr_motion=1e-3,
)

PROFILES = {"smoke": SMOKE, "quick": QUICK, "paper": PAPER}


def leave_out(config: OccNerfConfig, scene: SceneMeasure) -> list[Omission]:
    """What this scene does not need of this configuration (see `ihbench.scene.plan`)."""
    if config.visibility and scene.covered_views == 0:
        reason = "no occluder: nothing is seen less often than what faces the camera less often"
        return [Omission("visibility", False, reason, {"fit/field": COUNTING_SHARE})]
    return []


def outside_files(config: OccNerfConfig) -> list[Path]:
    """Files whose content affects the answer: the trunk of LPIPS, in whose place another distance stands while the
    file is not there."""
    trunk = locate(FILES[f"lpips-{config.lpips_net}"]) if config.lpips > 0 else None
    return [trunk] if isinstance(trunk, Path) else []
