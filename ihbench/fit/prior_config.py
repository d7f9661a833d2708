"""Switches of the smoothness prior (`ihbench.fit.surface_prior`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ihbench.config_fields import Within, check

WEIGHT = Within(0, 1e9)


@dataclass(frozen=True)
class PriorConfig:
    color: Annotated[float, WEIGHT] = 8.0
    """Weight of the squared difference of two neighbours' colours, 0..1 a channel."""
    offset: Annotated[float, WEIGHT] = 8000.0
    """Weight of the squared difference of their offsets from the body in m²."""
    scale: Annotated[float, WEIGHT] = 0.16
    """Weight of the squared difference of their scales' logarithms."""
    views: Annotated[float, Within(0, 1e6)] = 40.0
    """How fast a link's weight falls with the share e of the training views that show both: (1 + views e)^-power."""
    power: Annotated[float, Within(0, 10)] = 2.0
    """The exponent; 0 smooths what is seen as much as what is not."""

    @property
    def on(self) -> bool:
        return self.color > 0 or self.offset > 0 or self.scale > 0

    def __post_init__(self) -> None:
        check(self, "--method.prior.")
