"""What happens in a run besides the passing of time: typed, so that any method may note it and any report read it.

A method may note events of its own: frozen dataclasses with a `kind` of their own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, Protocol


class Happening(Protocol):
    """A frozen dataclass. Fields that are None are left out of the record."""

    kind: ClassVar[str]


@dataclass(frozen=True)
class Event:
    """Something that happened, as the record has it, with both clocks."""

    kind: str
    fit_seconds: float = 0.0  # s of the fit clock
    seconds: float = 0.0  # s of all wall time of the run
    data: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def at(cls, happening: Happening, fit_seconds: float, seconds: float) -> Event:
        data = {name: value for name, value in vars(happening).items() if value is not None}
        return cls(happening.kind, fit_seconds, seconds, data)

    @classmethod
    def of(cls, row: Mapping[str, Any]) -> Event:
        """From what `vars` made; fields of another version are passed over."""
        return cls(**{own.name: row[own.name] for own in fields(cls) if own.name in row})


@dataclass(frozen=True)
class Warned:
    kind: ClassVar[str] = "warning"
    what: str


@dataclass(frozen=True)
class LeftOut:
    kind: ClassVar[str] = "left_out"
    what: str
    reason: str


@dataclass(frozen=True)
class Resumed:
    """A stage went on from its saved state."""

    kind: ClassVar[str] = "resumed"
    stage: str  # name of the saved state
    step: int


@dataclass(frozen=True)
class Reused:
    """A saved state was taken from another run; its seconds count here as well."""

    kind: ClassVar[str] = "shared"
    state: str
    run: str  # digest


@dataclass(frozen=True)
class RolledBack:
    """A fit went back to an earlier step."""

    kind: ClassVar[str] = "rolled_back"
    stage: str
    step: int  # that it went back to
    what: str
    bad_step: int | None = None


@dataclass(frozen=True)
class DivergedAt:
    kind: ClassVar[str] = "diverged"
    step: int
    reason: str


@dataclass(frozen=True)
class LossCurve:
    kind: ClassVar[str] = "loss_curve"
    stage: str
    steps: Sequence[int]
    losses: Sequence[float]


@dataclass(frozen=True)
class Inpainted:
    """A method has painted what the training views do not show."""

    kind: ClassVar[str] = "inpainted"
    views: int  # painted
    of: int  # training views
    pixels: int  # painted
    identity_drift: Mapping[str, Any]  # delta_e, delta_e_floor, texture, texture_floor: painted against seen surface
    flicker: Mapping[str, Any]  # deviation, deviation_floor: of painted surface over views
