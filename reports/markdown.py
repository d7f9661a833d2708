"""Markdown tables: one per protocol, profile and kind of data; methods first, calibration rows below."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ihbench.calibration import DESCRIPTIONS, ROWS
from ihbench.metrics import Identity, Mean, macro_mean
from ihbench.results import RunResult

DECIMALS = {"psnr": 2, "ssim": 4}
ARROWS = {"psnr": "↑", "ssim": "↑"}
UNITS = {"psnr": "PSNR", "ssim": "SSIM"}


def write(results: Sequence[RunResult]) -> str:
    """All tables of these runs. Runs under different protocols, profiles or data never share a table."""
    groups: dict[tuple[str, str, str, str], list[RunResult]] = {}
    for result in results:
        groups.setdefault(result.group, []).append(result)
    return "\n\n".join(_group(key, runs) for key, runs in groups.items()) + "\n"


def _group(key: tuple[str, str, str, str], runs: list[RunResult]) -> str:
    protocol, digest, profile, data = key
    done = [run for run in runs if run.status == "done"]
    head = [f"## {protocol}, {profile} profile", "", f"Data: {data}. Protocol digest `{digest}`."]
    head += [
        f"Not done: {_plain(f'{run.method} on {run.scene}')}: {run.status} ({_plain(run.record['reason'])})."
        for run in runs
        if run.status != "done"
    ]
    if not done:
        return "\n".join(head)
    identities = [Identity.parse(text) for text in next(iter(done[0].rows.values()))]
    headline = done[0].record["about"]["headline"]
    table = _table(done, identities, headline)
    notes = [f"Mean over test views of a scene, then over scenes ({_scenes(done)}). Headline region: {headline}."]
    notes += [
        f"`{identity}`" for identity in sorted({str(i).replace(f"/{i.region}/", "/REGION/") for i in identities})
    ]
    notes += [f"- {row}: {DESCRIPTIONS[row]}" for row in ROWS if any(row in run.rows for run in done)]
    notes += sorted({note for run in done for note in _left_out(run)})
    return "\n".join([*head, "", *table, "", *notes])


def _table(runs: list[RunResult], identities: list[Identity], headline: str) -> list[str]:
    metrics = list(dict.fromkeys(i.metric for i in identities))
    regions = list(dict.fromkeys(i.region for i in identities))
    columns = [i for m in metrics for r in regions for i in identities if (i.metric, i.region) == (m, r)]
    head = ["method", "scenes", "seeds"]
    head += [
        f"{UNITS[i.metric]}{ARROWS[i.metric]} {'**' + i.region + '**' if i.region == headline else i.region}"
        for i in columns
    ]
    head += ["fit s", "total s", "peak MB"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * 3 + "---:|" * (len(head) - 3)]
    by_label: dict[str, list[RunResult]] = {}
    for run in runs:
        by_label.setdefault(_label(run, runs), []).append(run)
    for label, group in by_label.items():
        cells = [
            label,
            str(len({r.scene for r in group})),
            ", ".join(sorted({str(r.identity["seed"]) for r in group})),
        ]
        cells += [_cell([(r.scene, r.rows[r.method]) for r in group], i) for i in columns]
        cells += [_mean_of(group, "fit_seconds"), _mean_of(group, "total_seconds"), _largest(group, "peak_mb")]
        lines.append("| " + " | ".join(cells) + " |")
    for row in ROWS:
        having = list({r.scene: (r.scene, r.rows[row]) for r in runs if row in r.rows}.values())
        if having:
            cells = [f"*{row}*", str(len(having)), ""] + [_cell(having, i) for i in columns] + ["", "", ""]
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def _label(run: RunResult, runs: list[RunResult]) -> str:
    """The method with what sets this row apart. Runs of several versions of its code are several rows."""
    changed = run.record["about"]["changed"]
    if len({other.identity["code"] for other in runs if other.method == run.method}) > 1:
        changed = [*changed, f"code {run.identity['code']}"]
    return _plain(run.method + (f" ({', '.join(changed)})" if changed else ""))


def _plain(text: str) -> str:
    """Text that neither ends a table's cell or line nor is taken for HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def _cell(per_run: list[tuple[str, dict[str, Mean]]], identity: Identity) -> str:
    """Mean over seeds within a scene, then over scenes."""
    by_scene: dict[str, dict[str, Mean]] = {}
    for k, (scene, means) in enumerate(per_run):
        if str(identity) in means:
            by_scene.setdefault(scene, {})[str(k)] = means[str(identity)]
    if not by_scene:
        return "—"
    value = macro_mean({scene: macro_mean(runs) for scene, runs in by_scene.items()}).value
    if math.isnan(value):
        return "—"
    return "∞" if math.isinf(value) else f"{value:.{DECIMALS[identity.metric]}f}"


def _mean_of(runs: list[RunResult], key: str) -> str:
    values = [run.record["about"][key] for run in runs]
    return f"{sum(values) / len(values):.0f}"


def _largest(runs: list[RunResult], key: str) -> str:
    return f"{max(run.record['about'][key] for run in runs):.0f}"


def _scenes(runs: list[RunResult]) -> str:
    return ", ".join(sorted({_plain(run.scene) for run in runs}))


def _left_out(run: RunResult) -> list[str]:
    """Why cells of the method's row are empty, what their means do not run over, and what the plan left out."""
    notes = []
    for identity, mean in run.rows[run.method].items():
        region = Identity.parse(identity).region
        if mean.absent:
            notes.append(f"- absent: {region}: {mean.reason}")
        elif mean.note:
            notes.append(f"- {region} of {_plain(run.scene)}: {mean.note}")
    notes += [f"- left out: {o['field']} → {o['value']}: {o['reason']}" for o in run.record["about"]["left_out"]]
    return notes
