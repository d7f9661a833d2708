"""What must be said beside the numbers of some rows: why cells are empty, what means do not run over, what the plan
and the fits themselves left out, and what else the fits warn of."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

from ihbench.clock.events import LeftOut, RolledBack, Warned
from ihbench.document.metric_names import named
from ihbench.record.results import RunResult, grouped
from ihbench.record.row_labels import by_label
from ihbench.record.shareable import without_places

PLAN, FIT, BACK, WARNING = "left out by the plan", "left out by the fit", "rolled back", "warning"


def remarks(runs: Sequence[RunResult]) -> list[str]:
    """One line for each remark on some rows' finished runs, with the rows and scenes that it is of."""
    notes: list[str] = []
    rows, names = by_label(runs), named(i for run in runs for i in run.own)
    for label, group in rows.items():
        if lacks := lacking(group, runs):
            notes.append(f"{label}: {lacks}")
        for kind in (PLAN, FIT, BACK, WARNING):
            for text, having in _runs_by_text(group, kind).items():
                notes.append(f"{kind}, {label} on {_scenes(having)}{_share(having, group)}: {text}")
    for run in runs:
        files = run.about.predictions
        said = () if files is None else (*files.notes, *files.doubts)
        notes += [f"{run.method} on {run.scene}: {note}" for note in said]
        notes += [f"{run.method} on {run.scene}: not shown: {damage}" for damage in run.damage]
    scored = [(label, run, i, mean) for label, group in rows.items() for run in group for i, mean in run.own.items()]
    partly = (
        ((label, run.scene, i.region, mean.note), names[i]) for label, run, i, mean in scored if not mean.absent
    )
    absent = (((label, names[i], mean.reason), i.region) for label, _, i, mean in scored if mean.absent)
    for (scene, region, note), metrics, of in _alike(((key, metric) for key, metric in partly if key[-1]), rows):
        notes.append(f"{region} of {scene} ({metrics}){of}: {note}")
    for (metric, reason), regions, of in _alike(absent, rows):
        notes.append(f"absent: {metric}, {regions}{of}: {reason}")
    return sorted(set(notes))


def _alike(
    found: Iterable[tuple[tuple[str, ...], str]], rows: Collection[str]
) -> Iterator[tuple[tuple[str, ...], str, str]]:
    """(row, key...) with a word each -> key, its words, and the rows that have just these: ", ours"; "" for all."""
    words = {key: ", ".join(dict.fromkeys(those)) for key, those in grouped(found).items()}
    for (key, those), labels in grouped(((key[1:], those), key[0]) for key, those in words.items()).items():
        yield key, those, "" if len(labels) == len(rows) else f", {', '.join(labels)}"


def lacking(row: Sequence[RunResult], block: Sequence[RunResult]) -> str:
    """Which scenes and seeds a row's mean does not run over that other rows of its block have: "over 4 of 6 scenes,
    without e, f"; "" where it has all of them. Both hold finished runs."""
    scenes, having = {run.scene for run in block}, {run.scene for run in row}
    seeds = {(run.scene, run.seed) for run in block if run.scene in having} - {(run.scene, run.seed) for run in row}
    parts = []
    if missing := scenes - having:
        parts.append(f"over {len(having)} of {len(scenes)} scenes, without {', '.join(sorted(missing))}")
    for seed, of in sorted(grouped((seed, scene) for scene, seed in seeds).items()):
        parts.append(f"without seed {seed} on {', '.join(sorted(of))}")
    return "; ".join(parts)


def row_footnotes(runs: Sequence[RunResult], kinds: Sequence[str] = (PLAN, FIT, BACK)) -> list[str]:
    """What sets a row's finished runs apart from the whole system, a sentence for each kind: what the plan and the
    fits left out, and fits that went back to an earlier step."""
    notes = []
    for kind in kinds:
        found = _runs_by_text(runs, kind, reasons=kind != PLAN)
        parts = [f"{text} ({'all runs' if len(having) == len(runs) else _scenes(having) + _share(having, runs)})"
                 for text, having in found.items()]  # fmt: skip
        notes += [f"{kind.capitalize()}: {'; '.join(parts)}."] if parts else []
    return notes


def said_by(run: RunResult, reasons: bool = True) -> Mapping[str, list[str]]:
    """Kind of remark -> what the record says, in words, each thing once; with `reasons`, why the plan left it out. No
    text names a place of the machine that made the run."""
    said: dict[str, list[str]] = {PLAN: [], FIT: [], BACK: [], WARNING: [*run.record.warnings]}
    for o in run.about.left_out or ():
        said[PLAN].append(f"{o.field} → {o.value}" + (f": {o.reason}" if reasons else ""))
    for event in run.record.events:
        what, reason, stage = (str(event.data.get(name, "")) for name in ("what", "reason", "stage"))
        if event.kind == LeftOut.kind:
            said[FIT].append(f"{what}: {reason}" if reason else what)
        elif event.kind == RolledBack.kind:
            said[BACK].append(f"{stage}: {what}")
        elif event.kind == Warned.kind:
            said[WARNING].append(what)
    return {kind: list(dict.fromkeys(without_places(t, run.folder) for t in texts)) for kind, texts in said.items()}


def _runs_by_text(runs: Sequence[RunResult], kind: str, reasons: bool = True) -> dict[str, list[RunResult]]:
    return grouped((text, run) for run in runs for text in said_by(run, reasons)[kind])


def _scenes(runs: Sequence[RunResult]) -> str:
    return ", ".join(sorted({run.scene for run in runs}))


def _share(having: Sequence[RunResult], of: Sequence[RunResult]) -> str:
    return f", {len(having)} of {len(of)} runs" if len(having) < len(of) else ""
