"""`ihbench report`: tables of finished runs, and the verbs that other rooms register under it."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from ihbench import registry
from ihbench.commands.options.parse import options
from ihbench.commands.options.run_filters import RowOptions, RunFilters
from ihbench.errors import BadInput, visible
from ihbench.files import atomic
from ihbench.record import outputs

if TYPE_CHECKING:
    from ihbench.record.results import NotRun, RunResult

SHOWN = 20  # folders left out that are named on stderr


@dataclass(frozen=True)
class ReportOptions(RunFilters, RowOptions):
    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Run folders; none means every run under --runs."""
    preset: tuple[str, ...] = ()
    """Further metric presets to show (`ihbench list metrics`), such as gauhuman; stored renders are scored where they
    have not been yet."""
    data: Path | None = None
    """Your copy of the data set, if runs used one and --preset asks for numbers that are not there yet."""
    body: Path | None = None
    """SMPL model file, likewise."""
    format: str | None = None
    """A registered report: md, tex (booktabs, for pdflatex), html (one file with its pictures inside). Without it a
    terminal shows the headline table alone; files and pipes get md."""
    full: bool = False
    """The whole report in Markdown, on a terminal too."""
    figures: Path | None = None
    """Folder for diagrams of error against run time: PNG, SVG, and their numbers as CSV."""
    target: tuple[str, ...] = ()
    """Qualities whose time is asked for, as psnr=25, flip=0.15 or psnr/hidden=20; without them round ones."""
    metrics: tuple[str, ...] = ()
    """Only these metrics, as psnr or flip."""
    regions: tuple[str, ...] = ()
    """Only these regions, as body or hidden."""
    fragment: bool = False
    """Only the tables of scores, without a document around them; in LaTeX the tabular alone, for \\input."""
    out: Path | None = None
    """File to write; without it the report goes to stdout."""


def main(argv: list[str]) -> int:
    verbs = registry.names("report verb")
    if argv and argv[0] in verbs:  # a run folder of that name is still ./NAME
        return registry.load("report verb", argv[0]).main(argv[1:])
    about = f"Tables of finished runs. Also: ihbench report {' | '.join(verbs)}, each with its --help."
    chosen = options(ReportOptions, argv, "report", about)
    from ihbench.metrics.evaluate import find_preset
    from ihbench.record.quality_time import Target
    from ihbench.record.results import read_results
    from ihbench.record.row_choice import Choice

    outputs.check_file(chosen.out, chosen.data, chosen.body)
    write = registry.load("report", chosen.format or "md")
    only = {"fragment": True} if chosen.fragment else {}
    if only and "fragment" not in signature(write).parameters:
        raise BadInput(f"--fragment: the report {chosen.format!r} has no fragments; leave it out, or --format tex")
    targets = [Target.parse(text) for text in chosen.target]
    for name in chosen.preset:
        find_preset(name)
    results, left_out = read_results(chosen.run) if chosen.run else _matching(chosen)
    results = [run for run in results if chosen.matches(run)]
    say_left_out(left_out)
    if not results:
        where = (
            "none of the run folders that are named matches"
            if chosen.run
            else f"no run folders under {chosen.runs} match"
        )
        raise BadInput(f"{where}; make one with: ihbench run --protocol zju_occ --scene standin-1")
    whole = chosen.full or chosen.fragment or chosen.format or chosen.out or chosen.figures
    named = *chosen.preset, *chosen.target, *chosen.rows, *chosen.metrics, *chosen.regions, *chosen.names
    if _on_terminal() and not whole and not named:
        print(headline(results, left_out), end="")
        return 0
    if chosen.preset:
        results = [_with_presets(result, chosen) for result in results]
    results = Choice(chosen.rows, chosen.metrics, chosen.regions, chosen.names).applied(results)
    pictures: list[tuple[Path, str]] = []
    if chosen.figures is not None:
        for name in registry.names("figure"):
            pictures += registry.load("figure", name)(results, chosen.figures)
    folder = Path(".") if chosen.out is None else chosen.out.parent
    text = write(results, chosen.preset, targets=targets, pictures=pictures, folder=folder, left_out=left_out, **only)
    if chosen.out is None:
        print(text, end="")
    else:
        atomic.write_text(chosen.out, text)
    return 0


def _with_presets(result: RunResult, chosen: ReportOptions) -> RunResult:
    """The run with the numbers of the presets asked for; one whose data are not to be had is named and left out."""
    from ihbench.clock.progress import Progress
    from ihbench.record.results import read_result
    from ihbench.runner.rescore import rescore

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


def _matching(chosen: ReportOptions) -> tuple[list[RunResult], list[str]]:
    """Runs under --runs that match the filters, and the folders left out."""
    from ihbench.record.index import Index

    if not chosen.runs.is_dir():
        return [], []
    filters = {name: getattr(chosen, name) for name in ("protocol", "method", "scene", "profile")}
    return Index(chosen.runs).results(**{name: value for name, value in filters.items() if value is not None})


def _on_terminal() -> bool:
    return sys.stdout.isatty()


def headline(results: Sequence[RunResult], left_out: Sequence[str] = (), not_run: Sequence[NotRun] = ()) -> str:
    """The headline table of some runs, as wide as the terminal, 80 columns at most."""
    return registry.load("table", "headline")(results, left_out, shutil.get_terminal_size().columns, not_run)


def say_left_out(lines: Sequence[str]) -> None:
    """Name the folders that a report leaves out on stderr, the first of very many."""
    for line in lines[:SHOWN]:
        print(f"ihbench: left out: {visible(line)}", file=sys.stderr)
    if len(lines) > SHOWN:
        print(f"ihbench: left out: {len(lines) - SHOWN} more; the report names them", file=sys.stderr)
