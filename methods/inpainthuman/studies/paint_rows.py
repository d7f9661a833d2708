"""The painters that `ihbench paint` compares."""

from __future__ import annotations

FILLS = ("mean", "telea", "navier-stokes", "push-pull", "mirror", "temporal")
# row -> which of ti, lora and sg are on
DIFFUSION: dict[str, tuple[bool, bool, bool]] = {
    "generic": (False, False, False),
    "generic+sg": (False, False, True),
    "ti": (True, False, False),
    "ti+lora": (True, True, False),
    "ti+lora+sg": (True, True, True),
}
ROWS = (*FILLS, *DIFFUSION)
FULL = "ti+lora+sg"
