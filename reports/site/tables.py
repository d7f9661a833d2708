"""What a site says in numbers and words, as plain JSON: groups of runs that may stand in one table, their rows, the
runs themselves with every score of every test view, curves, stages, and how to repeat them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ihbench.clock.ledger import in_order
from ihbench.config_fields import as_json
from ihbench.document.marks import marks_by_interval
from ihbench.document.metric_names import variants_told
from ihbench.errors import BadInput
from ihbench.metrics import Identity, macro_mean
from ihbench.metrics.identity import metric_of
from ihbench.metrics.statistics import mean_interval
from ihbench.record.results import RunResult, by_group
from ihbench.record.row_labels import by_label
from ihbench.record.scene_means import per_scene, scene_means
from ihbench.record.schema import ScoreLine, score_lines
from ihbench.record.shareable import without_places
from ihbench.reports.general.clock import fit_cpu_seconds, machine_name, mean_cost, unstable
from ihbench.reports.general.remarks import said_by
from ihbench.reports.general.significance import LEVEL, further_rows
from ihbench.scene.method_spec import usable_specs
from ihbench.scoring.calibration import DESCRIPTIONS, ROWS

Json = dict[str, Any]
MOST_CURVE_POINTS = 400  # of one run; a page need not draw more


def site_tables(results: Sequence[RunResult], left_out: Sequence[str] = ()) -> Json:
    """All groups and runs. Runs are named by their place in `results`. Numbers are whole floats; what is not finite
    is "inf" or "-inf", an absent number [k], k the number of its reason in the run's `reasons`."""
    numbers = {id(run): k for k, run in enumerate(results)}
    labels: dict[int, str] = {}
    groups = []
    for runs in by_group(results).values():
        done = [run for run in runs if run.status == "done"]
        for label, row in by_label(done).items():
            labels |= {numbers[id(run)]: label for run in row}
        groups.append(_group(runs, done, numbers))
    of_group = {number: g for g, group in enumerate(groups) for number in group["runs"]}
    return {
        "groups": groups,
        "runs": [
            _run(run, of_group[k], labels.get(k, run.about.label or run.method)) for k, run in enumerate(results)
        ],
        "metrics": {name: _metric(name) for name in dict.fromkeys(i.metric for run in results for i in _scored(run))},
        "variants": {name: said for group in groups for name, said in group.pop("variants").items()},
        "left_out": list(left_out),
        "citations": _citations(dict.fromkeys(run.method for run in results)),
    }


def _scored(run: RunResult) -> Iterator[Identity]:
    """All that a run has numbers of: one that failed may have a curve alone."""
    yield from run.own
    for point in run.curve:
        yield from point.scores


def number(value: float) -> float | str | None:
    """A number as JSON has it; None for NaN."""
    if math.isnan(value):
        return None
    return value if math.isfinite(value) else ("inf" if value > 0 else "-inf")


def _metric(name: str) -> Json:
    shown = metric_of(name)
    return {
        "title": shown.title, "arrow": shown.arrow, "unit": shown.unit, "scale": shown.scale,
        "decimals": shown.decimals, "higher": shown.higher_is_better,
    }  # fmt: skip


def _group(runs: Sequence[RunResult], done: Sequence[RunResult], numbers: Mapping[int, int]) -> Json:
    protocol, digest, profile, data = runs[0].group
    identities = [
        i
        for i in dict.fromkeys(i for run in done for i in run.own)
        if any(i in run.own and not run.own[i].absent for run in done)
    ]
    absent = {str(i): run.own[i].reason for run in done for i in run.own if i not in identities and run.own[i].reason}
    common = _common([{run.scene for run in row} for row in by_label(done).values()])
    return {
        "protocol": protocol,
        "digest": digest,
        "profile": profile,
        "data": data,
        "standin": runs[0].about.standin or "",
        "headline": next((run.headline for run in done), ""),
        "identities": [{"name": str(i), "metric": i.metric, "region": i.region} for i in identities],
        "variants": {str(i): said for i, said in variants_told(identities).items() if said},
        "absent": absent,
        "common": common,
        "rows": _rows(done, identities, numbers, common),
        "runs": [numbers[id(run)] for run in runs],
        "toml": toml(runs[0].about.protocol or {}),
    }


def _common(scenes: Sequence[set[str]]) -> list[str] | None:
    """The scenes that every method has; None where all have the same."""
    if all(of == scenes[0] for of in scenes):
        return None
    return sorted(set.intersection(*scenes))


