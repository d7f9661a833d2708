"""Error against run time: what a row costs and how wrong it is, which rows no other beats, time to a stated quality,
and area under the quality-time curve."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from ihbench.document.document import Block, Heading, Paragraph, Span, Table, Words, bullets
from ihbench.document.metric_names import heads, named, variants_told
from ihbench.metrics import Identity
from ihbench.metrics.statistics import Interval, mean_interval, median_interval
from ihbench.record.quality_time import (
    NEVER,
    QualityCurve,
    Target,
    area_under_curve,
    common_window,
    curve_of,
    error_of,
    pareto_set,
    round_targets,
    time_to_quality,
)
from ihbench.record.results import RunResult, grouped
from ihbench.record.scene_means import per_scene, seed_means
from ihbench.reports.general.clock import (
    clock_notes,
    fit_cpu_seconds,
    mean_cost,
    positive_interval,
    three_digits,
    waited,
)
from ihbench.reports.general.configurations import Configuration, configurations
from ihbench.reports.general.significance import LEVEL, interval_text

ON_THE_CURVE = ("psnr", "flip")  # targets are chosen for these where none is stated
SPREAD = f"{LEVEL:.0%}"
MOST_SETS = 60  # of scenes, whose pairs are looked at


@dataclass(frozen=True)
class WorkPoint:
    """One configuration in a work-precision diagram."""

    configuration: Configuration
    seconds: Interval  # of the fit
    value: Interval  # of the metric, not scaled
    error: Interval  # the same as an error, see `error_of`


def comparable(configs: Sequence[Configuration]) -> tuple[list[Configuration], list[str]]:
    """Configurations that can be compared, with their runs on the scenes that all of them were run on; these scenes.

    Where no scene is common to all, or few are, those rows stand back that lack what most others have: chosen are the
    scenes of one row, or what two have in common, with the most rows times scenes. Of very many different sets of
    scenes those are looked at that most rows have.
    """
    rows = Counter(frozenset(run.scene for run in c.runs) for c in configs)
    several = [scenes for scenes, _ in rows.most_common(MOST_SETS)] if len(rows) > MOST_SETS else list(rows)
    best, most = frozenset(), (0, 0)
    for scenes in dict.fromkeys(a & b for a in several for b in several if a & b):
        members = sum(count for having, count in rows.items() if scenes <= having)
        if (members * len(scenes), members) > most:
            best, most = scenes, (members * len(scenes), members)
    alike = [replace(c, runs=tuple(run for run in c.runs if run.scene in best)) for c in configs]
    return [c for c in alike if best and best == {run.scene for run in c.runs}], sorted(best)


def work_points(configs: Sequence[Configuration], identity: Identity) -> list[WorkPoint]:
    """Seconds and error of every configuration; those without a finite number are left out."""
    work_points = []
    for c in configs:
        if values := per_scene(c.runs, identity):
            value = mean_interval(values, LEVEL)
            error, *ends = (error_of(identity.metric, v) for v in (value.value, value.low, value.high))
            interval = replace(value, value=error, low=min(ends), high=max(ends))
            work_points.append(WorkPoint(c, seconds_interval(c.runs), value, interval))
    return work_points


def pareto(points: Iterable[WorkPoint]) -> list[int]:
    """See `pareto_set`."""
    costs = [(p.seconds.value, p.error.value) for p in points]
    return pareto_set([seconds for seconds, _ in costs], [error for _, error in costs])


def seconds_interval(runs: Sequence[RunResult], key: str = "fit_seconds") -> Interval:
    """Mean seconds with its interval, see `positive_interval`: over scenes (each the mean of its repeats), or over
    repeats of one scene."""
    seconds = grouped((run.scene, float(getattr(run.about, key))) for run in runs)
    repeats = {str(k): value for k, value in enumerate(next(iter(seconds.values())))}
    return positive_interval(seconds if len(seconds) > 1 else repeats, LEVEL)


def curves(configuration: Configuration, identity: Identity) -> dict[tuple[str, int], QualityCurve]:
    """(scene, seed) -> the run's curve; runs without such a curve are left out."""
    curve_by_run = {(run.scene, run.seed): curve_of(run.curve, identity) for run in configuration.runs}
    return {run: curve for run, curve in curve_by_run.items() if len(curve.values)}


def curve_identities(configs: Sequence[Configuration]) -> list[Identity]:
    """Identities that any run has a curve of, in the order of the file."""
    return list(dict.fromkeys(i for c in configs for run in c.runs for p in run.curve for i in p.scores))


