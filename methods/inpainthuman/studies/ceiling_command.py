"""`ihbench ceiling RUN...`: what finished runs would have reached with a better painter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from ihbench.commands.options.device import check_device
from ihbench.commands.options.printing import Report
from ihbench.config_fields import Within
from ihbench.document.document import Block, Heading, Table, write
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.spec import SPEC

if TYPE_CHECKING:
    from ihbench.methods.inpainthuman.studies.ceiling import CeilingRow
    from ihbench.record.results import RunResult

REGIONS = ("hidden", "visible", "never_seen")


@dataclass(frozen=True)
class CeilingOptions(Report):
    run: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Folders of finished runs that painted."""
    truth: Annotated[tuple[float, ...], Within(0, 1, above=True)] = (0.5, 1.0)
    """Shares of the way from the painted colours to the true ones; each costs a stage 3 per run."""
    data: Path | None = None
    """Your copy of the data set, if the runs used one."""
    body: Path | None = None
    """SMPL model file, likewise."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit."""
    out: Path | None = None
    """Folder for `ceiling.md` and `ceiling.json`."""


def main(argv: list[str]) -> int:
    from ihbench.commands.options.parse import options

    chosen = options(CeilingOptions, argv, "ceiling", f"Measure {SPEC.commands['ceiling'].summary}.")
    from ihbench.clock.progress import Progress
    from ihbench.methods.inpainthuman.studies.ceiling import ceiling
    from ihbench.record import outputs
    from ihbench.record.results import read_result

    if not chosen.run:
        raise BadInput("ceiling: of which run? give one or more run folders")
    if not chosen.truth:
        raise BadInput("--truth: expected one share or more")
    check_device(chosen.device)
    if chosen.out is not None:
        outputs.check(chosen.out, ["ceiling.md", "ceiling.json"])
    results = [read_result(folder) for folder in chosen.run]
    groups = {result.group[:3] for result in results}
    if len(groups) > 1:
        raise BadInput(f"ceiling: runs of one protocol and profile at a time, got {sorted(map(str, groups))}")
    progress, of_runs = Progress(), []
    blocks: list[Block] = []
    numbers: dict[str, object] = {}
    for result in results:
        shares = tuple(sorted(set(chosen.truth)))
        rows = ceiling(result.folder, shares, chosen.data, chosen.body, chosen.device, progress)
        of_runs.append((result.scene, rows))
        for row in rows:
            means = ", ".join(f"{region} {_mean(row, region):.2f}" for region in REGIONS)
            progress.say(f"{result.scene} seed {result.seed}, {row.name}: {means}")
        scenes = len({scene for scene, _ in of_runs})
        title = f"{results[0].identity.protocol}, {len(of_runs)} runs of {scenes} scenes, {results[0].data}"
        runs = [_numbers(r, its_rows) for r, (_, its_rows) in zip(results, of_runs, strict=False)]
        numbers = {"title": title, "runs": runs}
        blocks = table(of_runs, title)
        if chosen.out is not None:  # after every run: the next may take minutes
            outputs.write_text(chosen.out / "ceiling.md", write(blocks, "md"))
            outputs.write_json(chosen.out / "ceiling.json", numbers)
    chosen.show(numbers, blocks)
    return 0


def table(of_runs: Sequence[tuple[str, Sequence[CeilingRow]]], title: str) -> list[Block]:
    """A row for each painting, means over scenes, differences to stage 1 paired over scenes."""
    from ihbench.metrics.identity import METRICS

    regions = [region for region in REGIONS if any(math.isfinite(_mean(rows[0], region)) for _, rows in of_runs)]
    heads = [text for region in regions for text in (f"PSNR {region} ↑", "over stage 1")]
    lines = []
    for k, row in enumerate(of_runs[0][1]):
        quality = _average([(scene, rows[k].painted_psnr) for scene, rows in of_runs])
        cells = [METRICS["psnr"].text(_over_scenes(quality))]
        for region in regions:
            own = _average([(scene, _mean(rows[k], region)) for scene, rows in of_runs])
            first = _average([(scene, _mean(rows[0], region)) for scene, rows in of_runs])
            cells += [METRICS["psnr"].text(_over_scenes(own)), "" if row.truth is None else _gain(own, first)]
        lines.append((row.name, *cells))
    return [
        Heading(3, f"What a better painter would give: {title}"),
        Table(("paintings", "their PSNR ↑", *heads), tuple(lines)),
    ]


def _mean(row: CeilingRow, region: str) -> float:
    """PSNR of the first preset in a region; NaN where the protocol or the scene has none."""
    return next((v for i, v in row.scores.items() if (i.metric, i.region) == ("psnr", region)), math.nan)


def _average(values: Sequence[tuple[str, float]]) -> dict[str, float]:
    """Scene -> mean over its runs, of scenes that have the number."""
    scenes: dict[str, list[float]] = {}
    for scene, value in values:
        if not math.isnan(value):
            scenes.setdefault(scene, []).append(value)
    return {scene: sum(own) / len(own) for scene, own in scenes.items()}


def _over_scenes(values: Mapping[str, float]) -> float:
    return sum(values.values()) / len(values) if values else math.nan


def _gain(own: Mapping[str, float], first: Mapping[str, float]) -> str:
    both = sorted(set(own) & set(first))
    if not both:
        return "—"
    if len(both) == 1:
        return f"{own[both[0]] - first[both[0]]:+.2f}"
    from ihbench.metrics.statistics import paired_test

    pair = paired_test({s: own[s] for s in both}, {s: first[s] for s in both}).interval
    return f"{pair.value:+.2f} [{pair.low:+.2f}, {pair.high:+.2f}]"


def _numbers(result: RunResult, rows: Sequence[CeilingRow]) -> dict[str, object]:
    def plain(value: float) -> float | None:
        return None if math.isnan(value) else value

    return {
        "scene": result.scene,
        "seed": result.seed,
        "run": result.record.digest,
        "rows": [
            {
                "paintings": row.name,
                "truth": row.truth,
                "painted_psnr": plain(row.painted_psnr),
                "scores": {str(identity): plain(value) for identity, value in row.scores.items()},
            }
            for row in rows
        ],
    }
