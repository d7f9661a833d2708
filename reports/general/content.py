"""What the general report says: per protocol, profile and kind of data the tables of methods and calibration rows,
error against run time, what was painted, intervals and paired tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from ihbench.document.document import (
    Block,
    Bullets,
    Heading,
    Paragraph,
    Picture,
    Span,
    Table,
    Words,
    bullets,
    code,
    emphasis,
    strong,
)
from ihbench.document.metric_names import variants_told
from ihbench.errors import BadInput
from ihbench.metrics import Identity
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult, by_group
from ihbench.record.row_labels import by_label
from ihbench.reports.general.clock import fit_cpu_seconds, mean_cost, three_digits
from ihbench.reports.general.inpainting import inpainting_section
from ihbench.reports.general.ledger_table import ledger_section
from ihbench.reports.general.remarks import remarks
from ihbench.reports.general.run_time import across_sizes_section, run_time_section
from ihbench.reports.general.significance import further_rows, intervals_section, score_cells
from ihbench.reports.general.strip_cost import strip_cost_section
from ihbench.scoring.calibration import DESCRIPTIONS, ROWS


def general_report(
    results: Sequence[RunResult],
    presets: Sequence[str] = (),
    targets: Sequence[Target] = (),
    pictures: Sequence[tuple[Path, str]] = (),
    left_out: Sequence[str] = (),
) -> list[Block]:
    """All tables of these runs, and those of further metric presets that the runs were scored under.

    Runs under different protocols, profiles or data never share a table, nor do presets. `targets` are qualities
    whose times are asked for; `pictures` (file, caption) come at the end, after the folders that are `left_out`, with
    the reasons.
    """
    blocks: list[Block] = []
    for runs in by_group(results).values():
        blocks += _group(runs, presets, targets)
    blocks += across_sizes_section(results)
    blocks += strip_cost_section(results)
    if left_out:
        blocks += [Heading(2, "Left out"), *bullets([*left_out])]
    if pictures:
        blocks += [Heading(2, "Figures"), *(Picture(file, caption) for file, caption in pictures)]
    return blocks


def score_tables(results: Sequence[RunResult], presets: Sequence[str] = ()) -> list[Table]:
    """What a paper takes from a report: for each protocol, profile and kind of data one table of all metrics and
    regions, and one for each further preset, titled. Raises `BadInput` where no run is done."""
    groups = by_group(result for result in results if result.status == "done")
    score_tables: list[Table] = []
    for (protocol, digest, profile, data), runs in groups.items():
        headline = runs[0].headline
        title = f"{protocol} ({digest}), {profile} profile, {data}"
        for preset in ("", *presets):
            scored = _under(preset, runs) if preset else runs
            own = dict.fromkeys(i for run in runs for i in run.rows[run.method])
            columns = _preset_columns(scored) if preset else [i for i in own if _has_a_number(runs, i)]
            if columns:
                table = _table(scored, columns, headline, with_metric=True)
                score_tables.append(replace(table, title=f"{title}, {preset}" if preset else title))
    if not score_tables:
        raise BadInput("--fragment: no run that is done has a number here; there is no table to write")
    return score_tables


def _under(preset: str, runs: Sequence[RunResult]) -> list[RunResult]:
    """The runs that were scored under a preset, with its rows in place of their own."""
    return [replace(run, rows=run.presets[preset]) for run in runs if preset in run.presets]


def _preset_columns(runs: Sequence[RunResult]) -> list[Identity]:
    """Identities with a number in any row."""
    every = [row for run in runs for row in run.rows.values()]
    return [
        i for i in dict.fromkeys(i for row in every for i in row) if any(i in r and not r[i].absent for r in every)
    ]


def _group(runs: list[RunResult], presets: Sequence[str], targets: Sequence[Target]) -> list[Block]:
    protocol, digest, profile, _ = runs[0].group
    blocks: list[Block] = [
        Heading(2, f"{protocol}, {profile} profile"),
        Paragraph(("Data: ", *data_words(runs[0]), ". Protocol digest ", code(digest), ".")),
    ]
    blocks += [
        Paragraph(f"Not done: {run.method} on {run.scene}: {run.status} ({run.reason}).")
        for run in runs
        if run.status != "done"
    ]
    done = [run for run in runs if run.status == "done"]
    if not done:
        return blocks
    headline = done[0].headline
    identities = list(dict.fromkeys(i for run in done for i in run.own))
    for metric in dict.fromkeys(i.metric for i in identities):
        columns = [i for i in identities if i.metric == metric and _has_a_number(done, i)]
        if columns:
            shown = columns[0].display
            blocks.append(Heading(3, f"{shown.title} {shown.arrow}{f' ({shown.unit})' if shown.unit else ''}"))
            first = metric == identities[0].metric
            blocks.append(_table(done, columns, headline, with_costs=first))
    scenes = ", ".join(sorted({run.scene for run in done}))
    note = (
        f"Mean over test views of a scene, then over scenes ({scenes}); of seconds and render ms, over the seeds of "
        f"a scene, then over scenes; peak MB is the largest. Headline region: {headline}."
    )
    blocks.append(Paragraph(note))
    blocks += _definitions(identities)
    present = [row for row in ROWS if any(row in run.rows for run in done)]
    blocks += bullets([*(f"{row}: {DESCRIPTIONS[row]}" for row in present), *remarks(done)])
    for preset in presets:
        blocks += _preset(preset, done, headline)
    labelled = by_label(done)
    blocks += intervals_section(labelled, identities, headline)
    blocks += run_time_section(done, identities, headline, targets)
    blocks += ledger_section(done)
    return blocks + inpainting_section(labelled)


def data_words(run: RunResult) -> tuple[str | Span, ...]:
    """What a run was made on."""
    standin = run.about.standin
    return (strong(standin), run.data.removeprefix(standin)) if standin else (run.data,)


def _preset(name: str, runs: list[RunResult], headline: str) -> list[Block]:
    """The table of one further preset, over the runs that were scored under it."""
    scored = _under(name, runs)
    blocks: list[Block] = [Heading(3, f"preset {name}")]
    if not scored:
        return [*blocks, Paragraph(f"No run was scored under {name}: ihbench report --preset {name}")]
    identities = list(dict.fromkeys(i for run in scored for i in run.own))
    columns = _preset_columns(scored)
    if columns:
        blocks.append(_table(scored, columns, headline, with_metric=True))
    own = ((i, mean) for run in scored for i, mean in run.own.items())
    absent = {f"absent: {i.display.title} of {name}: {mean.reason}" for i, mean in own if mean.absent}
    return [*blocks, *_definitions(identities), Bullets(("scored from the runs' 8-bit renders", *sorted(absent)))]


def _has_a_number(runs: list[RunResult], identity: Identity) -> bool:
    """Whether any run has a method's number of this identity; `truth` and its like have them where methods do."""
    return any(identity in run.own and not run.own[identity].absent for run in runs)


