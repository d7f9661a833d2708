"""The figures of the general report: work-precision diagrams (one point a configuration) and quality-time curves
(checkpoints of the fits), each as PNG, SVG and the numbers as CSV."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from itertools import cycle, pairwise
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from ihbench.document import diagram
from ihbench.document.metric_names import variants_told
from ihbench.metrics import Identity
from ihbench.metrics.identity import METRICS
from ihbench.metrics.statistics import Interval, interval_ends
from ihbench.record import outputs
from ihbench.record.quality_time import QualityCurve, error_of
from ihbench.record.results import RunResult, by_group, grouped
from ihbench.record.schema import plain_name
from ihbench.reports.general.clock import fit_cpu_seconds, mean_cost, waited
from ihbench.reports.general.configurations import Configuration, configurations, short_value, sweeps
from ihbench.reports.general.run_time import (
    LEVEL,
    ON_THE_CURVE,
    WorkPoint,
    comparable,
    curve_identities,
    curves,
    pareto,
    same_protocol,
    seconds_interval,
    standing,
    work_points,
)

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PARTITION = ("visible", "hidden", "never_seen")  # regions whose curves are drawn beside the headline's
AXES = {"psnr": "RMSE", "ssim": "1 − SSIM", "flip": "FLIP", "lpips": "LPIPS"}
DRAWN = 3  # metrics at most, in one figure
GRID = 40  # times at which a mean curve is drawn
CROWD = 5  # configurations; of more, only the mean curves are drawn
LEGEND_WIDTH = 88  # characters
LEAST_SYSTEMS = 2  # in a diagram of systems
ROOM = 1.5  # times the largest value, and part of the smallest, that a work-precision diagram shows of intervals
PROFILE_POINT = "all switches as the profile has them"


def draw(results: Sequence[RunResult], folder: Path) -> list[tuple[Path, str]]:
    """Draw all figures of these runs into a folder; gives each PNG with its caption.

    Runs without a fit time or without numbers have no figure; none of them is no error.
    """
    drawn: list[tuple[Path, str]] = []
    groups = by_group(run for run in results if run.status == "done")
    names: set[str] = set()
    for (protocol, digest, profile, data), runs in groups.items():
        name = _new(f"{plain_name(protocol)}_{plain_name(profile)}", digest, names)
        configs, headline = configurations(runs), runs[0].headline
        title = f"{protocol}, {profile} profile"
        drawn += _work_precision(configs, headline, folder / f"work-precision_{name}", title, data)
        drawn += _systems(configs, headline, folder / f"systems_{name}", title, data)
        drawn += _quality_time(configs, headline, folder / f"quality-time_{name}", title, data)
    for (protocol, data), runs in same_protocol(results).items():
        name = _new(f"{plain_name(protocol)}_profiles-and-sizes", "", names)
        about = f"{data}; test images differ in size: compare errors with care"
        configs, title = configurations(runs, across=True), f"{protocol}: profiles and image sizes"
        drawn += _work_precision(configs, runs[0].headline, folder / f"work-precision_{name}", title, about)
    return drawn


def _new(name: str, digest: str, taken: set[str]) -> str:
    """A file name that no other group has."""
    candidates = (name, f"{name}_{digest[:6]}", *(f"{name}_{k}" for k in range(2, 1000)))
    new = next(candidate for candidate in candidates if candidate not in taken)
    taken.add(new)
    return new


# ---------------------------------------------------------------------------------------------------- work-precision


def _work_precision(
    configs: Sequence[Configuration], headline: str, path: Path, title: str, about: str
) -> list[tuple[Path, str]]:
    configs, scenes = comparable(configs)
    panels = dict(list(_panels(configs, [headline], METRICS).items())[:DRAWN])
    caption = (
        f"Work-precision of {title} ({about}): error in region {headline} against seconds of fitting, both "
        f"logarithmic; bars are {LEVEL:.0%} intervals over scenes, or over repeats of a single one, and "
        "may run out of the picture."
    )
    return _diagram(panels, scenes, path, f"Work-precision: {title}", about, caption + _waited(configs))


def _systems(
    configs: Sequence[Configuration], headline: str, path: Path, title: str, about: str
) -> list[tuple[Path, str]]:
    """Every system as its profile has it, by region, each point with its name. Nothing for fewer than two."""
    configs, scenes = comparable([c for c in configs if not c.changed])
    if len({c.method for c in configs}) < LEAST_SYSTEMS:
        return []
    panels = _panels(configs, [headline, *(r for r in PARTITION if r != headline)], ["psnr"])
    caption = (
        f"The systems of {title} ({about}), each as its profile has it: error against seconds of fitting by region, "
        "both logarithmic. The dashed line is the Pareto set of a region: nothing is as fast and better. Bars are "
        f"{LEVEL:.0%} intervals over scenes, and may run out of the picture."
    )
    return _diagram(panels, scenes, path, f"Systems: {title}", about, caption + _waited(configs), named=True)


def _panels(
    configs: Sequence[Configuration], regions: Sequence[str], metrics: Container[str]
) -> dict[Identity, list[WorkPoint]]:
    """The points of every metric in every region, in the order of the regions."""
    identities = dict.fromkeys(i for c in configs for run in c.runs for i in run.own if i.metric in metrics)
    panels = {
        i: [p for p in work_points(configs, i) if p.seconds.value > 0 and p.error.value > 0]
        for region in regions
        for i in identities
        if i.region == region
    }
    return {i: points for i, points in panels.items() if points}


def _diagram(
    panels: Mapping[Identity, list[WorkPoint]],
    scenes: Sequence[str],
    path: Path,
    title: str,
    about: str,
    caption: str,
    named: bool = False,  # whether points have their names beside them, too
) -> list[tuple[Path, str]]:
    if not panels:
        return []
    columns = len(panels) if len(panels) <= DRAWN else 2
    drawn, axes = diagram.figure(columns, -(-len(panels) // columns), width=5.0 + named, height=5.2 - named)
    for spare in axes[len(panels) :]:
        spare.set_axis_off()
    rows: list[dict[str, object]] = []
    handles: dict[str, Artist] = {}
    labels: list[tuple[Axes, list[diagram.Label], list[list[tuple[float, float]]]]] = []
    told = variants_told(panels)
    for panel, (identity, points) in zip(axes, panels.items(), strict=False):
        front = pareto(points)
        diagram.logarithmic(panel, _shown([p.seconds for p in points]), _shown([p.error for p in points]))
        labels.append((panel, *_points(panel, points, handles, named)))
        steps = [_at(points[k]) for k in front]
        if len(steps) > 1:
            corners = [(b[0], a[1]) for a, b in pairwise(steps)]
            labels[-1][2].append([place for pair in zip(steps, corners, strict=False) for place in pair] + steps[-1:])
            (line,) = panel.plot(
                *zip(*steps, strict=True), drawstyle="steps-post", color="#777777", ls="--", lw=1.1, zorder=1
            )
            handles.setdefault("Pareto set: nothing is as fast and better", line)
        _name_axes(
            panel,
            identity,
            f"seconds of fitting, mean of {len(scenes)} scene{'s' * (len(scenes) > 1)}",
            told[identity],
        )
        rows += [_csv_row(p, identity, k in front, len(scenes)) for k, p in enumerate(points)]
    _finish(drawn, handles, title, about)
    for panel, beside, lines in labels:
        diagram.place_labels(panel, beside, lines)
    return [(outputs.write_files(path, diagram.files(drawn, rows)), caption)]


def _points(
    panel: Axes, points: Sequence[WorkPoint], handles: dict[str, Artist], named: bool = False
) -> tuple[list[diagram.Label], list[list[tuple[float, float]]]]:
    """Draw the configurations, sweeps as lines; gives the texts that belong beside them, and the lines."""
    place = {id(p.configuration): p for p in points}
    labels: dict[int, diagram.Label] = {}
    lines: list[list[tuple[float, float]]] = []
    swept: set[int] = set()
    style = zip(cycle(diagram.COLOURS), cycle(diagram.MARKS), strict=False)
    for sweep in sweeps([p.configuration for p in points]):
        colour, mark = next(style)
        members = [(value, place[id(c)]) for value, c in sweep.members]
        lines.append([_at(p) for _, p in members])
        (line,) = panel.plot(*zip(*lines[-1], strict=True), color=colour, marker=mark, ms=6, lw=1.6, zorder=3)
        default = [short_value(value) for value, p in members if sweep.axis not in p.configuration.changed]
        handles.setdefault(f"{sweep.label}{f' (★ {default[0]})' if default else ''}", line)
        for value, p in members:
            _bars(panel, p, colour)
            swept.add(id(p.configuration))
            if sweep.axis in p.configuration.changed:
                labels[id(p)] = diagram.Label(_at(p), short_value(value), colour)
    for p in points:
        c, plain = p.configuration, id(p.configuration) in swept
        if plain and c.changed:
            continue
        colour, mark = next(style)
        colour, mark, size = ("#000000", "*", 13) if plain else (colour, mark, 7)
        (point,) = panel.plot(*_at(p), color=colour, marker=mark, ms=size, ls="", zorder=4)
        _bars(panel, p, colour)
        handles.setdefault(f"{c.label}{f': {PROFILE_POINT}' if plain else ''}", point)
        labels.setdefault(id(p), diagram.Label(_at(p), c.label if named else ""))
    return list(labels.values()), lines


def _at(p: WorkPoint) -> tuple[float, float]:
    return p.seconds.value, p.error.value


def _bars(panel: Axes, p: WorkPoint, colour: str) -> None:
    x, y = _at(p)
    for interval, ends in (
        (p.seconds, ((p.seconds.low, p.seconds.high), (y, y))),
        (p.error, ((x, x), (p.error.low, p.error.high))),
    ):
        if math.isfinite(interval.low) and interval.low > 0:
            panel.plot(*ends, color=colour, lw=1, alpha=0.3, zorder=2)


def _shown(intervals: Sequence[Interval]) -> list[float]:
    """What an axis must hold: all values, and of their intervals what lies near. Intervals over two or three scenes
    may be so wide that the points would fall into one; their bars then run out of the picture."""
    values = [i.value for i in intervals if math.isfinite(i.value) and i.value > 0]
    if not values:
        return []
    low, high = min(values) / ROOM, max(values) * ROOM
    ends = [end for i in intervals for end in (i.low, i.high) if math.isfinite(end) and end > 0]
    return [*values, *(min(max(end, low), high) for end in ends)]


def _csv_row(p: WorkPoint, identity: Identity, on_front: bool, scenes: int) -> dict[str, object]:
    c = p.configuration
    return {
        "configuration": c.label,
        "method": c.method,
        "switches": ", ".join(f"{name}={value}" for name, value in c.changed.items()),
        "scenes": scenes,
        "runs": len(c.runs),
        **_ends("fit_seconds", p.seconds),
        "fit_cpu_seconds": math.nan if (cpu := mean_cost(c.runs, fit_cpu_seconds)) is None else cpu,
        "total_seconds": seconds_interval(c.runs, "total_seconds").value,
        "identity": str(identity),
        **_ends("value", p.value),
        **_ends("error", p.error),
        "pareto": on_front,
    }


def _ends(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}


# ------------------------------------------------------------------------------------------------------ quality-time


def _quality_time(
    configs: Sequence[Configuration], headline: str, path: Path, title: str, about: str
) -> list[tuple[Path, str]]:
    known = curve_identities(configs)
    told = variants_told(known)
    panels = {(i.metric, i.region): i for i in reversed(known)}  # of several definitions the first
    metrics = [m for m in ON_THE_CURVE if any((m, r) in panels for r in (headline, *PARTITION))]
    regions = [r for r in dict.fromkeys((headline, *PARTITION)) if any((m, r) in panels for m in metrics)]
    if not metrics:
        return []
    views = standing(run for c in configs for run in c.runs)
    drawn, axes = diagram.figure(len(regions), len(metrics), width=4.2, height=3.8)
    rows: list[dict[str, object]] = []
    handles: dict[str, Artist] = {}
    for k, panel in enumerate(axes):
        metric, region = metrics[k // len(regions)], regions[k % len(regions)]
        identity = panels.get((metric, region))
        if identity is None:
            panel.set_axis_off()
            continue
        shown = _curve_panel(panel, configs, identity, handles)
        rows += shown
        times, errors = [row["seconds"] for row in shown], [row["error"] for row in shown]
        diagram.logarithmic(panel, times, errors)
        _name_axes(panel, identity, "seconds of fitting", told[identity], f"\non {views} test views")
    if not handles:
        return []
    _finish(drawn, handles, f"Quality against time: {title}", about)
    crowd = f"; dots: checkpoints of single runs; shaded: {LEVEL:.0%} interval" if len(configs) <= CROWD else ""
    caption = (
        f"Quality against the fit clock, {title} ({about}), by region, on {views} test views. Lines: mean over "
        f"scenes of the checkpoints of their runs{crowd}. Scoring does not count as time.{_waited(configs)}"
    )
    return [(outputs.write_files(path, diagram.files(drawn, rows)), caption)]


def _curve_panel(
    panel: Axes, configs: Sequence[Configuration], identity: Identity, handles: dict[str, Artist]
) -> list[dict[str, Any]]:
    """Draw every configuration's checkpoints and mean curve; gives what was drawn as rows."""
    metric = identity.metric
    rows: list[dict[str, Any]] = []
    for k, c in enumerate(configs):
        colour, mark = diagram.COLOURS[k % len(diagram.COLOURS)], diagram.MARKS[k % len(diagram.MARKS)]
        lines_of = curves(c, identity)
        by_run = {(run.scene, run.seed): [run] for run in c.runs}
        points = [
            {"kind": "checkpoint", "configuration": c.label, "scene": scene, "seed": seed, "identity": str(identity),
             "seconds": float(t), "value": float(v), "test_views": standing(by_run[scene, seed]),
             "error": error_of(metric, float(v))}
            for (scene, seed), curve in lines_of.items()
            for t, v in zip(curve.seconds, curve.values, strict=True)
            if error_of(metric, float(v)) > 0
        ]  # fmt: skip
        if not points:
            continue
        times, *bands = _mean_curve(lines_of)
        means, low, high = ([error_of(metric, value) for value in band] for band in bands)
        dash = diagram.DASHES[k // len(diagram.COLOURS) % len(diagram.DASHES)]
        (line,) = panel.plot(times, means, color=colour, lw=1.8, ls=dash, zorder=3)
        handles.setdefault(c.label, line)
        if len(configs) <= CROWD:
            panel.fill_between(times, low, high, color=colour, alpha=0.15, lw=0, zorder=1)
            panel.plot(
                [p["seconds"] for p in points], [p["error"] for p in points],
                ls="", marker=mark, ms=3.5, color=colour, alpha=0.35, mew=0, zorder=2,
            )  # fmt: skip
            rows += points
        rows += [
            {"kind": "mean", "configuration": c.label, "identity": str(identity), "seconds": t, "value": value,
             "test_views": standing(c.runs), "error": error_of(metric, value), "value_low": low_end,
             "value_high": high_end}
            for t, value, low_end, high_end in zip(times, *bands, strict=True)
        ]  # fmt: skip
    return rows


def _mean_curve(found: dict[tuple[str, int], QualityCurve]) -> list[list[float]]:
    """Seconds, values, lows, highs of the mean over scenes of the mean over seeds, where every run has a value."""
    start = max(float(c.seconds[0]) for c in found.values())
    end = max(float(c.seconds[-1]) for c in found.values())
    times = np.geomspace(start, end, GRID) if start < end else np.array([start])
    times[0], times[-1] = start, end  # rounding must not put the first one before the first point
    by_scene = grouped((scene, curve.at(times)) for (scene, _), curve in found.items())
    means = np.stack([np.mean(values, 0) for values in by_scene.values()], -1)  # [times, scenes]
    known = np.isfinite(means).all(-1)
    times, means = times[known], means[known]
    low, high = interval_ends(means, LEVEL) if len(by_scene) > 1 else np.full((2, len(times)), np.nan)
    return [part.tolist() for part in (times, means.mean(-1), low, high)]


# ------------------------------------------------------------------------------------------------------------- shared


def _waited(configs: Sequence[Configuration]) -> str:
    """What a caption says of fits that stood still for a part of their seconds."""
    words = waited([run for c in configs for run in c.runs])
    return f" {words}: drawn by the wall clock." if words else ""


def _name_axes(panel: Axes, identity: Identity, below: str, variant: str, where: str = "") -> None:
    """Name the axes; `variant` tells the metric from others of its name, `where` says on which views. A PSNR's
    error gets its decibels on the right."""
    metric = identity.metric
    panel.set_xlabel(below)
    panel.set_ylabel(f"{AXES.get(metric, metric)}  (less is better){where}")
    panel.set_title(f"{identity.region} {variant}".rstrip())
    if metric == "psnr":
        beside = panel.twinx()
        low, high = panel.get_ylim()
        beside.set_ylim(-20 * math.log10(low), -20 * math.log10(high))  # linear in dB is logarithmic in RMSE
        beside.set_ylabel("PSNR, dB")
        beside.grid(visible=False)
        beside.spines["right"].set_visible(True)


def _finish(drawn: Figure, handles: dict[str, Artist], title: str, about: str) -> None:
    """Title on top, legend below, outside the axes."""
    drawn.suptitle(diagram.words(f"{title}\n{about}"), fontsize=11)
    texts = [diagram.words(fill(label, LEGEND_WIDTH)) for label in handles]
    columns = 1 if max(len(t) for t in texts) > 42 or len(texts) < 3 else 2
    drawn.legend(list(handles.values()), texts, loc="outside lower center", ncols=columns, frameon=False)