def standing(runs: Iterable[RunResult]) -> str:
    """On how many of how many test views the curves of these runs stand: "6 of 55", "all 4"."""
    rows: set[tuple[int, int]] = set()
    for run in runs:
        tested = max((mean.total for mean in run.own.values()), default=0)
        for point in run.curve:
            rows.add((point.views, point.of or tested))
    texts = [f"all {of}" if 0 < views == of else f"{views or 'some'} of {of or 'more'}" for views, of in sorted(rows)]
    return " or ".join(texts)


def in_table(configuration: Configuration, identity: Identity, scenes: Container[str]) -> dict[str, float]:
    """Scene -> what the table has of these runs, over all test views: the mean over seeds, NaN where absent."""
    means = ((run.scene, run.own.get(identity)) for run in configuration.runs if run.scene in scenes)
    return seed_means((scene, math.nan if mean is None else mean.value) for scene, mean in means)


def run_time_section(
    runs: Sequence[RunResult], identities: Sequence[Identity], headline: str, targets: Sequence[Target] = ()
) -> list[Block]:
    """Seconds against error of the rows of one group; nothing where no run has a fit time."""
    configs = configurations(runs)
    if not configs:
        return []
    blocks: list[Block] = [Heading(3, "Error against run time")]
    blocks += _cost_table(configs, identities, headline)
    blocks += _quality_times(configs, headline, targets)
    return blocks + bullets(clock_notes({c.label: c.runs for c in configs}))


def across_sizes_section(results: Sequence[RunResult]) -> list[Block]:
    """Where one protocol was run under several profiles or image sizes: their rows side by side, with a warning."""
    blocks: list[Block] = []
    for (name, _), runs in same_protocol(results).items():
        headline = runs[0].headline
        identities = list(dict.fromkeys(i for run in runs for i in run.own))
        configs = configurations(runs, across=True)
        if len(comparable(configs)[0]) > 1:
            table = _cost_table(configs, identities, headline)
            warning = (
                "Profiles and image sizes are scored on test images of different size, maybe of different views: "
                "their seconds can be compared, their errors only with care."
            )
            blocks += [Heading(2, f"{name}: profiles and image sizes"), Paragraph(warning), *table]
    return blocks


def same_protocol(results: Sequence[RunResult]) -> dict[tuple[str, str], list[RunResult]]:
    """(protocol, data) -> finished runs under it, whatever their profile and image size, where there are several."""
    timed = (run for run in results if run.status == "done" and run.timed)
    groups = grouped(((run.identity.protocol_without("size"), run.data), run) for run in timed)
    return {
        key: runs
        for key, runs in groups.items()
        if len({(run.identity.protocol, run.identity.profile) for run in runs}) > 1
    }


def _cost_table(configs: Sequence[Configuration], identities: Sequence[Identity], headline: str) -> list[Block]:
    labels, (configs, scenes) = [c.label for c in configs], comparable(configs)
    points = {
        i: {p.configuration.label: p for p in work_points(configs, i)} for i in identities if i.region == headline
    }
    points = {i: row for i, row in points.items() if row}
    names = named(points)
    best = grouped(([*row][k], names[i]) for i, row in points.items() for k in pareto(row.values()))
    every = [run for c in configs for run in c.runs]
    on_gpu = any(_device_mb(run) > 0 for run in every)
    of_cpu = any(fit_cpu_seconds(run) is not None for run in every)
    seconds = {c.label: seconds_interval(c.runs) for c in configs}
    rows: list[tuple[Words, ...]] = []
    for c in configs:
        labels.remove(c.label)
        cells = [
            c.label,
            str(len(c.runs)),
            interval_text(seconds[c.label], three_digits),
            *([_shown(mean_cost(c.runs, fit_cpu_seconds))] if of_cpu else []),
            f"{seconds_interval(c.runs, 'total_seconds').value:.0f}",
            f"{max(run.about.peak_mb or 0.0 for run in c.runs):.0f}",
            *([f"{max(map(_device_mb, c.runs)):.0f}"] if on_gpu else []),
            _shown(mean_cost(c.runs, lambda run: run.about.render_ms)),
            *(i.display.text(row[c.label].value.value) if c.label in row else "—" for i, row in points.items()),
            ", ".join(best.get(c.label, [])) or "—",
        ]
        rows.append(tuple(cells))
    kinds = sorted({interval.method for interval in seconds.values() if math.isfinite(interval.low)})
    head = ["method", "runs", f"fit s [{SPREAD}]" if kinds else "fit s", *(["fit CPU s"] if of_cpu else [])]
    head += ["total s", "peak MB"]
    head += [*(["GPU MB"] if on_gpu else []), "render ms", *heads(points).values(), "Pareto"]
    note = (
        f"Region {headline}, {len(scenes)} scene{'s' if len(scenes) > 1 else ''} that all these rows have. The fit "
        "clock stands still while checkpoints are scored and states are saved; total s is the whole run; render ms "
        "is one test view, the median; peak MB is the largest. Pareto: by these means no other row is as fast and "
        "better in this metric."
    )
    note += f" Not here, because they lack some of these scenes: {'; '.join(labels)}." if labels else ""
    note += f" Intervals: {'; '.join(kinds)}." if kinds else ""
    note += " Fit CPU s is what the processor did of it, all threads together." if of_cpu else ""
    if words := waited(every):
        note += (
            f" {words}. Their seconds of the wall clock count in Pareto sets, times, areas and diagrams all the same."
        )
    return [Table(tuple(head), tuple(rows)), Paragraph(note)]


