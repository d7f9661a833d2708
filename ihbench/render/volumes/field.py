"""What the renderer asks of a radiance field: where it may be something, cheaply, and what it is there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from ihbench.render.volumes.rays import Rays


@dataclass(frozen=True)
class FieldValues:
    """A field at M points. A subclass may carry more: it comes back in `fast.Marched.values`."""

    rgb: Tensor  # [M, 3]
    density: Tensor  # [M] 1/m, after the density law
    likelihood: Tensor | None = None  # [M] by which opacities are multiplied; None: 1


class Field(Protocol):
    """A radiance field in the rays' frame.

    A sample's opacity is (1 - exp(-density · length)) · likelihood, so what has a likelihood below a threshold may be
    left out at an error of that size.
    """

    def likelihood(
        self,
        rays: Rays,
        depths: Tensor,  # [N, S]
    ) -> Tensor:
        """[N, S], without gradient, no networks: 0 where the field surely is nothing."""
        ...

    def values(
        self,
        points: Tensor,  # [M, 3] m
    ) -> FieldValues:
        """Differentiable in the field's parameters; any float type."""
        ...
