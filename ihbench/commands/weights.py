"""`ihbench weights list|where|fetch`: learned weights that the bench may not ship."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from ihbench.commands.options.parse import subcommand
from ihbench.commands.options.printing import Printing
from ihbench.document.document import Paragraph, Table
from ihbench.metrics import weights


@dataclass(frozen=True)
class List(Printing):
    """What weight files there are, what uses them, and whether they are here."""


@dataclass(frozen=True)
class Where(Printing):
    """The folders that are searched, and where each file is or belongs."""


@dataclass(frozen=True)
class Fetch:
    """Download weight files; needs a connection. Hash-checked; a file that is here already is left."""

    name: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names as `ihbench weights list` shows them."""


def main(argv: list[str]) -> int:
    chosen = subcommand(
        {"list": List, "where": Where, "fetch": Fetch},
        argv,
        "weights",
        "Learned weights that the bench may not ship.",
    )
    if isinstance(chosen, Fetch):
        return _fetch(chosen)
    states = weights.states()
    folders = [str(folder) for folder in weights.folders()]
    where = isinstance(chosen, Where)
    keys = ("name", "state", "path") if where else ("name", "state", "file", "used_by", "size_mb")
    head = [{"used_by": "used by", "size_mb": "MB"}.get(key, key) for key in keys]
    rows = tuple(tuple(str(state[key]) for key in keys) for state in states)
    searched = [Paragraph(f"searched: {folder}") for folder in folders if where]
    chosen.show({"folders": folders, "weights": states}, [*searched, Table(tuple(head), rows, left=4)])
    return 1 if any(s["state"] == "damaged" for s in states) else 0


def _fetch(chosen: Fetch) -> int:
    from ihbench.clock.progress import Progress

    for entry in [weights.find_weights(name) for name in chosen.name]:
        print(f"{entry.name}: {weights.fetch(entry, Progress())}")
    return 0
