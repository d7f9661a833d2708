"""Runs as configurations, and the sweeps among them: configurations that differ in one number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ihbench.config_fields import Values
from ihbench.record.results import RunResult
from ihbench.record.schema import value_text
from ihbench.reports.general.clock import by_machine

IMAGE_SIZE = "image size"
PROFILE = "profile"


@dataclass(frozen=True)
class Configuration:
    """The runs (scenes, seeds) of one row."""

    label: str
    method: str
    changed: Mapping[str, str]  # switch -> value as text, of those that differ from the profile
    settings: Mapping[str, Any]  # every switch -> value that was in force, names dotted; None where runs differ
    runs: tuple[RunResult, ...]


@dataclass(frozen=True)
class Sweep:
    """Configurations of one method along one switch, everything else equal, in the order of its value."""

    axis: str
    fixed: Mapping[str, str]  # what else differs from the profile
    members: tuple[tuple[Any, Configuration], ...]  # value of the switch, configuration

    @property
    def label(self) -> str:
        others = ", ".join(f"{name}={value}" for name, value in self.fixed.items())
        return f"{self.members[0][1].method}{f' ({others})' if others else ''}: {self.axis}"


def configurations(runs: Sequence[RunResult], across: bool = False) -> list[Configuration]:
    """One for each row of the tables of seconds. With `across`, runs of several profiles and image sizes stand side
    by side, and these count as switches."""
    groups: dict[str, list[RunResult]] = by_machine(runs)
    configurations = []
    for label, group in groups.items():
        parts: dict[tuple[str, ...], list[RunResult]] = {}
        for run in group:
            parts.setdefault((run.identity.profile, run.identity.protocol) if across else (), []).append(run)
        for part in parts.values():
            first = part[0]
            changed = {name: value_text(name, value) for name, value in (first.about.changed or {}).items()}
            settings = first.identity.switches | _in_force(part)
            name = label
            if across:
                size = first.about.image_size
                settings |= {PROFILE: first.identity.profile, IMAGE_SIZE: size}
                changed[PROFILE] = first.identity.profile
                if "size" in first.identity.changes:
                    changed[IMAGE_SIZE] = str(size)
                name += f" [{first.identity.profile}, {size} px]"
            configurations.append(Configuration(name, first.method, changed, settings, tuple(part)))
    return configurations


def sweeps(configs: Sequence[Configuration]) -> list[Sweep]:
    """Every set of at least two configurations of one method that differ in one switch with numbers as values.

    A configuration without the switch among its changes takes part with the profile's value.
    """
    sweeps = []
    for method in dict.fromkeys(c.method for c in configs):
        mine = [c for c in configs if c.method == method]
        for axis in dict.fromkeys(name for c in mine for name in c.changed):
            families: dict[tuple[tuple[str, str], ...], list[Configuration]] = {}
            for c in mine:
                others = tuple(sorted((name, value) for name, value in c.changed.items() if name != axis))
                families.setdefault(others, []).append(c)
            for others, family in families.items():
                valued = [(c.settings.get(axis), c) for c in family]
                if not any(axis in c.changed for c in family) or any(_rank(value) is None for value, _ in valued):
                    continue
                valued.sort(key=lambda pair: _rank(pair[0]) or ())
                if len({_rank(value) for value, _ in valued}) >= 2:
                    sweeps.append(Sweep(axis, dict(others), tuple(valued)))
    return sweeps


def short_value(value: Any) -> str:
    """A switch's value as a diagram shows it."""
    return "+".join(f"{part:g}" for part in value) if isinstance(value, list | tuple) else f"{value:g}"


def _rank(value: Any) -> tuple[float, ...] | None:
    """How values of a switch are ordered: numbers by size, lists of numbers by length, then content; None for what
    has no order."""
    if isinstance(value, bool):
        return None
    if isinstance(value, int | float):
        return (float(value),)
    if isinstance(value, list | tuple) and value and all(_rank(part) is not None for part in value):
        return (float(len(value)), *(float(part) for part in value))
    return None


def _in_force(runs: Sequence[RunResult]) -> Values:
    """Switches that the plan has changed -> value; None where not all runs have the same."""
    first, *others = [run.planned for run in runs]
    names = dict.fromkeys(name for changed in (first, *others) for name in changed)
    return {n: first.get(n) if all(o.get(n) == first.get(n) for o in others) else None for n in names}
