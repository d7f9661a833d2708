"""`ihbench list`: what is registered, one line each. Imports none of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from ihbench import registry
from ihbench.commands.parse import options
from ihbench.errors import BadInput
from ihbench.files.regular import read_toml
from ihbench.protocol import load_protocol

KINDS = ("methods", "datasets", "protocols", "reports", "metrics")


@dataclass(frozen=True)
class ListOptions:
    kind: Annotated[
        Literal["all", "methods", "datasets", "protocols", "reports", "metrics"], tyro.conf.Positional
    ] = "all"
    """What to list."""
    json: bool = False
    """Print one JSON object on stdout."""


def main(argv: list[str]) -> int:
    chosen = options(ListOptions, argv, "list", "What is registered, one line each.")
    kinds = KINDS if chosen.kind == "all" else (chosen.kind,)
    found = {kind: _DESCRIBE[kind]() for kind in kinds}
    if chosen.json:
        print(json.dumps(found))
        return 0
    width = max((len(name) for rows in found.values() for name in rows), default=0)
    for kind, rows in found.items():
        print(kind)
        for name, about in rows.items():
            print(f"  {name:<{width}}  {about}".rstrip())
    return 0


def _methods() -> dict[str, str]:
    about = {}
    for name in registry.names("method"):
        card = registry.package_folder("method", name) / "card.toml"
        words = read_toml(card, "the method's card") if card.is_file() else {}
        about[name] = str(words.get("summary", words.get("title", "")))
    return about


def _datasets() -> dict[str, str]:
    standins = registry.names("stand-in")
    return {name: "with a stand-in" if name in standins else "" for name in registry.names("dataset")}


def _protocols() -> dict[str, str]:
    about = {}
    for name in registry.names("protocol"):
        try:
            protocol = load_protocol(name)
            about[protocol.name] = protocol.title
        except BadInput as error:  # of another package: it must not take the others away
            about[name] = str(error)
    return about


def _reports() -> dict[str, str]:
    return {name: "" for name in registry.names("report")}


def _metrics() -> dict[str, str]:
    """Each preset, and after it each of its identity strings with the definition in a line."""
    found = {}
    for name in registry.names("metric preset"):
        preset = registry.load("metric preset", name)
        found[name] = f"{preset.about} [{preset.source}]"
        for measure in preset.measures:
            regions = "" if measure.regions is None else f" (over {', '.join(measure.regions)})"
            identity = str(measure.identity("REGION", (1.0, 1.0, 1.0)))
            found[identity] = measure.about + regions
    return found


_DESCRIBE = {
    "methods": _methods,
    "datasets": _datasets,
    "protocols": _protocols,
    "reports": _reports,
    "metrics": _metrics,
}
