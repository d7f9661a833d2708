"""`ihbench report`: tables of finished runs."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ihbench import atomic, registry
from ihbench.commands.parse import options
from ihbench.errors import BadInput

if TYPE_CHECKING:
    from ihbench.results import RunResult


@dataclass(frozen=True)
class ReportOptions:
    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run folders; none means every run under --runs."""
    runs: Path = Path("runs")
    """Folder of run folders."""
    protocol: str | None = None
    """Only runs under this protocol, with or without its @version."""
    method: str | None = None
    """Only runs of this method."""
    scene: str | None = None
    """Only runs on this scene."""
    profile: str | None = None
    """Only runs under this profile."""
    preset: tuple[str, ...] = ()
    """Further metric presets to show (`ihbench list metrics`), such as gauhuman; stored renders are scored where they
    have not been yet."""
    data: Path | None = None
    """Your copy of the data set, if runs used one and --preset asks for numbers that are not there yet."""
    body: Path | None = None
    """SMPL model file, likewise."""
    format: str = "md"
    """A registered report."""
    out: Path | None = None
    """File to write; without it the report goes to stdout."""


def main(argv: list[str]) -> int:
    chosen = options(ReportOptions, argv, "report", "Tables of finished runs.")
    from ihbench.metrics.evaluate import find_preset
    from ihbench.results import read_result

    write = registry.load("report", chosen.format)
    folders = chosen.run or _matching(chosen)
    if not folders:
        raise BadInput(
            f"no run folders under {chosen.runs} match; "
            "make one with: ihbench run --protocol zju_occ --scene standin-1"
        )
    results = []
    for name in chosen.preset:
        find_preset(name)
    for folder in folders:
        try:
            results.append(read_result(folder))
        except BadInput as error:
            if chosen.run:
                raise
            print(f"ihbench: left out: {error}", file=sys.stderr)
    if chosen.preset:
        results = [_with_presets(result, chosen) for result in results]
    text = write(results, chosen.preset)
    if chosen.out is None:
        print(text, end="")
    else:
        atomic.write_text(chosen.out, text)
    return 0


def _with_presets(result: RunResult, chosen: ReportOptions) -> RunResult:
    """The run with the numbers of the presets asked for; one whose data are not to be had is named and left out."""
    from ihbench.progress import Progress
    from ihbench.rescore import rescore
    from ihbench.results import read_result

    if result.status != "done":
        return result
    for name in chosen.preset:
        try:
            rescore(result.folder, name, chosen.data, chosen.body, Progress())
        except BadInput as error:
            if chosen.run:
                raise
            print(f"ihbench: not scored as {name}: {error}", file=sys.stderr)
    return read_result(result.folder)


def _matching(chosen: ReportOptions) -> tuple[Path, ...]:
    """Run folders under --runs that match the filters, from the index."""
    from ihbench.index import Index

    if not chosen.runs.is_dir():
        return ()
    wanted = {name: getattr(chosen, name) for name in ("protocol", "method", "scene", "profile")}
    rows = Index(chosen.runs).query(**{name: value for name, value in wanted.items() if value is not None})
    return tuple(chosen.runs / row["path"] for row in rows)