def _quality_times(configs: Sequence[Configuration], headline: str, targets: Sequence[Target]) -> list[Block]:
    known = curve_identities(configs)
    if not known and any(run.curve for c in configs for run in c.runs):
        return [Paragraph("The quality-time curves (curve.jsonl) hold none of the metrics and regions shown here.")]
    if not known:
        return [Paragraph("No run has a quality-time curve (curve.jsonl).")]
    without = [run.folder.name for c in configs for run in c.runs if not run.curve]
    notes: list[Words] = [f"without a readable curve.jsonl: {', '.join(without)}"] if without else []
    configs, _ = comparable(configs)
    views = standing(run for c in configs for run in c.runs)
    return [
        *_time_table(configs, views, known, headline, targets),
        *_area_table(configs, views, known),
        *_end_table(configs, views, [i for i in known if i.region == headline and i.metric in ON_THE_CURVE]),
        *bullets(notes),
    ]


def _time_table(
    configs: Sequence[Configuration],
    views: str,
    known: Sequence[Identity],
    headline: str,
    targets: Sequence[Target],
) -> list[Block]:
    if not targets:
        first = {i.metric: i for i in reversed(known) if i.region == headline}
        targets = [Target(m, v) for m in ON_THE_CURVE if m in first for v in _round_ones(configs, first[m])]
    columns: list[tuple[float, Identity]] = []
    missing: list[Words] = []
    head, told = ["method"], variants_told(known)
    for target in targets:
        region = target.region or headline
        i = next((i for i in known if (i.metric, i.region) == (target.metric, region)), None)
        if i is None:
            missing.append(f"no curve of {target.metric} in {region}: scored at the end of a run only, or not at all")
            continue
        columns.append((target.value, i))
        metric, sign = i.display, "≥" if i.display.higher_is_better else "≤"
        where = f"{'' if region == headline else f' {region}'} {told[i]}".rstrip()
        unit = " dB" if metric.unit == "dB" else ""
        head.append(f"{metric.title}{where} {sign} {target.value * metric.scale:g}{unit}")
    if not columns or not configs:
        return bullets(missing)
    below: dict[str, str] = {}  # what is said of cells -> its number
    rows = []
    for c in configs:
        row: list[Words] = [c.label]
        for shown, says in (_time_cell(c, target, i) for target, i in columns):
            mark = says and Span(below.setdefault(says, f"({len(below) + 1})"), "raised")
            row.append((f"{shown} ", mark) if mark else shown)
        rows.append(tuple(row))
    note = (
        f"Seconds of fitting until the quality was first reached on {views} test views (region "
        f"{headline} where none is named); where the table over all views says otherwise, a number at the cell leads "
        "to what it says. Median over scenes of the median over seeds, in brackets the order "
        f"statistics that hold the true median with {SPREAD} confidence, or, under 6 scenes, their range; behind it "
        "in how many scenes the quality was reached, where not in all. Between two checkpoints quality is taken as "
        "linear in log time. Targets are stated with --target psnr=25; else they are round numbers that the curves "
        "pass."
    )
    title = f"Time to quality, on {views} test views"
    said: list[str | Span] = []
    for text, mark in below.items():
        said += [*([" "] if said else []), Span(mark, "raised"), f" {text}."]
    paragraphs = [Paragraph(tuple(said))] if said else []
    return [Heading(3, title), Table(tuple(head), tuple(rows)), *paragraphs, Paragraph(note), *bullets(missing)]


def _round_ones(configs: Sequence[Configuration], identity: Identity) -> list[float]:
    """Round qualities that the curves pass, none that the table lacks as long as there are such."""
    every = [(c, scene, curve) for c in configs for (scene, _), curve in curves(c, identity).items()]
    bound = np.fmin if identity.display.higher_is_better else np.fmax
    kept = [replace(v, values=bound(v.values, in_table(c, identity, (s,))[s])) for c, s, v in every]
    return round_targets(kept) or round_targets([curve for *_, curve in every])


