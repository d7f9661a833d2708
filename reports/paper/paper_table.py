"""A table of the paper as data: quoted rows, and blocks of rows measured here, every cell with its status.

Rows that cannot be compared never stand in one block: quoted numbers (their definition is unknown), measurements on
real data, measurements on stand-ins, and runs under other protocols, profiles or variants of the data each have their
own. Marks are computed inside a block.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Literal

import numpy as np

from ihbench.document.document import (
    Block,
    Heading,
    Number,
    Paragraph,
    RowLabel,
    Span,
    Table,
    bullets,
    emphasis,
    spans,
)
from ihbench.document.marks import marks_by_interval, marks_by_value
from ihbench.document.short_names import Footnotes, split_label
from ihbench.errors import BadInput
from ihbench.metrics import Identity, Mean, macro_mean
from ihbench.metrics.statistics import Interval, mean_interval
from ihbench.record.results import RunResult, group_row, grouped
from ihbench.record.row_choice import EVERYTHING, Choice
from ihbench.record.row_labels import by_label
from ihbench.record.scene_means import scene_means
from ihbench.registry import nearest
from ihbench.reports.general.remarks import lacking, row_footnotes
from ihbench.reports.general.significance import LEVEL
from ihbench.reports.paper.comparison import as_the_profile_has_it, beaten_notes, rank_note
from ihbench.reports.paper.paper_numbers import Column, Component, Group, PaperRow, PaperTable
from ihbench.scene.method_spec import usable_specs
from ihbench.scene.protocol import REGIONS
from ihbench.scoring.calibration import DESCRIPTIONS, ROWS

Kind = Literal["quoted", "real data", "stand-in"]
MEASURED = {"real data": "measured", "stand-in": "stand-in"}  # a block's kind -> the status of its numbers
YES, NO, UNKNOWN = "✓", "", "?"


@dataclass(frozen=True)
class Frame:
    name: str  # "table1"
    title: str
    source: str
    tables: tuple[Table, ...]
    footnotes: Mapping[str, str]  # letter -> text
    notes: tuple[str, ...] = ()

    @property
    def below(self) -> list[Block]:
        """What the letters in the tables mean."""
        return [Paragraph((Span(letter, "raised"), f" {text}")) for letter, text in self.footnotes.items()]

    @property
    def blocks(self) -> list[Block]:
        """The whole document."""
        source = Paragraph(f"Source of quoted numbers: {self.source}.")
        return [Heading(1, self.title), source, *self.tables, *self.below, *bullets(self.notes)]


def build_frame(
    table: PaperTable,
    results: Sequence[RunResult],
    region: str = "",
    as_printed: bool = False,
    choice: Choice = EVERYTHING,
    left_out: Sequence[str] = (),
) -> Frame:
    """The table's frame, filled from the paper and from these runs.

    `results` under other protocols than the table's are left out. `region` is that of measured numbers; "" is every
    protocol's headline; where `choice` has regions, measured blocks are there for each of them. `as_printed` gives
    quoted rows the paper's own marks in place of computed ones. Marks are those among the chosen rows. `left_out` are
    run folders that could not be read, with the reasons. Raises `BadInput` for a choice of what there is not.
    """
    footnotes = Footnotes()
    names = _check(choice, region, table, results)
    table = _columns_of(table, choice)
    quoted = _quoted(table, footnotes, as_printed, choice)  # first: its letters are the same whatever is measured
    measured = [
        block
        for shown in dict.fromkeys(choice.regions or (region,))
        for block in _measured(table, results, shown, bool(choice.regions), footnotes, choice)
    ]
    elsewhere = [_elsewhere(table, footnotes)] if table.elsewhere and not choice.rows else []
    blocks = (quoted, *elsewhere, *measured)
    tables = [_named(t, names, footnotes) for t in blocks if t.rows or not choice.rows]
    tables = [replace(t, name=f"{table.name}-{k + 1}") for k, t in enumerate(tables)]
    notes = [*table.notes]
    if not measured:
        protocols = dict.fromkeys(p for group in table.groups for p in group.protocols)
        notes.append(f"No measured rows: no finished run under {', '.join(protocols)} was found.")
    notes += [f"Left out: {line}." for line in left_out]
    letters = {letter: text for text, letter in footnotes.letters.items()}
    return Frame(table.name, table.title, table.source, tuple(tables), letters, tuple(notes))


# ---------------------------------------------------------------------------------------------------- quoted rows


def _check(choice: Choice, region: str, table: PaperTable, results: Sequence[RunResult]) -> dict[str, str]:
    """Label -> the new name of a row. Raises `BadInput` for words that name nothing here."""
    labels = {row.name: row.name for row in table.rows}
    for runs in _by_kind(table, results).values():
        labels |= {label: having[0].method for label, having in by_label(_configured(runs)).items()}
    having = [i for run in results for scores in run.rows.values() for i in scores]
    regions = list(dict.fromkeys([*REGIONS, *(i.region for i in having)]))
    if region and region not in regions:
        raise BadInput(f"--region {region}: there is none here: {nearest(region, regions)}")
    choice.check(labels, [column.key for column in table.columns], regions)
    return choice.renamed(labels)


def _columns_of(table: PaperTable, choice: Choice) -> PaperTable:
    """The table with the chosen metrics alone."""
    if not choice.metrics:
        return table
    kept = [choice.has_metric(column.key) for column in table.columns]

    def narrowed(rows: tuple[PaperRow, ...]) -> tuple[PaperRow, ...]:
        return tuple(replace(row, cells=tuple(compress(row.cells, kept))) for row in rows)

    groups = [
        replace(group, columns=tuple(column for column in group.columns if choice.has_metric(column.key)))
        for group in table.groups
    ]
    groups = tuple(group for group in groups if group.columns)
    return replace(table, groups=groups, rows=narrowed(table.rows), elsewhere=narrowed(table.elsewhere))


def _named(table: Table, names: Mapping[str, str], footnotes: Footnotes) -> Table:
    """The table with the rows' chosen names and their letters; switches that set a row apart become a footnote."""
    labels, rows = [], []
    for label, row in zip(table.labels, table.rows, strict=True):
        name, switches = split_label(label.name)
        if label.name in names or label.bound or not switches:
            name, switches = names.get(label.name, label.name), ""
        shown: str | Span = emphasis(name) if label.bound else name
        said = [piece.text for piece in spans(row[0])[1:] if isinstance(piece, Span)]
        said += [footnotes.letter(switches)] if switches else []
        rows.append(((shown, Span(", ".join(said), "raised")) if said else shown, *row[1:]))
        labels.append(replace(label, name=names.get(label.name, label.name)))
    return replace(table, labels=tuple(labels), rows=tuple(rows))


