"""What density control gathers of each Gaussian between two changes of the set: screen gradients and radii.

As released by 3DGS (cuda_rasterizer/backward.cu, scene/gaussian_model.py): the gradient of the loss with respect to
the projected centre in units of half an image, only along the path through that centre; its norm summed over the
steps in which the Gaussian has a radius, drawn in front of others or not, and divided by their number.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ihbench.clock.checkpoints import Tensors
from ihbench.fit.gaussians.gaussian_set import Rows

NAME = "density."  # before the names of saved tensors


@dataclass
class DensityState:
    """Of N Gaussians. Restored from a saved state it goes on to the bit."""

    gradient_sum: Tensor  # [N] float64
    steps: Tensor  # [N] int64 with a radius
    radius: Tensor  # [N] float32 px, the largest
    refused: Tensor  # [1] int64: gradients that were not finite and were not counted, in all

    @classmethod
    def none(cls, count: int, device: torch.device | str = "cpu") -> DensityState:
        return cls(
            torch.zeros(count, dtype=torch.float64, device=device),
            torch.zeros(count, dtype=torch.int64, device=device),
            torch.zeros(count, device=device),
            torch.zeros(1, dtype=torch.int64, device=device),
        )

    def __len__(self) -> int:
        return len(self.radius)

    @torch.no_grad()
    def add(
        self,
        gradient: Tensor,  # [N, 2] px: ∂L/∂u, u the projected centre in px, of one image
        radius: Tensor,  # [N] px, 0 where nothing of the Gaussian can be on the image
        width: int,  # px of the image
        height: int,
    ) -> None:
        """Count one step. A gradient or radius that is not finite leaves its Gaussian out of that step.
        Raises `ValueError` for arrays of another length."""
        if tuple(gradient.shape) != (len(self), 2) or tuple(radius.shape) != (len(self),):
            shapes = f"{tuple(gradient.shape)} and {tuple(radius.shape)}"
            raise ValueError(
                f"screen gradient and radius: expected ({len(self)}, 2) and ({len(self)},), got {shapes}"
            )
        half = torch.tensor([width / 2, height / 2], dtype=torch.float64, device=gradient.device)
        norm = (gradient.double() * half).norm(dim=1)
        finite = norm.isfinite() & radius.isfinite()
        counts = finite & (radius > 0)
        self.gradient_sum += torch.where(counts, norm, 0.0)
        self.steps += counts
        self.radius = torch.maximum(self.radius, torch.where(counts, radius, 0.0).to(self.radius))
        self.refused += (~finite).sum()

    def mean(self) -> Tensor:
        """[N] float64: the mean norm; 0 for a Gaussian without a counted step."""
        return self.gradient_sum / self.steps.clamp(min=1)

    def rearrange(self, rows: Rows) -> None:
        """Follow a change of the set; nothing is known of new Gaussians."""
        self.gradient_sum = rows.of(self.gradient_sum, fresh=0)
        self.steps = rows.of(self.steps, fresh=0)
        self.radius = rows.of(self.radius, fresh=0)

    def clear(self) -> None:
        """Begin anew."""
        for each in (self.gradient_sum, self.steps, self.radius):
            each.zero_()

    def tensors(self) -> dict[str, Tensor]:
        """By name; not copies."""
        return {NAME + field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def of(cls, tensors: Tensors, device: torch.device | str = "cpu") -> DensityState:
        """From copies of what `tensors` gave; other names are passed over. Raises `ValueError` if one is missing."""
        missing = [field.name for field in fields(cls) if NAME + field.name not in tensors]
        if missing:
            raise ValueError(f"saved density state: {', '.join(missing)} missing; the state is of another fit")
        return cls(*(torch.as_tensor(tensors[NAME + field.name]).to(device, copy=True) for field in fields(cls)))
