"""Markdown tables: one per protocol, profile and kind of data; methods first, calibration rows below."""

from __future__ import annotations

from collections.abc import Sequence

from ihbench.calibration import DESCRIPTIONS, ROWS
from ihbench.metrics import Identity, Mean, macro_mean
from ihbench.metrics.identity import metric_of
from ihbench.reports.inpainting import inpainting_section, stage_lines
from ihbench.reports.significance import intervals_section
from ihbench.results import RunResult

Rows = dict[str, dict[str, Mean]]  # of one run: row -> identity -> mean


def write(results: Sequence[RunResult], presets: Sequence[str] = ()) -> str:
    """All tables of these runs, and those of further metric presets that the runs were scored under.

    Runs under different protocols, profiles or data never share a table, nor do presets.
    """
    groups: dict[tuple[str, str, str, str], list[RunResult]] = {}
    for result in results:
        groups.setdefault(result.group, []).append(result)
    return "\n\n".join(_group(key, runs, presets) for key, runs in groups.items()) + "\n"


def _group(key: tuple[str, str, str, str], runs: list[RunResult], presets: Sequence[str]) -> str:
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
    headline = done[0].record["about"]["headline"]
    identities = list(dict.fromkeys(i for run in done for i in run.rows[run.method]))
    lines = [*head, ""]
    for metric in dict.fromkeys(Identity.parse(i).metric for i in identities):
        columns = [i for i in identities if Identity.parse(i).metric == metric and _has_a_number(done, i)]
        if columns:
            shown = metric_of(columns[0])
            lines += [f"### {shown.title} {shown.arrow}{f' ({shown.unit})' if shown.unit else ''}", ""]
            first = metric == Identity.parse(identities[0]).metric
            lines += [*_table(done, [run.rows for run in done], columns, headline, with_costs=first), ""]
    lines.append(f"Mean over test views of a scene, then over scenes ({_scenes(done)}). Headline region: {headline}.")
    lines += [f"`{name}`" for name in _without_regions(identities)]
    lines += [f"- {row}: {DESCRIPTIONS[row]}" for row in ROWS if any(row in run.rows for run in done)]
    lines += _remarks(done)
    lines += stage_lines(done)
    lines += inpainting_section(_labelled(done))
    for preset in presets:
        lines += ["", *_preset(preset, done, headline)]
    lines += intervals_section(_labelled(done), identities, headline)
    return "\n".join(lines)


def _preset(name: str, runs: list[RunResult], headline: str) -> list[str]:
    """The table of one further preset, over the runs that were scored under it."""
    having = [run for run in runs if name in run.presets]
    lines = [f"### preset {name}", ""]
    if not having:
        return [*lines, f"No run was scored under {name}: ihbench report --preset {name}"]
    rows = [run.presets[name] for run in having]
    identities = list(dict.fromkeys(i for run, found in zip(having, rows, strict=True) for i in found[run.method]))
    columns = [
        i for i in identities if any(i in found[row] and not found[row][i].absent for found in rows for row in found)
    ]
    if columns:
        lines += [*_table(having, rows, columns, headline, with_metric=True), ""]
    lines += [f"`{name}`" for name in _without_regions(identities)]
    lines.append("- scored from the runs' 8-bit renders")
    absent = {
        f"- absent: {metric_of(i).title} of {name}: {found[run.method][i].reason}"
        for run, found in zip(having, rows, strict=True)
        for i in identities
        if i in found[run.method] and found[run.method][i].absent
    }
    return lines + sorted(absent)


def _has_a_number(runs: list[RunResult], identity: str) -> bool:
    """Whether any run has a method's number of this identity; `truth` and its like have them where methods do."""
    return any(identity in run.rows[run.method] and not run.rows[run.method][identity].absent for run in runs)


def _without_regions(identities: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(i.replace(f"/{Identity.parse(i).region}/", "/REGION/") for i in identities))