def _rows(
    done: Sequence[RunResult], identities: Sequence[Identity], numbers: Mapping[int, int], common: list[str] | None
) -> list[Json]:
    """Methods' rows, with those of further groups of test views below them, then the calibration rows. Where methods
    have other scenes, each row has its means over the scenes that all have, too, and the marks are of these."""
    labelled = by_label(done)
    rows: list[Json] = []
    marks = _marks({label: _on(runs, common) for label, runs in labelled.items()}, identities)
    for label, runs in labelled.items():
        for name in (runs[0].method, *further_rows(runs)):
            own = name == runs[0].method
            row = _row(label + name.removeprefix(runs[0].method), runs, identities, name, numbers, common)
            rows.append(row | {"kind": "method" if own else "further", "marks": marks[label] if own else {}})
    for name in ROWS:
        if having := [run for run in done if name in run.rows]:
            row = _row(name, having, identities, name, numbers, common)
            rows.append(
                row
                | {"kind": "bound", "marks": {}, "about": DESCRIPTIONS[name], "fit": None, "cpu": None, "total": None}
            )
    return rows


def _on(runs: Sequence[RunResult], common: list[str] | None) -> list[RunResult]:
    return [run for run in runs if common is None or run.scene in common]


def _row(
    label: str,
    runs: Sequence[RunResult],
    identities: Sequence[Identity],
    name: str,
    numbers: Mapping[int, int],
    common: list[str] | None,
) -> Json:
    scenes = {
        str(i): {scene: number(mean.value) for scene, mean in found.items()}
        for i in identities
        if (found := scene_means(runs, i, name))
    }
    means, intervals = _means(runs, identities, name)
    shared = {}
    if common is not None:
        shared["common"], shared["common_intervals"] = _means(_on(runs, common), identities, name)
    return {
        "label": label,
        "method": runs[0].method,
        "row": name,
        "runs": [numbers[id(run)] for run in runs],
        "scenes": sorted({run.scene for run in runs}),
        "seeds": sorted({run.seed for run in runs}),
        "means": means,
        "by_scene": scenes,
        "intervals": intervals,
        **shared,
        "fit": mean_cost(runs, lambda run: run.about.fit_seconds),
        "cpu": mean_cost(runs, fit_cpu_seconds),
        "total": mean_cost(runs, lambda run: run.about.total_seconds),
        "unstable": unstable([run for run in runs if run.timed]),
        "peak": max((run.about.peak_mb or 0.0 for run in runs), default=0.0),
    }


def _means(runs: Sequence[RunResult], identities: Sequence[Identity], name: str) -> tuple[Json, Json]:
    """Identity -> mean over test views, then scenes; and its interval over scenes, where there is one."""
    means, intervals = {}, {}
    for i in identities:
        found = scene_means(runs, i, name)
        if not found:
            continue
        means[str(i)] = number(macro_mean(found).value)
        finite = {scene: mean.value for scene, mean in found.items() if math.isfinite(mean.value)}
        if len(finite) > 1:
            interval = mean_interval(finite, LEVEL)
            if math.isfinite(interval.low):
                intervals[str(i)] = [interval.low, interval.high]
    return means, intervals


def _marks(labelled: Mapping[str, Sequence[RunResult]], identities: Sequence[Identity]) -> dict[str, Json]:
    """Label -> identity -> best or second, where the intervals over scenes allow it."""
    labels = list(labelled)
    marks: dict[str, Json] = {label: {} for label in labels}
    for i in identities:
        found = [scene_means(runs, i) for runs in labelled.values()]
        shown = [float(f"{macro_mean(means).value:.12g}") if means else math.nan for means in found]
        rounded = [round(value * i.display.scale, i.display.decimals) for value in shown]
        by_scene = [per_scene(runs, i) for runs in labelled.values()]
        given = marks_by_interval(labels, rounded, by_scene, i.display.higher_is_better, LEVEL).marks
        for label, mark in zip(labels, given, strict=True):
            if mark:
                marks[label][str(i)] = mark
    return marks


def _run(run: RunResult, group: int, label: str) -> Json:
    record, about = run.record, run.about
    identities = list(run.own)
    reasons: dict[str, int] = {}
    return {
        "name": run.folder.name,
        "group": group,
        "label": label,
        "method": run.method,
        "scene": run.scene,
        "seed": run.seed,
        "status": run.status,
        "reason": run.reason,
        "standin": about.standin or "",
        "headline": run.headline,
        "identities": [str(i) for i in identities],
        "means": [number(run.own[i].value) for i in identities],
        "views": _views(run, identities, reasons),
        "reasons": list(reasons),
        "curve": curve_json(run),
        "stages": _stages(run),
        "wall": record.ledger.seconds if record.ledger is not None else None,
        "fit": about.fit_seconds,
        "total": about.total_seconds,
        "peak": about.peak_mb,
        "hidden_share": about.hidden_share,
        "remarks": {kind: texts for kind, texts in said_by(run).items() if texts},
        "facts": _facts(run),
        "repeat": f"ihbench run --like {run.folder.name}",
        "command": " ".join(("ihbench", *about.command)) if about.command else "",
        "config": _shown_config(run.identity.config),
    }


