"""What of a method is worth its minutes: suites of configurations, and the runs that they mean.

A method registers suites in its spec (`MethodSpec.ablations`): name -> `AblationSuite`. A grid of switches
makes one on the spot.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

from ihbench.config_fields import flat, refuse_repeated, with_fields
from ihbench.errors import BadInput

GRID = "grid"
ROOM = 60  # letters of a variant's name


@dataclass(frozen=True)
class Variant:
    """One configuration: what differs from the profile, and what a paper says of it."""

    name: str
    switches: Mapping[str, Any] = field(default_factory=dict)  # names as `config_fields.flat` has them
    paper: Mapping[str, float] = field(default_factory=dict)  # metric -> the paper's number, in its own units
    keep: tuple[str, ...] = ()  # fields that the plan must not change; "all" for none


@dataclass(frozen=True)
class Comparison:
    """Two variants of a suite whose difference is one component."""

    what: str
    without: str
    having: str


@dataclass(frozen=True)
class AblationSuite:
    """Configurations, and the comparisons between them that say what each component is worth."""

    title: str
    variants: tuple[Variant, ...]
    comparisons: tuple[Comparison, ...]
    note: str = ""

    def __post_init__(self) -> None:
        names = [variant.name for variant in self.variants]
        if len(set(names)) < len(names) or not names:
            raise ValueError(f"ladder {self.title}: expected rungs of different names, got {names}")
        for comparison in self.comparisons:
            if not {comparison.without, comparison.having} <= set(names):
                raise ValueError(f"ladder {self.title}: {comparison} compares rungs that it does not have")


def grid(config: Any, vary: Mapping[str, Sequence[Any]]) -> AblationSuite:
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
    grids = [dict(zip(vary, values, strict=True)) for values in product(*vary.values())]
    variants = [Variant(name, switches) for name, switches in zip(_names(grids), grids, strict=True)]
    first = variants[0].name
    comparisons = tuple(Comparison(f"{one.name} instead of {first}", first, one.name) for one in variants[1:])
    return AblationSuite(", ".join(vary), tuple(variants), comparisons)


def _names(grids: Sequence[Mapping[str, Any]]) -> list[str]:
    """One name a combination: what varies, cut to `ROOM`, with a number where that would make two alike."""
    several = [name for name in grids[0] if len({_plain(switches[name]) for switches in grids}) > 1] or list(grids[0])
    words = [", ".join(f"{name}={_plain(switches[name])}" for name in several) for switches in grids]
    return [text if len(text) <= ROOM else f"{k + 1}: {text[: ROOM - 1]}…" for k, text in enumerate(words)]


def kept(suite: AblationSuite, variant: Variant, config: Any) -> tuple[str, ...]:
    """Fields that the plan must leave as the variant has them: its own, and those by which variants of the suite
    differ, as far as the variant has them at the profile's value (what differs from the profile stays anyway)."""
    if any(other.keep for other in suite.variants):
        return variant.keep  # a suite about the plan itself
    own, base = flat(configured(variant, config)), flat(config)
    set_by_any = sorted({name for other in suite.variants for name in other.switches})
    return tuple(name for name in set_by_any if own[name] == base[name])


def _plain(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, tuple) else str(value)


def configured(variant: Variant, config: Any) -> Any:
    """The profile's configuration with a variant's switches. Raises `BadInput` for unknown ones."""
    known = flat(config)
    for name in variant.switches:
        if name not in known:
            raise BadInput(f"rung {variant.name!r}: the method has no switch {name!r}")
    return with_fields(config, variant.switches)


def set_on_all(suite: AblationSuite, switches: Mapping[str, Any]) -> AblationSuite:
    """The suite with further switches on every variant, where a variant does not set them itself."""
    variants = tuple(replace(variant, switches={**switches, **variant.switches}) for variant in suite.variants)
    return replace(suite, variants=variants)


def shared_part(config: Any, free: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """The fields that a saved state depends on: all but those whose names begin with one of `free`."""
    return tuple((name, value) for name, value in flat(config).items() if not name.startswith(tuple(free)))