def _quoted(table: PaperTable, footnotes: Footnotes, as_printed: bool, choice: Choice) -> Table:
    names = choice.ordered({row.name: row.name for row in table.rows})
    table = replace(table, rows=tuple(next(row for row in table.rows if row.name == name) for name in names))
    marks: list[list[str]]
    if as_printed:
        marks = [[row.printed if cell.status != "absent" else "" for cell in row.cells] for row in table.rows]
    else:
        columns = [
            marks_by_value([row.cells[k].value for row in table.rows], column.metric.higher_is_better)
            for k, column in enumerate(table.columns)
        ]
        marks = [[column[j] for column in columns] for j in range(len(table.rows))]
    rows = []
    for row, marked in zip(table.rows, marks, strict=True):
        cells = []
        for cell, mark in zip(row.cells, marked, strict=True):
            absent = cell.status == "absent"
            reason = "not available in the paper" if absent else ""
            letters = footnotes.of(table.footnotes[key] for key in cell.footnotes)
            text = "—" if absent else cell.text
            cells.append(Number(text, cell.value, cell.status, mark=mark, reason=reason, footnotes=letters))
        status = next((c.status for c in row.cells if c.status in ("reported", "quoted")), row.cells[0].status)
        rows.append((row.name, status, *(YES if has else NO for has in row.components), *cells))
    own, others = (any(row[1] == status for row in rows) for status in ("reported", "quoted"))
    absent = any(cell.status == "absent" for row in table.rows for cell in row.cells)
    marked = "computed from the printed values alone: the paper gives no intervals, so none of them is known to be"
    notes = [
        *["reported: the paper about its own method."] * own,
        *["quoted: the paper about somebody else's method."] * others,
        *["—: not available in the paper."] * absent,
        "Marks are the paper's own." if as_printed else f"Marks are {marked} beyond chance.",
        *(group.note for group in table.groups if group.note and not group.measured_only),
    ]
    parts = _parts(table)
    return Table(
        (table.head, "status", *parts, *table.columns),
        tuple(rows),
        left=2,
        ticks=len(parts),
        labels=tuple(RowLabel(row.name, row.section) for row in table.rows),
        title="Quoted from the paper, not measured here",
        kind="quoted",
        notes=tuple(notes),
    )


