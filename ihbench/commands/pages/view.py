"""`ihbench view RUNS`: the site of runs on 127.0.0.1, following those that are not done."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.pages.site import read_runs
from ihbench.config_fields import Within

if TYPE_CHECKING:
    from ihbench.record.results import RunResult


@dataclass(frozen=True)
class ViewOptions:
    runs: Annotated[tuple[Path, ...], tyro.conf.Positional] = (Path("runs"),)
    """Run folders, or folders of them."""
    port: Annotated[int, Within(0, 65535)] = 7070
    """Port on 127.0.0.1; 0 takes any that is free."""
    views: Annotated[int, Within(1, 10_000)] = 12
    """About so many test views of a scene have pictures."""
    data: Path | None = None
    """Your copy of the data set, for runs on real data; without it there is no truth beside the predictions."""
    body: Path | None = None
    """SMPL model file, likewise."""


def main(argv: list[str]) -> int:
    chosen = options(ViewOptions, argv, "view", "Finished and running runs in your browser, on this machine alone.")
    site = registry.load("site", "general")

    def read() -> tuple[list[RunResult], list[str]]:
        return read_runs(chosen.runs)

    read()  # before anything is served: a wrong folder is said at once
    site.serve(read, chosen.port, views=chosen.views, data=chosen.data, body=chosen.body)
    return 0