def _definitions(identities: Sequence[Identity]) -> list[Block]:
    """The identity strings in the tables, with the region left open."""
    names = dict.fromkeys(str(replace(i, region="REGION")) for i in identities)
    words: list[Words] = []
    for name in names:
        words += [" ", code(name)] if words else [code(name)]
    return [Paragraph(tuple(words))] if words else []  # type: ignore[arg-type]


def _table(
    runs: list[RunResult],
    columns: Sequence[Identity],
    headline: str,
    *,
    with_costs: bool = False,
    with_metric: bool = False,
) -> Table:
    names = {
        i: f"{i.display.title}{i.display.arrow} {i.region} {said}".rstrip()
        if with_metric
        else f"{i.region} {said}".rstrip()
        for i, said in variants_told(columns).items()
    }
    titles: list[Words] = [strong(names[i]) if i.region == headline else names[i] for i in columns]
    of_cpu = any(fit_cpu_seconds(run) is not None for run in runs)
    costs = ["fit s", *(["fit CPU s"] if of_cpu else []), "total s", "peak MB", "render ms"] if with_costs else []
    head: list[Words] = ["method", "scenes", "seeds", *titles, *costs]
    lines: list[tuple[Words, ...]] = []
    for label, group in by_label(runs).items():
        method = group[0].method
        about = (str(len({r.scene for r in group})), ", ".join(sorted({str(r.seed) for r in group})))
        own: list[str] = []
        if with_costs:
            own = [_cost(group, lambda run: run.about.fit_seconds)]
            own += [_cost(group, fit_cpu_seconds)] if of_cpu else []
            own.append(_cost(group, lambda run: run.about.total_seconds))
            own.append(f"{max(run.about.peak_mb or 0.0 for run in group):.0f}")
            own.append(_cost(group, lambda run: run.about.render_ms, three_digits))
        lines.append((label, *about, *score_cells(group, columns, method), *own))
        for row in further_rows(group):
            name = label + row.removeprefix(method)
            lines.append((name, *about, *score_cells(group, columns, row), *([""] * len(costs))))
    for row in ROWS:
        scenes = {run.scene for run in runs if row in run.rows}
        if scenes:
            lines.append(
                (emphasis(row), str(len(scenes)), "", *score_cells(runs, columns, row), *([""] * len(costs)))
            )
    return Table(tuple(head), tuple(lines), left=3)


def _cost(
    runs: list[RunResult], cost: Callable[[RunResult], float | None], shown: Callable[[float], str] = "{:.0f}".format
) -> str:
    mean = mean_cost(runs, cost)
    return "—" if mean is None else shown(mean)