def _elsewhere(table: PaperTable, footnotes: Footnotes) -> Table:
    """What other publications print, each row with its source. Nothing is marked: the rows are of several sources."""
    rows = []
    for row in table.elsewhere:
        cells = [
            Number("—", math.nan, "absent", reason="not noted from there")
            if cell.status == "absent"
            else Number(cell.text, cell.value, cell.status)
            for cell in row.cells
        ]
        source = Span(footnotes.letter(f"Source: {row.source}."), "raised")
        rows.append(((row.name, source), "quoted", *[NO] * len(_parts(table)), *cells))
    return Table(
        (table.head, "status", *_parts(table), *table.columns),
        tuple(rows),
        left=2,
        ticks=len(_parts(table)),
        labels=tuple(RowLabel(row.name, row.section) for row in table.elsewhere),
        title="Quoted from elsewhere, not measured here",
        kind="quoted elsewhere",
        notes=(
            "As other publications print them; whether their protocol is the paper's is not known.",
            "printed otherwise: a row of the paper, with the cells that differ there. —: not noted from there.",
        ),
    )


def _parts(table: PaperTable) -> list[str]:
    """Components that the paper's own rows tell of."""
    return [part.name for part in table.components if not part.measured_only]


# -------------------------------------------------------------------------------------------------- measured rows


def _by_kind(table: PaperTable, results: Sequence[RunResult]) -> dict[tuple[bool, str], list[RunResult]]:
    """(whether on a stand-in, profile) -> runs under the table's protocols."""
    protocols = {protocol for group in table.groups for protocol in group.protocols}
    runs = (run for run in results if run.identity.protocol_id in protocols)
    return grouped(((bool(run.about.standin), run.identity.profile), run) for run in runs)


def _configured(runs: Sequence[RunResult]) -> list[RunResult]:
    """A run that failed early never said how it was configured: it is told of, but belongs to no row."""
    return [run for run in runs if run.about.changed is not None]


def _measured(
    table: PaperTable,
    results: Sequence[RunResult],
    region: str,
    named: bool,  # whether the title names the region
    footnotes: Footnotes,
    choice: Choice,
) -> Iterator[Table]:
    """A block for each profile, on real data first; further ones where runs of one data set differ in protocol or
    stand-in."""
    by_kind = _by_kind(table, results)
    for standin, profile in sorted(by_kind):
        runs = by_kind[standin, profile]
        # runs of one data set under several protocols, digests, stand-ins or variants go into several blocks
        by_protocol = grouped((run.identity.protocol_id, run.group) for run in runs)
        keys = [
            list(dict.fromkeys(k for name in g.protocols for k in by_protocol.get(name, ()))) for g in table.groups
        ]
        for k in range(max(map(len, keys))):
            filled = [
                (group, [run for run in runs if run.group == having[k]])
                for group, having in zip(table.groups, keys, strict=True)
                if k < len(having)
            ]
            block = _measured_block(table, filled, standin, profile, region, footnotes, choice)
            yield replace(block, title=f"{block.title}, region {region}") if named else block


