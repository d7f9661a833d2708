"""The headline of some runs for a terminal: one table of at most 80 columns, then where the pictures are."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from rich.cells import cell_len, set_cell_size

from ihbench.document.document import Block, Heading, Paragraph, Table, bullets
from ihbench.document.metric_names import heads, named
from ihbench.errors import visible
from ihbench.metrics import Identity
from ihbench.record.results import TRACEBACK, NotRun, RunResult, by_group
from ihbench.record.row_labels import by_label
from ihbench.reports.general.clock import mean_cost, three_digits, waited
from ihbench.reports.general.remarks import lacking
from ihbench.reports.general.significance import further_rows, score_cells
from ihbench.scoring.calibration import ROWS

WIDTH = 80
NARROWEST = 40
NAME = 18  # columns that a row's name gets at least
GAP = 2
COSTS = ("fit s", "render ms")
LACKS = " †"  # at the name of a row over fewer scenes or seeds than others have
SHOWN = 6  # pictures, and runs that are not done, that are named one by one


def write(
    results: Sequence[RunResult],
    left_out: Sequence[str] = (),
    width: int = WIDTH,
    not_run: Sequence[NotRun] = (),
) -> str:
    """Lines of at most `width` columns, but for paths, which are whole: of every protocol, profile and kind of data
    the headline region's metrics by row, methods before calibration rows; runs that are not done; contact sheets.
    A method of which no run is done has a row without numbers."""
    width = max(NARROWEST, min(width, WIDTH))
    lines: list[str] = []
    for runs in by_group(results).values():
        protocol, _, profile, _ = runs[0].group
        missing = [run.method for run in not_run if (run.protocol, run.profile) == (protocol, profile)]
        lines += [*_group(runs, width, missing), ""]
    unfinished = [run for run in results if run.status != "done"]
    for run in unfinished[:SHOWN]:
        reason = f" ({run.reason})" if run.reason else ""
        lines += _wrapped(f"not done: {run.method} on {run.scene}: {run.status}{reason}", width)
        traceback = run.folder / TRACEBACK
        lines.append(f"see {visible(str(traceback if traceback.is_file() else run.folder))}")
    for run in not_run[:SHOWN]:
        lines += _wrapped(f"not run: {run.method} on {run.scene}: {run.reason}", width)
    if len(not_run) > SHOWN:
        lines.append(f"not run: {len(not_run) - SHOWN} more")
    if len(unfinished) > SHOWN:
        lines.append(f"not done: {len(unfinished) - SHOWN} more runs")
    sheets = [run.folder / "contact_sheet.png" for run in results if run.status == "done"]
    sheets = [sheet for sheet in sheets if sheet.is_file()]
    lines += [f"contact sheet: {visible(str(sheet))}" for sheet in sheets[:SHOWN]]
    if len(sheets) > SHOWN:
        lines.append(f"contact sheet: {len(sheets) - SHOWN} more in the run folders")
    if left_out:
        note = f"left out: {len(left_out)} folder{'s' * (len(left_out) > 1)}; --full says which and why"
        lines += _wrapped(note, width)
    lines += _wrapped("all regions, seconds, notes and tests: --full", width)
    return "\n".join(lines) + "\n"


def headline_section(results: Sequence[RunResult]) -> list[Block]:
    """The same tables for the top of a page; nothing where no run is done."""
    blocks: list[Block] = []
    for runs in by_group(run for run in results if run.status == "done").values():
        protocol, _, profile, data = runs[0].group
        headline = runs[0].headline
        own = [run.own for run in runs]
        identities = [i for i in dict.fromkeys(i for means in own for i in means) if i.region == headline]
        present = [i for i in identities if any(i in means and not means[i].absent for means in own)]
        head = ("method", *heads(present).values(), COSTS[0])
        rows = tuple((name, *cells[:-1]) for name, cells in _rows(runs, present))  # the others are below it
        scenes = sorted({run.scene for run in runs})
        note = (
            f"{protocol}, {profile} profile, {data}; region {headline}, mean over test views of {', '.join(scenes)}."
        )
        note += f" {words}." if (words := waited(runs)) else ""
        blocks += [Paragraph(note), Table(head, rows), *bullets(_lacking(runs))]
    return [Heading(2, "Headline"), *blocks] if blocks else []


def _group(runs: Sequence[RunResult], width: int, not_run: Sequence[str]) -> list[str]:
    protocol, _, profile, data = runs[0].group
    title = _wrapped(f"{protocol}, {profile} profile, {data}", width)
    done = [run for run in runs if run.status == "done"]
    if not done:
        return title
    headline = done[0].headline
    identities = dict.fromkeys(i for run in done for i in run.own)
    in_headline = [i for i in identities if i.region == headline]
    own = [run.own for run in done]
    present = [i for i in in_headline if any(i in means and not means[i].absent for means in own)]
    rows = _rows(done, present)
    without = dict.fromkeys([*(run.method for run in runs), *not_run])
    without = [method for method in without if not any(run.method == method for run in done)]
    bounds = next((k for k, (name, _) in enumerate(rows) if name in ROWS), len(rows))
    rows[bounds:bounds] = [(method, ["—"] * len(present) + ["—", ""]) for method in without]
    titles = [*heads(present).values(), *COSTS]
    table = [(visible(name), cells) for name, cells in [(f"region {headline}", titles), *rows]]
    sizes = [max(cell_len(cells[k]) for _, cells in table) for k in range(len(titles))]
    kept = list(range(len(titles)))
    if not any(cells[-1] for _, cells in rows) or NAME + sum(sizes[k] + GAP for k in kept) > width:
        kept.pop()  # first what drawing takes
    while len(kept) > 1 and NAME + sum(sizes[k] + GAP for k in kept) > width:
        kept.pop(-2)  # the last metric; the seconds stay
    room = width - sum(sizes[k] + GAP for k in kept)
    room = min(room, max(cell_len(name) for name, _ in table))
    lines = [
        (_cut(name, room) + "".join(" " * (GAP + sizes[k] - cell_len(cells[k])) + cells[k] for k in kept)).rstrip()
        for name, cells in table
    ]
    absent = [name for i, name in named(in_headline).items() if i not in present]
    absent += [titles[k] for k in range(len(present)) if k not in kept]
    scenes = sorted({run.scene for run in done})
    note = f"mean over test views of {', '.join(scenes) if len(scenes) <= SHOWN else f'{len(scenes)} scenes'}"
    note += f"; not shown: {', '.join(absent)}" if absent else ""
    note += f"; {words}" if (words := waited(done)) else ""
    reasons = dict.fromkeys(
        means[i].reason for i in in_headline if i not in present for means in own if i in means and means[i].reason
    )
    lacks = _lacking(done)
    lacks[SHOWN:] = [f"{LACKS.strip()} {len(lacks) - SHOWN} more rows: --full"] if len(lacks) > SHOWN else []
    why = [line for words in lacks for line in _wrapped(words, width)]
    why += [line for reason in reasons for line in _wrapped(reason, width)]
    return [*title, "", lines[0], "-" * max(map(cell_len, lines)), *lines[1:], "", *_wrapped(note, width), *why]


def _rows(done: Sequence[RunResult], identities: Sequence[Identity]) -> list[tuple[str, list[str]]]:
    """Name and cells of each row: the methods', with their further groups of test views, then the calibration's."""
    rows = []
    for label, group in by_label(done).items():
        method, mark = group[0].method, LACKS if lacking(group, done) else ""
        rows.append((label + mark, [*score_cells(group, identities, method), *_costs(group)]))
        further = further_rows(group)
        for row in further:
            rows.append((label + row.removeprefix(method) + mark, [*score_cells(group, identities, row), "", ""]))
    bounds = [row for row in ROWS if any(row in run.rows for run in done)]
    return [*rows, *((row, [*score_cells(done, identities, row), "", ""]) for row in bounds)]


def _lacking(done: Sequence[RunResult]) -> list[str]:
    """What the mark at a row's name says."""
    found = {label: lacking(group, done) for label, group in by_label(done).items()}
    return [f"{LACKS.strip()} {label}: {lacks}" for label, lacks in found.items() if lacks]


def _costs(runs: Sequence[RunResult]) -> list[str]:
    """Of `COSTS`: "—" for seconds that have no mean, nothing for milliseconds of which there are none."""
    seconds, drawing = (
        mean_cost(runs, of) for of in (lambda run: run.about.fit_seconds, lambda run: run.about.render_ms)
    )
    return ["—" if seconds is None else f"{seconds:.0f}", "" if drawing is None else three_digits(drawing)]


def _cut(name: str, room: int) -> str:
    """A name in exactly so many columns; of one that is cut its mark stays."""
    end = "…" + (LACKS if name.endswith(LACKS) else "")
    return set_cell_size(name, room) if cell_len(name) <= room else set_cell_size(name, room - cell_len(end)) + end


def _wrapped(text: str, width: int) -> list[str]:
    """Words in lines of at most so many columns; a word that is longer is broken."""
    lines: list[str] = []
    for line in textwrap.wrap(visible(text), width) or [""]:
        while cell_len(line) > width:  # wide letters, which textwrap counts as one
            head = line
            while cell_len(head) > width:
                head = head[:-1]
            lines.append(head)
            line = line[len(head) :]
        lines.append(line)
    return lines
