"""The ablation table: every variant of a suite, and what each component is worth in quality and in seconds.

Seeds are averaged within a scene; the scene is the unit of intervals and tests.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from ihbench.document.document import Block, Heading, Paragraph, Table, Words, bullets
from ihbench.document.metric_names import heads
from ihbench.metrics import Identity
from ihbench.metrics.identity import Metric
from ihbench.metrics.statistics import Interval, holm, mean_interval, paired_test
from ihbench.record.results import RunResult, grouped
from ihbench.record.scene_means import per_scene, seed_means
from ihbench.reports.general.clock import clock_notes, one_clock, positive_interval
from ihbench.reports.general.content import data_words
from ihbench.reports.general.remarks import BACK, FIT, row_footnotes
from ihbench.reports.general.significance import ALPHA, LEVEL
from ihbench.runner.ablation import AblationSuite, Comparison
from ihbench.runner.executor import CellOutcome

REGIONS = ("visible", "hidden", "never_seen")  # beside the headline
PAPER = {"psnr": ("PSNR", 2), "ssim": ("SSIM", 4), "lpips": ("LPIPS*", 2)}

Found = list[tuple[str, CellOutcome]]  # variant and outcome of every run


def write(suite: AblationSuite, found: Found) -> tuple[list[Block], dict[str, Any]]:
    """The document, and its numbers for programs (strict JSON). One table for each protocol."""
    protocols = grouped((outcome.cell.request.protocol.name, (variant, outcome)) for variant, outcome in found)
    blocks: list[Block] = [Heading(2, f"Ablation: {suite.title}")]
    tables = []
    for protocol, cells in protocols.items():
        tables_of, numbers = _table(suite, protocol, cells)
        blocks += tables_of
        tables.append(numbers)
    if len(tables) > 1:
        blocks += _severities(suite, tables)
    failures = [
        f"{o.cell.name}: {o.problem if o.result is None else o.result.outcome}" for _, o in found if not o.done
    ]
    if failures:
        blocks += [Paragraph("Not done:"), *bullets(failures)]
    if suite.note:
        blocks.append(Paragraph(suite.note))
    return blocks, {"ladder": suite.title, "tables": tables, "failed": failures}


def _table(suite: AblationSuite, protocol: str, cells: Found) -> tuple[list[Block], dict[str, Any]]:
    runs: dict[str, list[RunResult]] = {variant.name: [] for variant in suite.variants}
    for variant, outcome in cells:
        if outcome.done and outcome.result is not None:
            runs[variant].append(outcome.result)
    done = [run for having in runs.values() for run in having]
    request = cells[0][1].cell.request
    blocks: list[Block] = [Heading(3, f"{protocol}, {request.method}, {request.protocol.profile} profile")]
    if not done:
        return [*blocks, Paragraph("No run was finished.")], {"protocol": protocol, "rungs": {}, "comparisons": []}
    headline = done[0].headline
    columns = _columns(done, headline)
    quoted = [m for m in PAPER if any(m in variant.paper for variant in suite.variants)]
    titles = [*heads(columns, region=True).values()]
    titles += ["fit s"] + [f"paper's {PAPER[m][0]}" for m in quoted]
    blocks.append(Paragraph(("Data: ", *data_words(done[0]), ".")))
    lines: list[tuple[Words, ...]] = []
    variants: dict[str, Any] = {}
    for variant in suite.variants:
        having = runs[variant.name]
        asked = sum(name == variant.name for name, _ in cells)
        scores = {i: _interval(per_scene(having, i)) for i in columns}
        spent = _seconds(having) if one_clock(having) else {}
        seconds = positive_interval(spent, LEVEL) if spent else None
        cells_shown = [_shown(scores[i], i.display) for i in columns] + [
            "—" if seconds is None else f"{seconds.value:.0f}"
        ]
        cells_shown += [f"{variant.paper[m]:.{PAPER[m][1]}f}" if m in variant.paper else "" for m in quoted]
        counted = f"{len(having)}" if len(having) == asked else f"{len(having)} of {asked}"
        scenes = len({run.scene for run in having})
        lines.append((variant.name, str(scenes), counted, *cells_shown))
        variants[variant.name] = {
            "switches": {n: list(v) if isinstance(v, tuple) else v for n, v in variant.switches.items()},
            "runs": len(having),
            "asked": asked,
            "scores": {str(i): _numbers(interval) for i, interval in scores.items()},
            "fit_seconds": _numbers(seconds),
            "left_out": _omissions(having),
            "paper": dict(variant.paper),
        }
    blocks.append(Table(("rung", "scenes", "runs", *titles), tuple(lines)))
    timed = grouped((variant, run) for variant, having in runs.items() for run in having if run.timed)
    notes: list[Words] = []
    for variant, having in runs.items():
        omissions = [f"{what} in {n} of {len(having)} runs" for what, n in _omissions(having).items()]
        notes += [f"left out by the plan, {variant}: {'; '.join(omissions)}"] if omissions else []
        notes += [f"{variant}: {note}" for note in row_footnotes(having, (FIT, BACK))]
    blocks += bullets([*notes, *clock_notes(timed)])
    more, compared = _comparisons(suite.comparisons, runs, columns)
    if quoted:
        quotes = "The paper's numbers are quoted: its own data, whole images, LPIPS* = 1000 × LPIPS."
        blocks.append(Paragraph(quotes))
    if more:
        blocks += [Paragraph("What each component is worth (paired over scenes, mean over seeds):"), *more]
    return blocks, {"protocol": protocol, "headline": headline, "rungs": variants, "comparisons": compared}


def _omissions(runs: Sequence[RunResult]) -> dict[str, int]:
    """What the plan left out -> in how many of the runs."""
    planned = [(field, value) for run in runs for field, value in run.planned.items()]
    texts = [f"{name} → {'+'.join(map(str, v)) if isinstance(v, list | tuple) else v}" for name, v in planned]
    return dict(Counter(texts))


def _columns(runs: Sequence[RunResult], headline: str) -> list[Identity]:
    """PSNR of the headline region and of what training showed of the surface, then the other metrics' headline."""
    having = list(dict.fromkeys(i for run in runs for i, mean in run.own.items() if not mean.absent))
    psnr = [i for region in (headline, *REGIONS) for i in having if (i.metric, i.region) == ("psnr", region)]
    return list(dict.fromkeys([*psnr, *(i for i in having if i.region == headline)]))