def _measured_block(
    table: PaperTable,
    filled: Sequence[tuple[Group, list[RunResult]]],  # a data set and its runs, done or not
    standin: bool,
    profile: str,
    region: str,
    footnotes: Footnotes,
    choice: Choice,
) -> Table:
    everything = list({id(run): run for _, runs in filled for run in runs}.values())
    labelled = _in_the_papers_order(table, by_label(_configured(everything)))
    order = choice.ordered({label: having[0].method for label, having in labelled.items()})
    labelled = {label: labelled[label] for label in order}
    kind: Kind = "stand-in" if standin else "real data"
    notes: list[str] = []
    if standin:
        made = ", ".join(dict.fromkeys(run.about.standin or "" for run in everything))
        notes.append(
            f"Made on {made}: procedural people of the bench in the data set's layout, not the data set. These "
            "numbers compare rows of this block with each other and with nothing else."
        )
    unlabelled = [run for run in everything if run.about.changed is None]
    notes += [f"Not done: {run.method} on {_outcome(run)}." for run in unlabelled]
    columns: list[list[Number]] = []  # by column, then by row
    calibrations = choice.bounds([name for name in ROWS if any(name in run.rows for run in everything)])
    systems, set_aside = as_the_profile_has_it(labelled)
    notes += set_aside
    for group, runs in filled:
        done = [run for run in runs if run.status == "done"]
        here = {id(run) for run in runs}
        shown_region = region or (done[0].headline if done else "")
        identities = [_identity(done, group, column.key, shown_region) for column in group.columns]
        notes += _about(group, runs, done, shown_region, identities)
        for column, identity in zip(group.columns, identities, strict=True):
            ranked = [
                _cell(
                    column, [run for run in having if id(run) in here], done, group.views, identity, kind, footnotes
                )
                for having in labelled.values()
            ]
            marks = marks_by_interval(
                list(labelled),
                [column.rounded(cell.value) for cell, _ in ranked],
                [scenes for _, scenes in ranked],
                column.metric.higher_is_better,
                LEVEL,
            )
            if marks.withheld:
                notes.append(f"{column.group}, {column.metric.title}: {marks.withheld}.")
            scores = zip(labelled, (scenes for _, scenes in ranked), strict=True)
            notes += rank_note(table, column, {systems[label]: s for label, s in scores if label in systems})
            cells = [replace(cell, mark=mark) for (cell, _), mark in zip(ranked, marks.marks, strict=True)]
            for name in calibrations:
                row = group_row(name, group.views)
                cells.append(_bound(column, done, row, identity, kind, footnotes))
            columns.append(cells)
        by_region = {
            (where, column): {
                method: _finite(group, [run for run in labelled[label] if id(run) in here], column.key, where)
                for label, method in systems.items()
            }
            for where in dict.fromkeys(i.region for run in done for i in run.own)
            for column in group.columns
        }
        notes += beaten_notes(table, group.name, by_region)
    parts = [tuple(_component(part, having) for part in table.components) for having in labelled.values()]
    parts += [(NO,) * len(table.components)] * len(calibrations)
    labels = [*map(RowLabel, labelled), *(RowLabel(name, bound=True) for name in calibrations)]
    said = {spec.name: spec.footnote for spec in usable_specs() if spec.footnote}
    names: list[str | tuple[str | Span, ...]] = [label.name for label in labels]
    for k, (label, having) in enumerate(labelled.items()):
        of_method = [said[having[0].method]] if having[0].method in said else []
        done = [run for run in having if run.status == "done"]
        if letters := footnotes.of([*of_method, *row_footnotes(done)]):
            names[k] = (label, Span(", ".join(letters), "raised"))
    rows = [(names[k], MEASURED[kind], *parts[k], *(cells[k] for cells in columns)) for k in range(len(labels))]
    notes.append(
        f"Mean over seeds within a scene, then over scenes, with the {LEVEL:.0%} interval over scenes. A mark says "
        "that the row differs from every other one over common scenes (interval of the paired difference)."
    )
    notes += [f"{name}: {DESCRIPTIONS[name]}; a bound, not ranked." for name in calibrations]
    title = f"Measured here on {'STAND-INS, not on real data' if standin else 'real data'}, {profile} profile"
    shown = [column for group, _ in filled for column in group.columns]
    return Table(
        (table.head, "status", *(part.name for part in table.components), *shown),
        tuple(rows),
        left=2,
        ticks=len(table.components),
        labels=tuple(labels),
        title=title,
        kind=kind,
        paired=True,
        notes=tuple(notes),
    )


def _in_the_papers_order(table: PaperTable, labelled: dict[str, list[RunResult]]) -> dict[str, list[RunResult]]:
    """Rows of the paper's systems in its order, others behind them."""

    def place(item: tuple[str, list[RunResult]]) -> int:
        rows = (k for k, row in enumerate(table.rows) if row.is_of(item[1][0].method))
        return next(rows, len(table.rows))

    return dict(sorted(labelled.items(), key=place))


def _finite(group: Group, runs: Sequence[RunResult], metric: str, region: str) -> dict[str, float]:
    """Scene -> finite mean over seeds of a metric in a region; empty where there is none."""
    done = [run for run in runs if run.status == "done"]
    identity = _identity(done, group, metric, region)
    if identity is None:
        return {}
    means = scene_means(done, identity, group_row(done[0].method, group.views))
    return {scene: mean.value for scene, mean in means.items() if math.isfinite(mean.value)}


def _identity(done: Sequence[RunResult], group: Group, metric: str, region: str) -> Identity | None:
    """The first definition of a metric in a region that these runs have; one with numbers before one without."""
    rows = [run.rows.get(group_row(run.method, group.views), {}) for run in done]
    identities = [i for row in rows for i in row if (i.metric, i.region) == (metric, region)]
    present = [i for i in identities if any(i in row and not row[i].absent for row in rows)]
    return next(iter(present or identities), None)


