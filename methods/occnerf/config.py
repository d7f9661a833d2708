"""Every switch of OccNeRF, with the value of the released code (tiangexiang/OccNeRF 1cb1ef3).

Steps count from 1. What `paper` says is what was released for ZJU-MoCap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check

WEIGHT, RATE = Within(0, 1e6), Within(0, 1000)  # of a term of the loss; a learning rate
COUNT = Within(1, 10_000)
RELEASED_STEPS = 100_000
DECAY_STEPS = 500_000  # over which released learning rates fall to a tenth
PIXEL_FINEST = 2048  # corners along a side of the grid's finest lattice, in a metre of the bound


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
    refined: Annotated[int, Within(0, 4096)] = 0
    """Samples of a ray where the first ones met motion weights, instead of them; 0: those of the box are kept."""
    least: Annotated[float, Within(0, 1)] = 1e-3
    """Motion weight below which a place counts as empty and no network is asked. Released: none is left out."""
    neighbour_cell: Annotated[float, Within(0, 1)] = 0.0
    """Side in m of cells whose places share the neighbours of the cell's centre; 0: each has its own, as released."""
    clamp: bool = True
    """Hold the sum of a place's motion weights, by which opacities are multiplied, to at most 1. Released: it may be
    larger where limbs are close, and transmittance negative."""
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
    decoder_code: Annotated[int, COUNT] = 256
    """Length of the learned vector from which motion weights are decoded."""
    decoder_share: Annotated[int, Within(1, 256)] = 1
    """How many times fewer channels than released that decoder has."""
    perceptual: Annotated[float, WEIGHT] = 1.0
    """Weight of LPIPS on patches, or of what stands in for it where its trunk's weights are missing."""
    perceptual_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS."""
    mse: Annotated[float, WEIGHT] = 0.2
    """Weight of the mean squared error on patches."""
    lr: Annotated[float, RATE] = 5e-4
    """Adam's step size of networks and hash grid."""
    lr_displacement: Annotated[float, RATE] = 1e-4
    """Adam's step size of displacements in m."""
    lr_motion: Annotated[float, RATE] = 5e-5
    """Adam's step size of the motion weights."""
    decay_steps: Annotated[int, Within(1, 100 * STEPS)] = DECAY_STEPS
    """Steps in which all step sizes fall to a tenth."""
    clip: Annotated[float, Within(0, 1e9, above=True)] = 1.0
    """Largest norm of the gradient of everything together."""

    def __post_init__(self) -> None:
        check(self, "--method.")


PAPER = OccNerfConfig()
