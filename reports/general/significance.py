"""Intervals and paired comparisons over scenes, in the headline region.

Frames of one person are not independent: the scene is the unit, and every number here is over scenes' means.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from ihbench.document.document import Block, Heading, Paragraph, Table, Words, bullets
from ihbench.document.metric_names import heads, named
from ihbench.metrics import Identity, macro_mean
from ihbench.metrics.identity import Metric
from ihbench.metrics.statistics import Interval, holm, mean_interval, paired_test, smallest_detectable_difference
from ihbench.record.results import RunResult
from ihbench.record.scene_means import per_scene, scene_means

LEVEL = 0.95
ALPHA = 0.05
POWER = 0.8


def intervals_section(
    by_label: Mapping[str, Sequence[RunResult]],  # a table row's label -> its runs
    identities: Sequence[Identity],
    headline: str,
) -> list[Block]:
    """A table of means with intervals, and the comparisons; nothing where there is but one scene."""
    columns = [i for i in identities if i.region == headline]
    values = {i: {label: per_scene(runs, i) for label, runs in by_label.items()} for i in columns}
    columns = [i for i in columns if any(len(found) >= 2 for found in values[i].values())]
    if not columns:
        return []
    rows: list[tuple[Words, ...]] = []
    methods: set[str] = set()
    for label in by_label:
        cells = []
        for i in columns:
            found = values[i][label]
            if not found:
                cells.append("—")
                continue
            interval = mean_interval(found, LEVEL)
            methods.add(interval.method)
            cells.append(interval_text(interval, i.display.text))
        rows.append((label, *cells))
    names = named(columns)
    head = ("method", *heads(columns).values())
    return [
        Heading(3, f"{headline}: mean over scenes and {LEVEL:.0%} interval"),
        Table(head, tuple(rows)),
        Paragraph(f"Intervals: {'; '.join(sorted(methods))}."),
        *bullets([line for i in columns for line in _comparisons(values[i], i.display, names[i])]),
    ]


def interval_text(interval: Interval, text: Callable[[float], str]) -> str:
    """ "24.65 [23.90, 25.40]"; the value alone where there is no interval."""
    ends = f" [{text(interval.low)}, {text(interval.high)}]" if math.isfinite(interval.low) else ""
    return text(interval.value) + ends


def score_cells(runs: Sequence[RunResult], identities: Sequence[Identity], row: str) -> list[str]:
    """A row of these runs as a table shows it: of each identity the mean over seeds of a scene, then over scenes."""
    means = [(i, scene_means(runs, i, row)) for i in identities]
    return [i.display.text(macro_mean(mean).value) if mean else "—" for i, mean in means]


def further_rows(runs: Sequence[RunResult]) -> list[str]:
    """Rows of groups of test views that the protocol scores apart from the method's own."""
    return list(dict.fromkeys(row for run in runs for row in run.rows if row.startswith(f"{run.method} [")))


def _comparisons(values: Mapping[str, Mapping[str, float]], metric: Metric, name: str) -> list[str]:
    """The best row against every other over the scenes that both have, p values adjusted for their number."""
    having = {label: pair for label, pair in values.items() if len(pair) >= 2}
    if len(having) < 2:
        return []
    sign = 1 if metric.higher_is_better else -1
    best = max(having, key=lambda label: sign * math.fsum(having[label].values()) / len(having[label]))
    tests = {}
    for label, pair in having.items():
        common = sorted(set(having[best]) & set(pair))
        if label != best and len(common) >= 2:
            a, b = ({scene: rows[scene] for scene in common} for rows in (having[best], pair))
            tests[label] = paired_test(a, b), [a[scene] - b[scene] for scene in common]
    if not tests:
        return []
    adjusted = dict(zip(tests, holm([test.p for test, _ in tests.values()]), strict=True))
    # what is left of it where every test gives the smallest p that its number of scenes allows
    least = dict(zip(tests, holm([test.smallest_p for test, _ in tests.values()]), strict=True))
    unit = f" {metric.unit}" if metric.unit == "dB" else ""
    lines = []
    for label, (test, differences) in tests.items():
        smallest = smallest_detectable_difference(differences, ALPHA / len(tests), POWER) * metric.scale
        spread = ""
        if math.isfinite(test.interval.low):
            low, high = (value * metric.scale for value in (test.interval.low, test.interval.high))
            spread = f" [{low:+.{metric.decimals}f}, {high:+.{metric.decimals}f}]"
        if least[label] >= ALPHA:
            n = len(differences)
            verdict = f"cannot be significant: {n} scenes allow no adjusted p below {least[label]:.2g}"
        else:
            verdict = (
                f"{'significant' if adjusted[label] < ALPHA else 'not significant'}; a true difference of "
                f"{smallest:.{metric.decimals}f}{unit} would be found {POWER:.0%} of the time (t test)"
            )
        lines.append(
            f"{name}: {best} against {label}: "
            f"{test.interval.value * metric.scale:+.{metric.decimals}f}{spread}{unit}, "
            f"p = {adjusted[label]:.2g} (sign-flip test over {len(differences)} scenes, Holm over {len(tests)}), "
            f"{verdict}"
        )
    return lines