def _table(
    runs: list[RunResult],
    rows_of: Sequence[Rows],  # of each run
    columns: Sequence[str],
    headline: str,
    *,
    with_costs: bool = False,
    with_metric: bool = False,
) -> list[str]:
    parsed = [Identity.parse(i) for i in columns]
    titles = ["**" + i.region + "**" if i.region == headline else i.region for i in parsed]
    if with_metric:
        titles = [
            f"{metric_of(str(i)).title}{metric_of(str(i)).arrow} {t}" for i, t in zip(parsed, titles, strict=True)
        ]
    titles = [  # regions of several presets in one table
        f"{title} ({i.variant})" if titles.count(title) > 1 else title
        for i, title in zip(parsed, titles, strict=True)
    ]
    costs = ["fit s", "total s", "peak MB"] if with_costs else []
    head = ["method", "scenes", "seeds", *titles, *costs]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * 3 + "---:|" * (len(head) - 3)]
    by_label: dict[str, list[int]] = {}
    for k, run in enumerate(runs):
        by_label.setdefault(_label(run, runs), []).append(k)
    for label, chosen in by_label.items():
        group = [runs[k] for k in chosen]
        cells = [
            label,
            str(len({r.scene for r in group})),
            ", ".join(sorted({str(r.identity["seed"]) for r in group})),
        ]
        cells += [_cell([(runs[k].scene, rows_of[k][runs[k].method]) for k in chosen], i) for i in columns]
        if with_costs:
            cells += [_mean_of(group, "fit_seconds"), _mean_of(group, "total_seconds"), _largest(group, "peak_mb")]
        lines.append("| " + " | ".join(cells) + " |")
        method = group[0].method
        further = [row for k in chosen for row in rows_of[k] if row.startswith(f"{method} [")]
        for row in dict.fromkeys(further):  # groups of test views that the protocol scores apart
            having = [(runs[k].scene, rows_of[k][row]) for k in chosen if row in rows_of[k]]
            name = label + row.removeprefix(method)
            cells = [name, cells[1], cells[2], *(_cell(having, i) for i in columns), *([""] * len(costs))]
            lines.append("| " + " | ".join(cells) + " |")
    for row in ROWS:
        having = list(
            {r.scene: (r.scene, rows[row]) for r, rows in zip(runs, rows_of, strict=True) if row in rows}.values()
        )
        if having:
            cells = [f"*{row}*", str(len(having)), ""] + [_cell(having, i) for i in columns] + [""] * len(costs)
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def _labelled(runs: list[RunResult]) -> dict[str, list[RunResult]]:
    """Runs by their row's label."""
    found: dict[str, list[RunResult]] = {}
    for run in runs:
        found.setdefault(_label(run, runs), []).append(run)
    return found


def _label(run: RunResult, runs: list[RunResult]) -> str:
    """The method with what sets this row apart. Runs of several versions of its code are several rows."""
    changed = list(run.record["about"]["changed"])
    if run.record["about"].get("provenance") == "predictions":
        changed.append("predictions")
    if len({other.identity["code"] for other in runs if other.method == run.method}) > 1:
        changed.append(f"code {run.identity['code']}")
    return _plain(run.method + (f" ({', '.join(changed)})" if changed else ""))


def _plain(text: str) -> str:
    """Text that neither ends a table's cell or line nor is taken for HTML."""
    return " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;")


def _cell(per_run: list[tuple[str, dict[str, Mean]]], identity: str) -> str:
    """Mean over seeds within a scene, then over scenes."""
    by_scene: dict[str, dict[str, Mean]] = {}
    for k, (scene, means) in enumerate(per_run):
        if identity in means:
            by_scene.setdefault(scene, {})[str(k)] = means[identity]
    if not by_scene:
        return "—"
    return metric_of(identity).text(macro_mean({scene: macro_mean(runs) for scene, runs in by_scene.items()}).value)


def _mean_of(runs: list[RunResult], key: str) -> str:
    values = [run.record["about"][key] for run in runs]
    known = [value for value in values if value is not None]
    return f"{sum(known) / len(known):.0f}" if known else "—"


def _largest(runs: list[RunResult], key: str) -> str:
    return f"{max(run.record['about'][key] for run in runs):.0f}"


def _scenes(runs: list[RunResult]) -> str:
    return ", ".join(sorted({_plain(run.scene) for run in runs}))


def _remarks(runs: list[RunResult]) -> list[str]:
    """Why cells of the methods' rows are empty, what their means do not run over, what the plan left out."""
    absent: dict[tuple[str, str], list[str]] = {}
    partly: dict[tuple[str, str, str], list[str]] = {}
    notes: list[str] = []
    for run in runs:
        for identity, mean in run.rows[run.method].items():
            metric, region = metric_of(identity).title, Identity.parse(identity).region
            if mean.absent:
                absent.setdefault((metric, mean.reason), []).append(region)
            elif mean.note:
                partly.setdefault((run.scene, region, mean.note), []).append(metric)
        notes += [f"- left out: {o['field']} → {o['value']}: {o['reason']}" for o in run.record["about"]["left_out"]]
        notes += [
            f"- {_plain(f'{run.method} on {run.scene}')}: {note}"
            for note in run.record["about"].get("predictions", {}).get("notes", ())
        ]
    for (scene, region, note), metrics in partly.items():
        notes.append(f"- {region} of {_plain(scene)} ({', '.join(dict.fromkeys(metrics))}): {_plain(note)}")
    for (metric, reason), regions in absent.items():
        notes.append(f"- absent: {metric}, {', '.join(dict.fromkeys(regions))}: {_plain(reason)}")
    return sorted(set(notes))
