"""`ihbench view RUNS`: the site of runs on 127.0.0.1, following those that are not done; `--live`: a fit while it
goes on, an avatar that is drawn anew every few seconds."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.pages.site import read_runs
from ihbench.config_fields import Within
from ihbench.errors import BadInput

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
    live: bool = False
    """The avatar of the run that goes on in these folders, every few seconds as it stands, in a viser scene (extra
    `view`). Run it beside `ihbench run`, or give that command's own arguments after `--`: they are run and shown."""


def main(argv: list[str]) -> int:
    own, divided, to_run = _divided(argv)
    chosen = options(ViewOptions, own, "view", "Finished and running runs in your browser, on this machine alone.")
    if chosen.live:
        return _live(chosen, to_run if divided else None)
    if divided:
        raise BadInput("view: arguments of `ihbench run` after -- go with --live")
    site = registry.load("site", "general")

    def read() -> tuple[list[RunResult], list[str]]:
        return read_runs(chosen.runs)

    read()  # before anything is served: a wrong folder is said at once
    site.serve(read, chosen.port, views=chosen.views, data=chosen.data, body=chosen.body)
    return 0


def _divided(argv: Sequence[str]) -> tuple[list[str], bool, list[str]]:
    """What stands before a `--`, whether there is one, and what stands behind it."""
    arguments = list(argv)
    if "--" not in arguments:
        return arguments, False, []
    at = arguments.index("--")
    return arguments[:at], True, arguments[at + 1 :]


def _live(chosen: ViewOptions, to_run: Sequence[str] | None) -> int:
    site = registry.load("site", "general")
    site.need_viser()  # before anything is run
    if to_run is None:
        if missing := [place for place in chosen.runs if not place.is_dir()]:
            raise BadInput(f"{missing[0]}: no such folder; name run folders, or where ihbench run puts them")
        site.serve_live(chosen.runs, chosen.port, data=chosen.data, body=chosen.body)
        return 0
    places = [_runs_of(to_run)]
    with subprocess.Popen([sys.executable, "-m", "ihbench", "run", *to_run]) as child:
        try:
            more: dict[str, Any] = {"data": chosen.data, "body": chosen.body}
            site.serve_live(places, chosen.port, **more, goes_on=lambda: child.poll() in (None, 0))
        finally:
            if child.poll() is None:
                child.terminate()  # it saves what it has; a Ctrl-C has reached it already
    return child.returncode


def _runs_of(arguments: Sequence[str]) -> Path:
    """Where `ihbench run` with these arguments puts its runs."""
    for k, argument in enumerate(arguments):
        if argument == "--runs" and k + 1 < len(arguments):
            return Path(arguments[k + 1])
        if argument.startswith("--runs="):
            return Path(argument.partition("=")[2])
    return Path("runs")
