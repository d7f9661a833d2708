"""`ihbench protocol show P` and `ihbench protocol diff A B`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from ihbench.commands.options.parse import options
from ihbench.commands.options.scene_choice import ProtocolChanges
from ihbench.scene.occlusion import withheld
from ihbench.scene.protocol import Protocol, difference, load_protocol, spelled


@dataclass(frozen=True, kw_only=True)
class Show(ProtocolChanges):
    """Every choice of one protocol, and the regions that have no number under it."""

    protocol: Annotated[str, tyro.conf.Positional]
    """Name of the protocol."""
    profile: str = "paper"
    """Profile under which to show it."""
    json: bool = False
    """Print one JSON object on stdout."""


@dataclass(frozen=True)
class Diff:
    """Where two protocols differ, key by key."""

    a: Annotated[str, tyro.conf.Positional]
    b: Annotated[str, tyro.conf.Positional]
    profile: str = "paper"
    """Profile under which to compare them."""
    json: bool = False
    """Print one JSON object on stdout."""


Command = (
    Annotated[Show, tyro.conf.subcommand("show", description=Show.__doc__)]
    | Annotated[Diff, tyro.conf.subcommand("diff", description=Diff.__doc__)]
)


def main(argv: list[str]) -> int:
    chosen = options(Command, argv, "protocol", "Look at protocols.")  # type: ignore[arg-type]
    return _show(chosen) if isinstance(chosen, Show) else _diff(chosen)


def _show(chosen: Show) -> int:
    protocols = chosen.apply(load_protocol(chosen.protocol, chosen.profile))
    shown = [_shown(protocol) for protocol in protocols]
    if chosen.json:
        print(json.dumps(shown[0] if len(shown) == 1 else {"protocols": shown}))
        return 0
    for k, content in enumerate(shown):
        values = spelled(content)
        width = max(map(len, values))
        print("\n" * bool(k) + "\n".join(f"{key:<{width}}  {value}" for key, value in values.items()))
    return 0


def _shown(protocol: Protocol) -> dict[str, Any]:
    absent = withheld(protocol.metrics.regions) if protocol.occlusion.in_scene else {}
    ends = {"profile": protocol.profile, "digest": protocol.digest}
    return {**protocol.content, **({"absent": absent} if absent else {}), **ends}


def _diff(chosen: Diff) -> int:
    a, b = load_protocol(chosen.a, chosen.profile), load_protocol(chosen.b, chosen.profile)
    rows = difference(a, b)
    if chosen.json:
        print(json.dumps([{"key": k, chosen.a: x, chosen.b: y} for k, x, y in rows]))
        return 0
    for key, left, right in rows:
        print(key)
        print(f"  {a.name:<24}{left or '(not set)'}")
        print(f"  {b.name:<24}{right or '(not set)'}")
    return 0
