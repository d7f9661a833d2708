"""`ihbench weights list|where|fetch`: learned weights that the bench may not ship."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated

import tyro

from ihbench.commands.options.parse import options
from ihbench.metrics import weights


@dataclass(frozen=True)
class List:
    """What weight files there are, what uses them, and whether they are here."""

    json: bool = False
    """Print one JSON object on stdout."""


@dataclass(frozen=True)
class Where:
    """The folders that are searched, and where each file is or belongs."""

    json: bool = False
    """Print one JSON object on stdout."""


@dataclass(frozen=True)
class Fetch:
    """Download weight files; needs a connection. Hash-checked; a file that is here already is left."""

    name: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names as `ihbench weights list` shows them."""


Command = (
    Annotated[List, tyro.conf.subcommand("list", description=List.__doc__)]
    | Annotated[Where, tyro.conf.subcommand("where", description=Where.__doc__)]
    | Annotated[Fetch, tyro.conf.subcommand("fetch", description=Fetch.__doc__)]
)


def main(argv: list[str]) -> int:
    chosen = options(Command, argv, "weights", "Learned weights that the bench may not ship.")  # type: ignore[arg-type]
    if isinstance(chosen, Fetch):
        return _fetch(chosen)
    states = weights.states()
    folders = [str(folder) for folder in weights.folders()]
    if chosen.json:
        print(json.dumps({"folders": folders, "weights": states}))
    elif isinstance(chosen, Where):
        print("\n".join(f"searched: {folder}" for folder in folders))
        print("\n".join(f"{s['name']:<14} {s['state']:<8} {s['path']}" for s in states))
    else:
        print(
            "\n".join(
                f"{s['name']:<14} {s['state']:<8} {s['size_mb']:>6} MB  {s['file']}  {s['used_by']}" for s in states
            )
        )
    return 1 if any(s["state"] == "damaged" for s in states) else 0


def _fetch(chosen: Fetch) -> int:
    from ihbench.clock.progress import Progress

    for entry in [weights.find_weights(name) for name in chosen.name]:
        print(f"{entry.name}: {weights.fetch(entry, Progress())}")
    return 0
