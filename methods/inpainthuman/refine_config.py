"""Every switch of stage 3 (`--method.refine.*`). Section numbers are the paper's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ihbench.config_fields import STEPS, Within, check

WEIGHT = Within(0, 1e6)  # of a term of the loss


@dataclass(frozen=True)
class RefineConfig:
    steps: Annotated[int, Within(0, STEPS)] = 200
    """Steps of stage 3, one view each; 0 leaves it out."""
    weight: Annotated[float, WEIGHT] = 1.0
    """Weight of the whole refinement loss beside stage 1's, which is kept (λ_refine, sec. 3.4)."""
    ssim: Annotated[float, WEIGHT] = 0.2
    """Weight of 1 − SSIM over the complete person mask (sec. 3.4)."""
    lpips: Annotated[float, WEIGHT] = 0.1
    """Weight of LPIPS over the complete person mask (sec. 3.4). Off, and said so, without its trunk's weights."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS: vgg is the slowest by far, squeeze the fastest."""
    generated: Annotated[float, WEIGHT] = 1.0
    """Weight of a generated pixel relative to an original one."""
    background: Annotated[float, WEIGHT] = 1.0
    """Weight of the L1 to the background where the complete mask says that a hidden pixel shows no person."""
    networks: bool = False
    """Go on with the decoder and the residual's encoder too. The paper refines the canonical UV maps (sec. 3.4)."""
    lr_share: Annotated[float, Within(0, 1000, above=True)] = 1.0
    """Step sizes as a share of stage 1's."""
    warm_up: Annotated[float, Within(0, 1)] = 0.1
    """Share of the steps over which step sizes rise: AdamW starts anew, and its first steps would undo stage 1."""

    def __post_init__(self) -> None:
        check(self, "--method.refine.")


QUICK_REFINE = RefineConfig()

PAPER_REFINE = RefineConfig(steps=2000)
