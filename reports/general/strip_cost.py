"""What the occlusion costs every system: the same people with and without it, where runs of both are there."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ihbench.document.document import Block, Heading, Paragraph, Table, Words
from ihbench.document.metric_names import heads
from ihbench.metrics import Identity
from ihbench.metrics.statistics import mean_interval
from ihbench.record.results import RunResult, grouped
from ihbench.record.row_labels import by_label
from ihbench.record.scene_means import per_scene
from ihbench.reports.general.significance import LEVEL, interval_text

CHANGE, NONE = "occlusion", "none"


def strip_cost_section(results: Sequence[RunResult]) -> list[Block]:
    """A table for every protocol of which there are runs with an occlusion and without any, by profile, data and
    occlusion; rows are those that both have. Nothing where no row is."""
    done = [run for run in results if run.status == "done"]
    blocks: list[Block] = []
    alike = grouped(((run.identity.protocol_without(CHANGE), run.identity.profile, run.data), run) for run in done)
    for (protocol, profile, data), runs in alike.items():
        by_protocol = grouped((run.identity.protocol, run) for run in runs)
        clear = [run for run in runs if run.identity.changes.get(CHANGE) == NONE]
        for name, occluded in by_protocol.items():
            if occluded[0].identity.changes.get(CHANGE) != NONE and clear:
                blocks += _table(protocol, name, f"{profile} profile, {data}", clear, occluded)
    return blocks


def _table(
    protocol: str, name: str, about: str, clear: Sequence[RunResult], occluded: Sequence[RunResult]
) -> list[Block]:
    headline = occluded[0].headline
    without, having = by_label(clear), by_label(occluded)
    common = [label for label in having if label in without]
    identities = dict.fromkeys(i for run in occluded for i in run.own if i.region == headline)
    rows: dict[str, list[Words]] = {}
    people: dict[str, set[str]] = {}
    head: list[Words] = ["method", "people"]
    methods: set[str] = set()
    titles = heads(identities)
    for identity in identities:
        cells = {label: _cells(without[label], having[label], identity) for label in common}
        if not any(cells.values()):
            continue
        head += [f"{titles[identity]} without", "with", f"cost [{LEVEL:.0%}]"]
        for label, found in cells.items():
            row = rows.setdefault(label, [])
            if found is None:
                row += ["—"] * 3
                continue
            scenes, texts, how = found
            people.setdefault(label, set()).update(scenes)
            methods |= {how} if how else set()
            row += texts
    if not people:
        return []
    occlusion = name.removeprefix(protocol).lstrip("+") or f"{CHANGE} as {protocol} has it"
    lines = [(label, str(len(people[label])), *row) for label, row in rows.items() if label in people]
    note = (
        f"Region {headline}, means over the people (scenes) that a row has both with and without the occlusion, and "
        "the difference, without minus with, of each person with itself. Where less is better the cost is turned: a "
        "positive one is always a loss."
    )
    note += f" Intervals: {'; '.join(sorted(methods))}." if methods else ""
    return [
        Heading(2, f"What the occlusion costs: {protocol}"),
        Paragraph(f"{occlusion}; {about}."),
        Table(tuple(head), tuple(lines), left=2),
        Paragraph(note),
    ]


def _cells(
    clear: Sequence[RunResult], occluded: Sequence[RunResult], identity: Identity
) -> tuple[list[str], list[Words], str] | None:
    """People, three cells and how the interval was found; None without a person that has both."""
    a, b = per_scene(clear, identity), per_scene(occluded, identity)
    common = sorted(set(a) & set(b))
    if not common:
        return None
    metric = identity.display
    sign = 1 if metric.higher_is_better else -1
    means = [math.fsum(values[scene] for scene in common) / len(common) for values in (a, b)]
    cost = mean_interval({scene: sign * (a[scene] - b[scene]) for scene in common}, LEVEL)
    how = cost.method if math.isfinite(cost.low) else ""
    return common, [*map(metric.text, means), interval_text(cost, metric.text)], how