def _cell(
    column: Column,
    runs: Sequence[RunResult],
    block: Sequence[RunResult],  # the finished ones of all rows
    views: str,
    identity: Identity | None,
    kind: Kind,
    footnotes: Footnotes,
) -> tuple[Number, dict[str, float]]:
    """A method's cell, and its finite means by scene."""
    done = [run for run in runs if run.status == "done"]
    if not done:
        why = "; ".join(dict.fromkeys(_outcome(run) for run in runs)) or f"not run on {column.group}"
        return _absent(why, footnotes), {}
    if identity is None:
        return _absent(f"{column.metric.title} was not computed in this region", footnotes), {}
    means = scene_means(done, identity, group_row(done[0].method, views))
    if not means:
        return _absent(f"not scored as {identity}", footnotes), {}
    cell = _filled(column, means, identity, kind, footnotes)
    remarks = [_outcome(run) for run in runs if run.status != "done"]
    scored = [(run.scene, run.rows.get(group_row(run.method, views), {}).get(identity)) for run in done]
    remarks += [lacks] if (lacks := lacking(done, block)) else []
    remarks += [f"{scene}: {mean.note}" for scene, mean in scored if mean is not None and mean.note]
    cell = replace(cell, footnotes=(*cell.footnotes, *footnotes.of(dict.fromkeys(remarks))))
    return cell, {scene: mean.value for scene, mean in means.items() if math.isfinite(mean.value)}


def _bound(
    column: Column, done: Sequence[RunResult], row: str, identity: Identity | None, kind: Kind, footnotes: Footnotes
) -> Number:
    """A calibration row's cell: the same for every run on a scene."""
    if identity is None or not (means := scene_means(done, identity, row)):
        return _absent(f"not scored on {column.group}", footnotes)
    return replace(_filled(column, means, identity, kind, footnotes), interval="", low=math.nan, high=math.nan)


def _filled(
    column: Column, means: Mapping[str, Mean], identity: Identity, kind: Kind, footnotes: Footnotes
) -> Number:
    total, scale = macro_mean(means), column.metric.scale
    if total.absent:
        return _absent(total.reason, footnotes)
    finite = {scene: mean.value for scene, mean in means.items() if math.isfinite(mean.value)}
    value, low, high, shown = total.value * scale, math.nan, math.nan, ""
    if len(finite) > 1:
        interval: Interval = mean_interval(finite, LEVEL)
        low, high = interval.low * scale, interval.high * scale
        shown = f"[{column.text(low, value)}, {column.text(high, value)}]"
    letters = footnotes.of([f"over scenes: {total.note}"] if total.note else [])
    return Number(
        column.text(value), value, MEASURED[kind], shown, low, high, max(len(finite), 1), identity=str(identity),
        footnotes=letters,
    )  # fmt: skip


def _absent(reason: str, footnotes: Footnotes) -> Number:
    return Number("—", math.nan, "absent", reason=reason, footnotes=footnotes.of([reason]))


def _outcome(run: RunResult) -> str:
    reason = f" ({run.reason})" if run.reason else ""
    return f"{run.scene}, seed {run.seed}: {run.status}{reason}"


def _about(
    group: Group,
    runs: Sequence[RunResult],
    done: Sequence[RunResult],
    region: str,
    identities: Sequence[Identity | None],
) -> list[str]:
    """What the numbers of one data set are."""
    protocol, digest, _, data = runs[0].group
    scenes = sorted({run.scene for run in done})
    subjects = runs[0].about.subjects
    whole = len(subjects.standin if runs[0].about.standin else subjects.names)
    counted = f"{len(scenes)} of {whole} scenes" if whole else f"{len(scenes)} scenes"
    seeds = sorted({run.seed for run in done})
    views = f", views of training ({group.views})" if group.views else ""
    notes = [
        f"{group.name}: {protocol} (digest {digest}), {data}; region {region or 'none'}{views}; "
        f"{counted} ({', '.join(scenes) or 'none'}); seeds {', '.join(map(str, seeds)) or 'none'}."
    ]
    known = [str(identity) for identity in identities if identity is not None]
    return [*notes, f"{group.name}: {', '.join(known)}."] if known else notes


# ------------------------------------------------------------------------------------------- components of a method


def _component(component: Component, runs: Sequence[RunResult]) -> str:
    """Whether these runs of one configuration had it. A scene's plan may have left it out: then it is told as not
    there; where scenes differ, or where the method has no such switch, as unknown."""
    names = {*component.on, *component.equal, component.several} - {""}
    if any(not names <= run.switches.keys() for run in runs):
        return UNKNOWN
    states = {
        all(switches[name] for name in component.on)
        and all(switches[name] == value for name, value in component.equal.items())
        and not any(switches.get(name) for name in component.off)
        and (not component.several or len(np.atleast_1d(switches[component.several])) > 1)
        for switches in (run.switches for run in runs)
    }
    return UNKNOWN if len(states) != 1 else YES if states.pop() else NO