def _time_cell(configuration: Configuration, target: float, identity: Identity) -> tuple[str, str]:
    """Median seconds; and, wherever the table over all views says something else, what it says, with the views that
    the seconds stand on."""
    found, metric = curves(configuration, identity), identity.display
    by_scene = grouped((scene, time_to_quality(curve, target)) for (scene, _), curve in found.items())
    times = {scene: median(seconds) for scene, seconds in by_scene.items()}  # `NEVER` where half never get there
    if not times:
        return "—", ""
    views = f"on {standing(run for run in configuration.runs if run.scene in times)} views"
    table = in_table(configuration, identity, times)
    has = {scene: value >= target if metric.higher_is_better else value <= target for scene, value in table.items()}
    says = ""
    if any(math.isfinite(times[scene]) != has[scene] for scene in times):
        of_all = f"it in {sum(has.values())} of {len(has)} scenes" if len(has) > 1 else metric.text(*table.values())
        says = f"{views}; the table has {of_all}"
    reached = sum(map(math.isfinite, times.values()))
    if not reached:
        best = (max if metric.higher_is_better else min)(curve.best for curve in found.values())
        return f"never (best {metric.text(best)})", says
    interval = median_interval(times, LEVEL)
    shown = _seconds(interval.value)
    if not math.isnan(interval.low):
        shown += f" [{_seconds(interval.low, '')}, {_seconds(interval.high, '')}]"
    return shown + (f", {reached} of {len(times)}" if reached < len(times) else ""), says


def _end_table(configs: Sequence[Configuration], views: str, columns: Sequence[Identity]) -> list[Block]:
    """Where the curves end beside what the table has over all views; nothing where they agree as printed."""
    cells = {c.label: [_end_cell(c, i) for i in columns] for c in configs}
    rows = [(label, *(cell or "as in the table" for cell in row)) for label, row in cells.items() if any(row)]
    if not rows:
        return []
    note = (
        f"The last point of the curves, on {views} test views, and the same avatars over all test views, as in the "
        "table: mean over scenes of the mean over seeds. By so much the curves, the times and the areas are off."
    )
    head = ("method", *heads(columns, region=True).values())
    title = "Where the curves end, and what the table has"
    return [Heading(3, title), Table(head, tuple(rows)), Paragraph(note)]


def _end_cell(configuration: Configuration, identity: Identity) -> str:
    """ "20.21, in the table 17.80 (+2.41)"; "" where both are printed alike, or one is absent."""
    text = identity.display.text
    ends = seed_means((scene, float(c.values[-1])) for (scene, _), c in curves(configuration, identity).items())
    table = in_table(configuration, identity, ends)
    end, whole = (sum(found.values()) / len(found) if found else math.nan for found in (ends, table))
    if not (math.isfinite(end) and math.isfinite(whole)) or text(end) == text(whole):
        return ""
    return f"{text(end)}, in the table {text(whole)} ({'+' if end > whole else '−'}{text(abs(end - whole))})"


def _area_table(configs: Sequence[Configuration], views: str, known: Sequence[Identity]) -> list[Block]:
    head, windows, cells = ["method"], set(), {c.label: [c.label] for c in configs}
    titles = heads((i for metric in ON_THE_CURVE for i in known if i.metric == metric), region=True)
    for i in titles:
        found = {c.label: curves(c, i) for c in configs}
        start, end = common_window([curve for of_row in found.values() for curve in of_row.values()])
        if not math.isfinite(start):
            continue
        head.append(titles[i])
        windows.add(f"{_seconds(start)} to {_seconds(end)}")
        for label, of_row in found.items():
            areas = [(scene, area_under_curve(curve, start, end)) for (scene, _), curve in of_row.items()]
            by_scene = grouped((scene, area) for scene, area in areas if math.isfinite(area))
            cells[label].append(i.display.text(mean_interval(by_scene, LEVEL).value) if by_scene else "—")
    if not windows:
        return []
    note = (
        f"Mean of the metric over the logarithm of fitting time, from {'; '.join(sorted(windows))}: from the latest "
        "first checkpoint of any run to the end of the longest fit; a finished fit keeps its last value. Mean over "
        "scenes."
    )
    title = f"Area under the quality-time curve, on {views} test views"
    return [Heading(3, title), Table(tuple(head), tuple(map(tuple, cells.values()))), Paragraph(note)]


def _shown(cost: float | None) -> str:
    return "—" if cost is None else three_digits(cost)


def _seconds(value: float, unit: str = " s") -> str:
    return "never" if value == NEVER else f"{three_digits(value)}{unit}"


def _device_mb(run: RunResult) -> float:
    stages = {} if run.record.ledger is None else run.record.ledger.stages
    return max((stage.peak_device_mb or 0.0 for stage in stages.values()), default=0.0)