def _comparisons(
    wanted: Sequence[Comparison], runs: Mapping[str, Sequence[RunResult]], columns: Sequence[Identity]
) -> tuple[list[Block], list[dict[str, Any]]]:
    """A table of differences, p adjusted over a column's comparisons; and the numbers."""
    rows: list[dict[str, Any]] = []
    for comparison in wanted:
        before, after = _of_both(runs[comparison.without], runs[comparison.having])
        row: dict[str, Any] = {"what": comparison.what, "without": comparison.without, "with": comparison.having}
        row["scores"] = {str(i): _paired(per_scene(after, i), per_scene(before, i)) for i in columns}
        alike = one_clock([*before, *after])
        row["fit_seconds"] = _more_seconds(after, before) if alike else None
        rows.append(row)
    impossible = []
    for i in map(str, columns):
        tested = [row["scores"][i] for row in rows if row["scores"][i] is not None and row["scores"][i]["n"] > 1]
        for pair, p in zip(tested, holm([pair["p"] for pair in tested]), strict=True):
            pair["p_adjusted"] = p
        if tested:  # the smallest p is multiplied by the number of tests
            impossible.append(min(len(tested) * min(pair["smallest_p"] for pair in tested), 1.0))
    rows = [row for row in rows if any(row["scores"].values())]
    if not rows:
        return [], []
    titles = [*heads(columns, region=True).values()]
    lines: list[tuple[Words, ...]] = []
    for row in rows:
        n = max(pair["n"] for pair in row["scores"].values() if pair)
        cells = [_difference(row["scores"][str(i)], i.display.scale, i.display.decimals) for i in columns]
        cells.append(_difference(row["fit_seconds"]))
        lines.append((row["what"], str(n), *cells))
    if impossible:
        said = f"[{LEVEL:.0%} interval]; * better or worse with p < {ALPHA} (sign-flip test, Holm over the rows)."
        if min(impossible) >= ALPHA:
            said += (
                f" With so few scenes for so many comparisons no adjusted p can be below {min(impossible):.2g}, so "
                f"nothing can be marked: read the intervals, or ask less with --vary."
            )
    else:
        said = "One scene: differences have no interval and no test."
    return [Table(("component", "scenes", *titles, "fit s"), tuple(lines)), Paragraph(said)], rows


