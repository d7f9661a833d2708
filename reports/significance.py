"""Intervals and paired comparisons over scenes, in the headline region.

Frames of one person are not independent: the scene is the unit, and every number here is over scenes' means.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from ihbench.metrics import Identity, macro_mean
from ihbench.metrics.identity import Metric, metric_of
from ihbench.metrics.statistics import holm, mean_interval, paired_test, smallest_detectable_difference
from ihbench.results import RunResult

LEVEL = 0.95
ALPHA = 0.05
POWER = 0.8


def intervals_section(
    by_label: Mapping[str, Sequence[RunResult]],  # a table row's label -> its runs
    identities: Sequence[str],
    headline: str,
) -> list[str]:
    """Lines of Markdown; none where there is but one scene."""
    columns = [i for i in identities if Identity.parse(i).region == headline]
    values = {i: {label: _per_scene(runs, i) for label, runs in by_label.items()} for i in columns}
    columns = [i for i in columns if any(len(found) >= 2 for found in values[i].values())]
    if not columns:
        return []
    lines = ["", f"### {headline}: mean over scenes and {LEVEL:.0%} interval", ""]
    lines.append("| method | " + " | ".join(f"{metric_of(i).title} {metric_of(i).arrow}" for i in columns) + " |")
    lines.append("|---|" + "---:|" * len(columns))
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
            text = metric_of(i).text
            shown = text(interval.value)
            if math.isfinite(interval.low):
                shown += f" [{text(interval.low)}, {text(interval.high)}]"
            cells.append(shown)
        lines.append(f"| {label} | " + " | ".join(cells) + " |")
    lines += ["", f"Intervals: {'; '.join(sorted(methods))}."]
    for i in columns:
        lines += _comparisons(values[i], metric_of(i))
    return lines


def _per_scene(runs: Sequence[RunResult], identity: str) -> dict[str, float]:
    """Scene -> mean over its runs (seeds); scenes without a finite number are left out."""
    by_scene: dict[str, dict[str, object]] = {}
    for k, run in enumerate(runs):
        mean = run.rows[run.method].get(identity)
        if mean is not None:
            by_scene.setdefault(run.scene, {})[str(k)] = mean
    means = {scene: macro_mean(found).value for scene, found in by_scene.items()}  # type: ignore[arg-type]
    return {scene: value for scene, value in means.items() if math.isfinite(value)}


def _comparisons(values: Mapping[str, Mapping[str, float]], metric: Metric) -> list[str]:
    """The best row against every other over the scenes that both have, p values adjusted for their number."""
    having = {label: found for label, found in values.items() if len(found) >= 2}
    if len(having) < 2:
        return []
    sign = 1 if metric.higher_is_better else -1
    best = max(having, key=lambda label: sign * math.fsum(having[label].values()) / len(having[label]))
    tests = {}
    for label, found in having.items():
        common = sorted(set(having[best]) & set(found))
        if label != best and len(common) >= 2:
            a, b = ({scene: rows[scene] for scene in common} for rows in (having[best], found))
            tests[label] = paired_test(a, b), [a[scene] - b[scene] for scene in common]
    if not tests:
        return []
    adjusted = dict(zip(tests, holm([test.p for test, _ in tests.values()]), strict=True))
    unit = f" {metric.unit}" if metric.unit == "dB" else ""
    lines = []
    for label, (test, differences) in tests.items():
        smallest = smallest_detectable_difference(differences, ALPHA, POWER) * metric.scale
        spread = ""
        if math.isfinite(test.interval.low):
            low, high = (value * metric.scale for value in (test.interval.low, test.interval.high))
            spread = f" [{low:+.{metric.decimals}f}, {high:+.{metric.decimals}f}]"
        verdict = "significant" if adjusted[label] < ALPHA else "not significant"
        if test.smallest_p >= ALPHA:
            verdict = f"cannot be significant: {len(differences)} scenes allow no p below {test.smallest_p:.2g}"
        lines.append(
            f"- {metric.title}: {best} against {label}: "
            f"{test.interval.value * metric.scale:+.{metric.decimals}f}{spread}{unit}, "
            f"p = {adjusted[label]:.2g} (sign-flip test over {len(differences)} scenes, Holm over {len(tests)}), "
            f"{verdict}; a true difference of {smallest:.{metric.decimals}f}{unit} would be found "
            f"{POWER:.0%} of the time"
        )
    return lines
