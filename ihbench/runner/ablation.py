"""What of a method is worth its minutes: ladders of configurations, and the runs that they mean.

A method registers ladders under `ihbench.ladders`: name -> `Ladder`. A grid of switches makes one on the spot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from ihbench.config_fields import flat, refuse_repeated, with_fields
from ihbench.errors import BadInput

GRID = "grid"
ROOM = 60  # letters of a rung's name


@dataclass(frozen=True)
class Rung:
    """One configuration: what differs from the profile, and what a paper says of it."""

    name: str
    switches: Mapping[str, Any] = field(default_factory=dict)  # names as `config_fields.flat` has them
    paper: Mapping[str, float] = field(default_factory=dict)  # metric -> the paper's number, in its own units
    keep: tuple[str, ...] = ()  # fields that the plan must not change; "all" for none


@dataclass(frozen=True)
class Comparison:
    """Two rungs of a ladder whose difference is one component."""

    what: str
    without: str
    having: str


@dataclass(frozen=True)
class Ladder:
    """Configurations, and the comparisons between them that say what each component is worth."""

    title: str
    rungs: tuple[Rung, ...]
    comparisons: tuple[Comparison, ...]
    note: str = ""

    def __post_init__(self) -> None:
        names = [rung.name for rung in self.rungs]
        if len(set(names)) < len(names) or not names:
            raise ValueError(f"ladder {self.title}: expected rungs of different names, got {names}")
        for comparison in self.comparisons:
            if not {comparison.without, comparison.having} <= set(names):
                raise ValueError(f"ladder {self.title}: {comparison} compares rungs that it does not have")


def grid(config: Any, vary: Mapping[str, Sequence[Any]]) -> Ladder:
    """All combinations of the values of some switches; every one is compared with the first.

    Raises `BadInput` for a switch that the configuration does not have, one without values, and a value given twice.
    """
    known = flat(config)
    for name, values in vary.items():
        if name not in known:
            raise BadInput(f"--vary {name}: no such switch")
        if not values:
            raise BadInput(f"--vary {name}: expected a value or more")
        refuse_repeated(values, f"--vary {name}")
    combinations = product(*vary.values())
    grids = [dict(zip(vary, values, strict=True)) for values in combinations]
    rungs = [Rung(name, switches) for name, switches in zip(_names(grids), grids, strict=True)]
    first = rungs[0].name
    comparisons = tuple(Comparison(f"{rung.name} instead of {first}", first, rung.name) for rung in rungs[1:])
    return Ladder(", ".join(vary), tuple(rungs), comparisons)


def _names(grids: Sequence[Mapping[str, Any]]) -> list[str]:
    """One name a combination: what varies, cut to `ROOM`, with a number where that would make two alike."""
    several = [name for name in grids[0] if len({_plain(switches[name]) for switches in grids}) > 1] or list(grids[0])
    words = [", ".join(f"{name}={_plain(switches[name])}" for name in several) for switches in grids]
    if all(len(text) <= ROOM for text in words):
        return words
    return [text if len(text) <= ROOM else f"{k + 1}: {text[: ROOM - 1]}…" for k, text in enumerate(words)]


def kept(ladder: Ladder, rung: Rung, config: Any) -> tuple[str, ...]:
    """Fields that the plan must leave as the rung has them: its own, and those by which rungs of the ladder differ,
    as far as the rung has them at the profile's value (what differs from the profile stays anyway)."""
    if any(other.keep for other in ladder.rungs):
        return rung.keep  # a ladder about the plan itself
    own, base = flat(configured(rung, config)), flat(config)
    set_by_any = sorted({name for other in ladder.rungs for name in other.switches})
    return tuple(name for name in set_by_any if own[name] == base[name])


def _plain(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def configured(rung: Rung, config: Any) -> Any:
    """The profile's configuration with a rung's switches. Raises `BadInput` for unknown ones."""
    known = flat(config)
    for name in rung.switches:
        if name not in known:
            raise BadInput(f"rung {rung.name!r}: the method has no switch {name!r}")
    return with_fields(config, rung.switches)


def set_on_all(ladder: Ladder, switches: Mapping[str, Any]) -> Ladder:
    """The ladder with further switches on every rung, where a rung does not set them itself."""
    rungs = tuple(replace(rung, switches={**switches, **rung.switches}) for rung in ladder.rungs)
    return replace(ladder, rungs=rungs)


def shared_part(config: Any, free: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """The fields that a saved state depends on: all but those whose names begin with one of `free`."""
    return tuple((name, value) for name, value in flat(config).items() if not name.startswith(tuple(free)))
