"""Every switch of stage 3 (`--method.refine.*`). Section numbers are the paper's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ihbench.errors import BadInput


@dataclass(frozen=True)
class RefineConfig:
    steps: int = 300
    """Steps of stage 3, one view each; 0 leaves it out."""
    weight: float = 1.0
    """Weight of the whole refinement loss beside stage 1's, which is kept (λ_refine, sec. 3.4)."""
    ssim: float = 0.2
    """Weight of 1 − SSIM over the complete person mask (sec. 3.4)."""
    lpips: float = 0.1
    """Weight of LPIPS over the complete person mask (sec. 3.4). Off, and said so, without its trunk's weights."""
    lpips_net: Literal["vgg", "alex", "squeeze"] = "vgg"
    """Trunk of LPIPS: vgg is the slowest by far, squeeze the fastest."""
    generated: float = 1.0
    """Weight of a generated pixel relative to an original one."""
    background: float = 1.0
    """Weight of the L1 to the background where the complete mask says that a hidden pixel shows no person."""
    networks: bool = False
    """Go on with the decoder and the residual's encoder too. The paper refines the canonical UV maps (sec. 3.4)."""
    lr_share: float = 1.0
    """Step sizes as a share of stage 1's."""
    warm_up: float = 0.1
    """Share of the steps over which step sizes rise: AdamW starts anew, and its first steps would undo stage 1."""

    def __post_init__(self) -> None:
        rules = [
            ("steps", self.steps >= 0, "0 or more"),
            ("lr_share", 0 < self.lr_share < float("inf"), "above 0"),
            ("warm_up", 0 <= self.warm_up <= 1, "0 to 1"),
            ("lpips_net", self.lpips_net in ("vgg", "alex", "squeeze"), "vgg, alex or squeeze"),
        ]
        for name in ("weight", "ssim", "lpips", "generated", "background"):
            rules.append((name, 0 <= getattr(self, name) < float("inf"), "0 or more"))
        for name, holds, expected in rules:
            if not holds:
                raise BadInput(
                    f"--method.refine.{name.replace('_', '-')} {getattr(self, name)!r}: expected {expected}"
                )


QUICK_REFINE = RefineConfig()

PAPER_REFINE = RefineConfig(steps=2000)
