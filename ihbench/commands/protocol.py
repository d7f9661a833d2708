"""`ihbench protocol show P` and `ihbench protocol diff A B`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ihbench.commands.options.parse import subcommand
from ihbench.commands.options.printing import Printing
from ihbench.commands.options.scene_choice import ProtocolChanges
from ihbench.document.document import Table
from ihbench.scene.occlusion import withheld
from ihbench.scene.protocol import Protocol, difference, load_protocol, spelled


@dataclass(frozen=True, kw_only=True)
class Show(ProtocolChanges, Printing):
    """Every choice of one protocol, and the regions that have no number under it."""

    protocol: Annotated[str, tyro.conf.Positional]
    """Name of the protocol."""
    profile: str = "paper"
    """Profile under which to show it."""


@dataclass(frozen=True)
class Diff(Printing):
    """Where two protocols differ, key by key."""

    a: Annotated[str, tyro.conf.Positional]
    b: Annotated[str, tyro.conf.Positional]
    profile: str = "paper"
    """Profile under which to compare them."""


def main(argv: list[str]) -> int:
    chosen = subcommand({"show": Show, "diff": Diff}, argv, "protocol", "Look at protocols.")
    return _show(chosen) if isinstance(chosen, Show) else _diff(chosen)


def _show(chosen: Show) -> int:
    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    shown = [_shown(protocol) for protocol in protocols]
    tables = [Table(("choice", "value"), tuple(spelled(content).items()), left=2, bare=True) for content in shown]
    chosen.show(shown[0] if len(shown) == 1 else {"protocols": shown}, tables)
    return 0


def _shown(protocol: Protocol) -> dict[str, object]:
    absent = withheld(protocol.metrics.regions) if protocol.occlusion.in_scene else {}
    ends = {"profile": protocol.profile, "digest": protocol.digest}
    return {**protocol.content, **({"absent": absent} if absent else {}), **ends}


def _diff(chosen: Diff) -> int:
    a, b = load_protocol(chosen.a, chosen.profile), load_protocol(chosen.b, chosen.profile)
    rows = difference(a, b)
    cells = [(key, left or "(not set)", right or "(not set)") for key, left, right in rows]
    text = "\n".join(f"{key}\n  {a.name:<24}{left}\n  {b.name:<24}{right}" for key, left, right in cells)
    table = Table(("choice", a.name, b.name), tuple(cells), left=3)
    chosen.show([{"key": k, chosen.a: x, chosen.b: y} for k, x, y in rows], [table], text)
    return 0
