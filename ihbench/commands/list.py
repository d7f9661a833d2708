"""`ihbench list`: what is registered, one line each. Imports little of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from ihbench import registry
from ihbench.commands import COMMANDS
from ihbench.commands.options.parse import options
from ihbench.commands.options.printing import Printing
from ihbench.document.document import Block, Heading, Table
from ihbench.errors import BadInput
from ihbench.scene.method_spec import method_spec, usable_specs
from ihbench.scene.protocol import load_protocol

KINDS = ("methods", "datasets", "protocols", "reports", "metrics")


@dataclass(frozen=True, kw_only=True)
class ListOptions(Printing):
    kind: Annotated[
        Literal["all", "methods", "datasets", "protocols", "reports", "metrics"], tyro.conf.Positional
    ] = "all"
    """What to list."""


def main(argv: list[str]) -> int:
    chosen = options(ListOptions, argv, "list", "What is registered, one line each.")
    kinds = KINDS if chosen.kind == "all" else (chosen.kind,)
    kinds_shown = {kind: _described(kind) for kind in kinds}
    if chosen.kind == "all":
        kinds_shown |= _clashes()
    blocks: list[Block] = []
    for kind, rows in kinds_shown.items():
        blocks += [Heading(2, kind), Table(("name", "what it is"), tuple(rows.items()), left=2, bare=True)]
    chosen.show(kinds_shown, blocks)
    return 0


def _described(kind: str) -> dict[str, str]:
    """Name -> what it is, of everything of a kind."""
    standins = registry.names("stand-in")
    match kind:
        case "methods":
            return _each("method", lambda name: (name, method_spec(name).summary))
        case "datasets":
            return _each("dataset", lambda name: (name, "with a stand-in" if name in standins else ""))
        case "protocols":
            return _each("protocol", lambda name: ((p := load_protocol(name)).name, p.title))
        case "reports":
            return _each("report", lambda name: (name, ""))
    return _metrics()


def _each(kind: str, describe: Callable[[str], tuple[str, str]]) -> dict[str, str]:
    """Every registered name as it is listed, with a word about it; or with what is wrong with it."""
    out = {}
    for name in registry.names(kind):
        try:
            registry.entry_point(kind, name)
            listed, about = describe(name)
        except (BadInput, ImportError, OSError, ValueError) as error:
            listed, about = name, f"cannot be used: {error}"
        out[listed] = about
    return out


def _clashes() -> dict[str, dict[str, str]]:
    """Names of any kind that several packages claim."""
    notes = {f"{kind} {name}": why for kind in registry.GROUPS for name, why in registry.clashes(kind).items()}
    hidden = "is registered by another package; the bench's own is the one that runs"
    notes |= {f"command {name}": hidden for spec in usable_specs() for name in spec.commands if name in COMMANDS}
    return {"clashes": notes} if notes else {}


def _metrics() -> dict[str, str]:
    """Each preset, and after it each of its identity strings with the definition in a line."""
    metrics = {}
    for name in registry.names("metric preset"):
        try:
            preset = registry.load("metric preset", name)
        except BadInput as error:
            metrics[name] = f"cannot be used: {error}"
            continue
        metrics[name] = f"{preset.about} [{preset.source}]"
        for measure in preset.measures:
            regions = "" if measure.regions is None else f" (over {', '.join(measure.regions)})"
            identity = str(measure.identity("REGION", (1.0, 1.0, 1.0)))
            metrics[identity] = measure.about + regions
    return metrics