def _of_both(a: Sequence[RunResult], b: Sequence[RunResult]) -> tuple[list[RunResult], list[RunResult]]:
    """The runs of scenes and seeds that both have: one that failed is missing on both sides."""
    common = {(run.scene, run.seed) for run in a} & {(run.scene, run.seed) for run in b}
    first, second = ([run for run in runs if (run.scene, run.seed) in common] for runs in (a, b))
    return first, second


def _paired(a: Mapping[str, float], b: Mapping[str, float]) -> dict[str, Any] | None:
    """The first minus the second over the scenes of both; None without any. One scene has neither interval nor p."""
    common = sorted(set(a) & set(b))
    if not common:
        return None
    if len(common) == 1:
        return {"mean": a[common[0]] - b[common[0]], "low": None, "high": None, "p": None, "smallest_p": None, "n": 1}
    test = paired_test({s: a[s] for s in common}, {s: b[s] for s in common})
    return {
        "mean": test.interval.value, "low": test.interval.low, "high": test.interval.high,
        "p": test.p, "smallest_p": test.smallest_p, "n": len(common),
    }  # fmt: skip


def _difference(pair: dict[str, Any] | None, scale: float = 1.0, decimals: int = 0) -> str:
    """The difference, its interval, and of seconds the share."""
    if pair is None:
        return "—"
    shown = [pair[name] for name in ("mean", "low", "high") if pair[name] is not None]
    mean, *ends = (f"{value * scale:+z.{decimals}f}" for value in shown)
    mark = "*" if pair.get("p_adjusted", 1.0) < ALPHA else ""
    share = "" if pair.get("share") is None else f", {pair['share']:+z.0%}"
    return mean + mark + (f" [{', '.join(ends)}]" if ends else "") + share


def _more_seconds(after: Sequence[RunResult], before: Sequence[RunResult]) -> dict[str, Any] | None:
    """As `_paired`, with the share that the difference is of the seconds before; None where these are 0."""
    without = _seconds(before)
    pair = _paired(_seconds(after), without)
    mean = math.fsum(without.values()) / max(len(without), 1)
    return None if pair is None else pair | {"share": pair["mean"] / mean if mean > 0 else None}


def _severities(suite: AblationSuite, tables: Sequence[Mapping[str, Any]]) -> list[Block]:
    """One line a variant, one column a protocol: the headline's first metric."""
    having = [table for table in tables if table["rungs"]]
    if not having:
        return []
    first = next(iter(next(iter(having[0]["rungs"].values()))["scores"]))
    identity = Identity.parse(first)
    metric = identity.display
    lines: list[tuple[Words, ...]] = []
    for variant in suite.variants:
        scores = [table["rungs"].get(variant.name, {}).get("scores", {}).get(first) for table in having]
        lines.append((variant.name, *("—" if s is None else metric.text(s["mean"]) for s in scores)))
    title = f"{metric.head(identity.region)} over protocols"
    return [Heading(3, title), Table(("rung", *(table["protocol"] for table in having)), tuple(lines))]


def _seconds(runs: Sequence[RunResult]) -> dict[str, float]:
    """Scene -> mean fit seconds."""
    return seed_means((run.scene, run.fit_seconds) for run in runs if run.timed)


def _interval(per: Mapping[str, float]) -> Interval | None:
    return mean_interval(per, LEVEL) if per else None


def _numbers(interval: Interval | None) -> dict[str, float | None] | None:
    """For JSON, which knows no NaN."""
    if interval is None:
        return None
    low, high = (end if math.isfinite(end) else None for end in (interval.low, interval.high))
    return {"mean": interval.value, "low": low, "high": high, "n": interval.n}


def _shown(interval: Interval | None, metric: Metric) -> str:
    if interval is None:
        return "—"
    text = metric.text(interval.value)
    if math.isfinite(interval.low):
        half = (interval.high - interval.low) / 2 * metric.scale
        text += f" ± {half:.{metric.decimals}f}"
    return text
