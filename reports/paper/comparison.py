"""What a block of measured rows says beside the paper: how its order agrees with the printed one, and where a system
is better than the paper's own."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime

from ihbench.metrics.statistics import mean_interval
from ihbench.record.results import RunResult, grouped
from ihbench.reports.general.significance import LEVEL
from ihbench.reports.paper.paper_numbers import Column, PaperTable
from ihbench.reports.paper.rank_agreement import better_than, rank_agreement

Scores = Mapping[str, Mapping[str, float]]  # method -> person (scene) -> mean over seeds, finite


def as_the_profile_has_it(labelled: Mapping[str, Sequence[RunResult]]) -> tuple[dict[str, str], list[str]]:
    """Label -> method of one row for each system, none of whose switches differ from the profile; and what is told of
    rows that are set aside. Of several, as of several versions of the code, the one with the most scenes counts, else
    the newest."""
    made = {label: runs for label, runs in labelled.items() if all(run.about.predictions is None for run in runs)}
    plain = [label for label, runs in made.items() if not any(run.about.changed for run in runs)]
    by_method = grouped((labelled[label][0].method, label) for label in plain)
    chosen = {method: max(rows, key=lambda row: _weight(labelled[row])) for method, rows in by_method.items()}
    notes = [
        f"{other}: not in the rank agreement and the comparisons: {chosen[method]} has "
        f"{'more scenes' if _weight(labelled[chosen[method]])[0] > _weight(labelled[other])[0] else 'newer runs'}."
        for method, rows in by_method.items()
        for other in rows
        if other != chosen[method]
    ]
    variants = grouped((runs[0].method, label) for label, runs in made.items() if label not in plain)
    notes += [
        f"{method}: not in the rank agreement and the comparisons: all its rows have other switches than the profile."
        for method in variants
        if method not in chosen
    ]
    return {label: method for method, label in chosen.items()}, notes


def _weight(runs: Sequence[RunResult]) -> tuple[int, datetime]:
    """How many scenes are done, and when the newest run was begun."""
    scenes = {run.scene for run in runs if run.status == "done"}
    return len(scenes), max(datetime.fromisoformat(run.record.outcome.created) for run in runs)


def rank_note(table: PaperTable, column: Column, scores: Scores) -> list[str]:
    """How the order of one column agrees with the paper's; nothing where the paper has none of these systems."""
    place = [(c.group, c.key) for c in table.columns]
    if (column.group, column.key) not in place:
        return []
    k = place.index((column.group, column.key))
    printed = {m: row.cells[k].value for m in scores for row in table.rows if row.is_of(m)}
    if not any(scores[method] and math.isfinite(value) for method, value in printed.items()):
        return []
    agreement = rank_agreement(printed, scores, LEVEL)
    if isinstance(agreement, str):
        agreement = f"none to be had: {agreement}"
    return [f"Rank agreement with the paper, {column.group}, {column.metric.title}: {agreement}."]


def beaten_notes(table: PaperTable, group: str, scores: Mapping[tuple[str, Column], Scores]) -> list[str]:
    """In which regions (region, column -> scores) which systems are better than the paper's own one."""
    own = next((row for row in table.rows if row.own), None)
    methods = list(dict.fromkeys(m for by_method in scores.values() for m, having in by_method.items() if having))
    ours = next((m for m in methods if own is not None and own.is_of(m)), None)
    if own is None or len(methods) < 2:
        return []
    if ours is None:
        return [f"{group}: {own.name} was not measured here as its profile has it: no system is compared with it."]
    notes: list[str] = []
    for region in dict.fromkeys(region for region, _ in scores):
        parts = [
            f"{column.metric.title}: {'; '.join(better)}"
            for (where, column), by_method in scores.items()
            if where == region and (better := list(_better(ours, column, by_method)))
        ]
        if parts:
            notes.append(f"{group}, region {region}: better than {ours}: {'. '.join(parts)}.")
    return notes or [f"{group}: no other system measured here is better than {ours} in any region by these metrics."]


def _better(ours: str, column: Column, scores: Scores) -> Iterator[str]:
    """ "gauhuman by 1.10 dB [0.31, 1.89], 6 people"."""
    metric = column.metric
    unit = f" {metric.unit}" if metric.unit == "dB" else ""
    for method, differences in better_than(ours, scores, metric.higher_is_better):
        sign = metric.scale if metric.higher_is_better else -metric.scale
        interval = mean_interval({person: sign * value for person, value in differences.items()}, LEVEL)
        n = len(differences)
        decimals = column.digits.decimals_of(interval.value)
        ends, doubt = "", ", one person"
        if math.isfinite(interval.low):
            ends = f" [{interval.low:.{decimals}f}, {interval.high:.{decimals}f}]"
            doubt = f", {n} people" + (", not beyond chance" if interval.low <= 0 else "")
        yield f"{method} by {interval.value:.{decimals}f}{unit}{ends}{doubt}"
