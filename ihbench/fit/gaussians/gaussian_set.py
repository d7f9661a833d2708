"""A set of anisotropic Gaussians whose number may change: what is learned of each, and what each carries along."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from ihbench.fit.gaussians.neighbours import spacing

SHAPES = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": ()}
OPACITY_ENDS = 1e-6  # opacities are kept this far from 0 and 1 when their logit is taken
CARRIED = "carried_"  # before the names of buffers


@dataclass(frozen=True)
class Carried:
    """Something that each Gaussian has and that is not learned, such as skinning weights or a parent vertex."""

    values: Tensor  # [N, ...]
    of_new: float | None = None  # what a new Gaussian has; None: what its parent has


@dataclass(frozen=True)
class Rows:
    """How rows of a changed set come from those of the old one."""

    source: Tensor  # [M] int64 the old row
    fresh: Tensor  # [M] bool: a new Gaussian, made from its source; else the source itself

    @classmethod
    def made(
        cls,
        keep: Tensor,  # [N] bool
        parents: Tensor,  # [F] int64
    ) -> Rows:
        """Old rows that are kept, in their order, and behind them one new row for each parent."""
        kept = keep.nonzero()[:, 0]
        fresh = torch.zeros(len(kept) + len(parents), dtype=torch.bool, device=keep.device)
        fresh[len(kept) :] = True
        return cls(torch.cat([kept, parents]), fresh)

    def of(self, values: Tensor, fresh: float | None = None) -> Tensor:
        """Values [N, ...] of the old rows as [M, ...] of the new ones; those of new Gaussians, unless it is None,
        `fresh`."""
        out = values.detach()[self.source]
        if fresh is not None:
            out[self.fresh] = fresh
        return out


class Gaussians(nn.Module):
    """Learned: `means`, `log_scales`, `quaternions` (w, x, y, z), `opacity_logits`, and whatever `more` names
    (spherical harmonics, features), all in `attributes`. Carried along: buffers by name.

    Parameters are replaced, not resized, when the set changes: take them from here at each step.
    """

    def __init__(
        self,
        means: Tensor,  # [N, 3] m, canonical
        log_scales: Tensor,  # [N, 3] ln m
        quaternions: Tensor,  # [N, 4] w first, of any length
        opacity_logits: Tensor,  # [N]
        more: Mapping[str, Tensor] | None = None,  # each [N, ...]
        carried: Mapping[str, Tensor | Carried] | None = None,  # each [N, ...]
    ):
        """Raises `ValueError` for no Gaussian at all, other shapes, and names that are taken."""
        super().__init__()
        given = (means, log_scales, quaternions, opacity_logits)
        learned = dict(zip(SHAPES, given, strict=True))
        for name, values in (more or {}).items():
            if name in learned or not name.isidentifier():
                raise ValueError(
                    f"Gaussians: attribute {name!r}: expected an identifier other than {', '.join(SHAPES)}"
                )
            learned[name] = values
        for name, values in learned.items():
            expected = (len(means), *SHAPES.get(name, values.shape[1:]))
            if tuple(values.shape) != expected or not len(means):
                raise ValueError(
                    f"Gaussians: {name}: expected {expected}, at least one row, got {tuple(values.shape)}"
                )
        self.attributes = nn.ParameterDict({name: nn.Parameter(v.detach().clone()) for name, v in learned.items()})
        self.of_new: dict[str, float | None] = {}
        for name, its in (carried or {}).items():
            its = its if isinstance(its, Carried) else Carried(its)
            if len(its.values) != len(means):
                raise ValueError(f"Gaussians: carried {name}: expected {len(means)} rows, got {len(its.values)}")
            self.of_new[name] = its.of_new
            self.register_buffer(CARRIED + name, its.values.detach().clone())

    @classmethod
    def on(
        cls,
        points: Tensor,  # [N, 3] m
        opacity: float = 0.1,
        more: Mapping[str, Tensor] | None = None,
        carried: Mapping[str, Tensor | Carried] | None = None,
    ) -> Gaussians:
        """Round ones as large as the points are apart (`neighbours.spacing`), as 3DGS and its descendants start."""
        n = len(points)
        quaternions = points.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4)
        logits = to_logit(points.new_full((n,), opacity))
        return cls(points, spacing(points).log()[:, None].expand(n, 3), quaternions, logits, more, carried)

    def saved(self, tensors: Mapping[str, Tensor], prefix: str = "") -> Gaussians:
        """A set of these attributes, of any number, from the state dictionary of one whose names begin with `prefix`.
        Raises `KeyError` for one that is missing."""
        learned = {name: tensors[f"{prefix}attributes.{name}"] for name in self.attributes}
        carried = {name: Carried(tensors[prefix + CARRIED + name], of_new) for name, of_new in self.of_new.items()}
        means, log_scales, quaternions, opacity_logits = (learned.pop(name) for name in SHAPES)
        return Gaussians(means, log_scales, quaternions, opacity_logits, learned, carried)

    def __len__(self) -> int:
        return len(self.attributes["means"])

    @property
    def means(self) -> Tensor:  # [N, 3] m
        return self.attributes["means"]

    @property
    def log_scales(self) -> Tensor:  # [N, 3] ln m
        return self.attributes["log_scales"]

    @property
    def scales(self) -> Tensor:  # [N, 3] m
        return self.attributes["log_scales"].exp()

    @property
    def quaternions(self) -> Tensor:  # [N, 4] w first
        return self.attributes["quaternions"]

    @property
    def opacity_logits(self) -> Tensor:  # [N]
        return self.attributes["opacity_logits"]

    @property
    def opacities(self) -> Tensor:  # [N] 0..1
        return self.attributes["opacity_logits"].sigmoid()

    def carried(self, name: str) -> Tensor:
        """[N, ...] what each Gaussian carries under this name."""
        return self.get_buffer(CARRIED + name)

    def broken(self) -> Tensor:
        """[N] bool: some attribute is not finite. An infinite opacity logit is no breakage: an opacity of 0 or 1."""
        bad = self.opacity_logits.detach().isnan()
        for name, values in self.attributes.items():
            if name != "opacity_logits":
                bad = bad | ~values.detach().isfinite().flatten(1).all(1)
        return bad


def to_logit(
    opacity: Tensor,  # 0..1
) -> Tensor:
    """The logit, finite at both ends."""
    return torch.logit(opacity.clamp(OPACITY_ENDS, 1 - OPACITY_ENDS))
