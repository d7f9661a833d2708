"""Adam over a set of Gaussians: a learning rate and schedule for each attribute, moments that follow their Gaussian.

3DGS and its descendants use eps 1e-15: losses are means over pixels, so gradients of single Gaussians are of 1e-6 and
less, where Adam's usual 1e-8 would already matter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ihbench.clock.checkpoints import Tensors
from ihbench.fit.gaussians.gaussian_set import CARRIED, Gaussians, Rows

MOMENTS = ("exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class Rate:
    """A learning rate: `first`, or from there log-linearly to `last`, over `steps` steps that begin after `hold`."""

    first: float
    last: float | None = None
    steps: int = 1
    hold: int = 0

    def __post_init__(self) -> None:
        if not (self.first >= 0 and self.steps > 0 and (self.last is None or (self.first > 0 and self.last > 0))):
            raise ValueError(f"{self}: expected rates above 0 (a constant one may be 0) and steps above 0")

    def at(self, step: int) -> float:
        if self.last is None:
            return self.first
        share = min(max((step - self.hold) / self.steps, 0.0), 1.0)
        return self.first * (self.last / self.first) ** share


def rates_3dgs(extent: float = 1.0) -> dict[str, Rate]:
    """Rates of 3DGS (graphdeco-inria/gaussian-splatting, arguments/__init__.py) for the attributes that every set
    has; `extent` in m is 1 in GauHuman and OccFusion, 3.4693 in 3DGS-Avatar. Spherical harmonics have 2.5e-3 there,
    those above degree 0 a twentieth of it."""
    return {
        "means": Rate(1.6e-4 * extent, 1.6e-6 * extent, 30_000),
        "log_scales": Rate(5e-3),
        "quaternions": Rate(1e-3),
        "opacity_logits": Rate(0.05),
    }


class GaussianAdam:
    """Optimises all attributes of a set of Gaussians, and is the one who may change which Gaussians there are."""

    def __init__(
        self,
        gaussians: Gaussians,
        rates: Mapping[str, Rate],
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-15,
    ):
        """Raises `ValueError` unless the rates name each attribute."""
        if set(rates) != set(gaussians.attributes):
            wanted, named = (", ".join(sorted(names)) for names in (gaussians.attributes, rates))
            raise ValueError(f"learning rates: expected one for each of {wanted}; got {named}")
        self.gaussians, self.rates = gaussians, dict(rates)
        groups = [{"params": [p], "name": name, "lr": rates[name].at(0)} for name, p in gaussians.attributes.items()]
        self.optimizer = torch.optim.Adam(groups, betas=betas, eps=eps, fused=True)

    def zero_grad(self) -> None:
        self.optimizer.zero_grad(set_to_none=True)

    def step(self, number: int) -> None:
        """Adam's step with the learning rates of step `number`. Attributes without a gradient stay as they are."""
        for group in self.optimizer.param_groups:
            group["lr"] = self.rates[group["name"]].at(number)
        self.optimizer.step()

    @torch.no_grad()
    def rearrange(self, rows: Rows, own: Mapping[str, Tensor] | None = None) -> None:
        """Replace the set. New Gaussians have their source's attributes but for those in `own`, [F, ...] one row for
        each of them, and zero moments; others keep values and moments to the bit. The step count, which Adam has once
        for all rows of an attribute, goes on. Gradients are dropped: before Adam's step that step is lost, as in the
        released systems, after it none is."""
        for group in self.optimizer.param_groups:
            name, (old,) = group["name"], group["params"]
            values = rows.of(old)
            if own and name in own:
                values[rows.fresh] = own[name].to(values)
            new = nn.Parameter(values)
            state = self.optimizer.state.pop(old, None)
            if state:
                self.optimizer.state[new] = state | {key: rows.of(state[key], fresh=0) for key in MOMENTS}
            self._put_parameter(group, new)
        for name, of_new in self.gaussians.of_new.items():
            setattr(self.gaussians, CARRIED + name, rows.of(self.gaussians.carried(name), of_new))

    @torch.no_grad()
    def set_rows(self, name: str, rows: Tensor, values: Tensor | float) -> None:
        """Set an attribute of some rows (a mask [N] or numbers) and forget their moments and gradients: GTU puts its
        original vertices back so (gtu/dataset/scene/gaussian_model.py), and an opacity reset is the same."""
        p = self.gaussians.attributes[name]
        p[rows] = torch.as_tensor(values).to(p)
        state = self.optimizer.state.get(p, {})
        for values_of_rows in (p.grad, *(state.get(key) for key in MOMENTS)):
            if values_of_rows is not None:
                values_of_rows[rows] = 0

    # --- resume ---

    def tensors(self) -> dict[str, Tensor]:
        """Attributes, what is carried, and moments by name; not copies."""
        out = {f"gaussians.{name}": p.detach() for name, p in self.gaussians.attributes.items()}
        out |= {f"carried.{name}": self.gaussians.carried(name) for name in self.gaussians.of_new}
        for name, p in self.gaussians.attributes.items():
            for key, value in self.optimizer.state.get(p, {}).items():
                out[f"adam.{name}.{key}"] = value
        return out

    @torch.no_grad()
    def put(self, tensors: Tensors) -> None:
        """Set everything, the number of Gaussians too, to copies of what `tensors` gave. Other names are passed over;
        raises `ValueError` where one is missing."""
        wanted = [f"gaussians.{name}" for name in self.rates] + [f"carried.{name}" for name in self.gaussians.of_new]
        missing = [name for name in wanted if name not in tensors]
        if missing:
            raise ValueError(f"saved Gaussians: expected {', '.join(missing)}; the state is of another set")
        self.optimizer.state.clear()
        for group in self.optimizer.param_groups:
            name, (old,) = group["name"], group["params"]
            new = nn.Parameter(torch.as_tensor(tensors[f"gaussians.{name}"]).to(old.device, copy=True))
            state = {
                key: torch.as_tensor(tensors[f"adam.{name}.{key}"]).to(old.device, copy=True)
                for key in ("step", *MOMENTS)
                if f"adam.{name}.{key}" in tensors
            }
            if state:
                self.optimizer.state[new] = state
            self._put_parameter(group, new)
        for name in self.gaussians.of_new:
            device = self.gaussians.carried(name).device
            value = torch.as_tensor(tensors[f"carried.{name}"]).to(device, copy=True)
            setattr(self.gaussians, CARRIED + name, value)

    def _put_parameter(self, group: dict[str, object], new: nn.Parameter) -> None:
        group["params"] = [new]
        self.gaussians.attributes[str(group["name"])] = new