def _facts(run: RunResult) -> list[list[str]]:
    """Name and value of what a reader should know of a run."""
    record, identity, git = run.record, run.identity, run.record.provenance.git
    facts = {
        "run": record.digest,
        "data": run.data,
        "variant": run.about.variant or "",
        "code": identity.code,
        "body": f"{run.about.body or '?'} {identity.body}",
        "made": f"{record.outcome.created} to {record.outcome.updated or '?'}",
        "machine": machine_name(run),
        "device": run.about.device,
        "python": f"{record.machine.python}, torch {record.machine.torch}, {record.machine.platform}",
        "ihbench": record.provenance.ihbench,
        "commit": "" if git is None else f"{git.commit}{' and files that differ from it' if git.dirty else ''}",
        "packages": ", ".join(f"{name} {version}" for name, version in record.provenance.packages.items()),
    }
    return [[name, without_places(str(value), run.folder)] for name, value in facts.items() if value]


def _shown_config(config: Any) -> Any:
    """Every switch as JSON, without places of the machine."""
    match as_json(config):
        case str(text):
            return without_places(text)
        case dict(items):
            return {name: _shown_config(value) for name, value in items.items()}
        case list(items):
            return [_shown_config(value) for value in items]
        case other:
            return other


def _views(run: RunResult, identities: Sequence[Identity], reasons: dict[str, int]) -> list[Json]:
    """Every test view with its own scores, in the order of `identities`."""
    try:
        lines = score_lines(run.folder / "scores.jsonl")
    except (BadInput, OSError):
        return []
    return [
        {
            "camera": str(line.camera),
            "frame": line.frame,
            "group": line.row.removeprefix(run.method).strip(" []"),
            "scores": [_score(line, i, run, reasons) for i in identities],
        }
        for line in lines
    ]


def _score(line: ScoreLine, identity: Identity, run: RunResult, reasons: dict[str, int]) -> Any:
    value = float(line.scores.get(identity, math.nan))
    if math.isnan(value):
        reason = without_places(line.absent.get(str(identity), "no reason recorded"), run.folder)
        return [reasons.setdefault(reason, len(reasons))]
    return number(value)


def curve_json(run: RunResult) -> list[Json]:
    """The points of a run's quality-time curve."""
    return [
        {
            "step": point.step,
            "seconds": point.seconds,
            "views": point.views,
            "of": point.of,
            "scores": {str(i): number(float(v)) for i, v in point.scores.items() if not math.isnan(v)},
        }
        for point in run.curve[-MOST_CURVE_POINTS:]
    ]


def _stages(run: RunResult) -> list[list[Any]]:
    """[path, seconds], parents before children."""
    ledger = run.record.ledger
    return [] if ledger is None else [[path, ledger.stages[path].seconds] for path in in_order(ledger.stages)]


def _citations(methods: Sequence[str] | Mapping[str, None]) -> list[str]:
    """BibTeX of the methods' papers, as far as the bench knows them."""
    specs = {spec.name: spec for spec in usable_specs()}
    entries = []
    for name in methods:
        paper = specs[name].paper if name in specs else None
        if paper is not None:
            parts = {
                "title": paper.title,
                "author": paper.authors.replace(", ", " and "),
                "year": str(paper.year or ""),
            }
            lines = [f"  {key} = {{{value}}}," for key, value in parts.items() if value]
            key = re.sub(r"\W", "", name) + str(paper.year or "")
            entries.append("\n".join((f"@article{{{key},", *lines, "}")))
    return entries


def toml(content: Mapping[str, Any], inside: str = "") -> str:
    """A protocol's content as TOML, tables after the values of the table they are in."""
    lines = [f"{_key(name)} = {_value(value)}" for name, value in content.items() if not isinstance(value, Mapping)]
    for name, value in content.items():
        if isinstance(value, Mapping):
            path = f"{inside}{_key(name)}"
            lines += ["", f"[{path}]", toml(value, f"{path}.").rstrip("\n")]
    return "\n".join(lines).lstrip("\n") + "\n"


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _value(name)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if value is None:
        return '""'
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace(
            "\x7f", "\\u007f"
        )  # TOML's strings are JSON's but for this
    if isinstance(value, Mapping):  # in a list
        return f"{{{', '.join(f'{_key(name)} = {_value(inner)}' for name, inner in value.items())}}}"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_value, value))}]"
    return str(value)
