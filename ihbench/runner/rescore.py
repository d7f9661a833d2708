"""Scoring a finished run's stored renders again, under a metric preset that its protocol does not name.

The renders are 8-bit PNG files. An evaluator that would have seen the floats sees them rounded here; InstantAvatar's
reads PNG files itself, and our own preset rounds, so for those nothing changes. A run that could not compute a metric
(no weights then) gets it the same way.
"""

from __future__ import annotations

from pathlib import Path

from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.images import read_image
from ihbench.metrics.evaluate import Preset, find_preset
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import view_rows
from ihbench.record.schema import PresetHead, preset_lines
from ihbench.record.source_digest import bench_code
from ihbench.record.store import RunFolder
from ihbench.runner.score_stage import ScoreStage, render_path
from ihbench.scoring.scoring import LoadedView, Scorer, ViewScores


def rescore(folder: Path, preset: str, data: Path | None, body: Path | None, progress: Progress) -> None:
    """Score a run's renders and its calibration rows under a preset, into `presets/NAME.jsonl` of the run folder.

    What is there already is left, unless other code made it or a metric was absent for want of something that is here
    now. Raises `BadInput` for an unknown preset, a run that is not done, and data that are not the run's.
    """
    chosen = find_preset(preset)
    run, made_on = RunFolder.open(folder), FinishedRun(folder, data, body)
    if run.status != "done":
        raise BadInput(f"{folder}: is {run.status}, only finished runs have renders to score")
    file = folder / "presets" / f"{chosen.name}.jsonl"
    code = bench_code(made_on.protocol, (chosen.name,))
    if file.is_file() and _stands(file, chosen, code):
        return
    scene = made_on.scene
    scorer = Scorer.build(scene, [chosen.name])
    name = run.identity.method
    rows = {name: lambda loaded: _render(run, loaded)}
    rows |= ScoreStage(scorer, run, folder.parent, progress).calibration_rows()
    results: dict[str, list[ViewScores]] = {row: [] for row in rows}
    with run.lock(), progress.task(f"scoring {scene.capture.name} as {preset}", len(scene.test_keys)) as task:
        for scored in scorer.scored(rows, range(len(scene.test_keys)), threaded=True):
            for row, scores in scored.scores.items():
                results[row].append(scores)
            task.advance()
        lines = [line for row, scores in results.items() for line in view_rows(row, scores)]
        atomic.write_json_lines(file, as_json([PresetHead(tuple(chosen.lacking()), code), *lines]))


def _render(run: RunFolder, loaded: LoadedView) -> NDArray | None:
    path = render_path(run, loaded)
    return read_image(path, (1.0, 1.0, 1.0)) if path.is_file() else None


def _stands(file: Path, preset: Preset, code: str) -> bool:
    """Whether the file would come out the same now: by this code, and without a metric that was absent then and can
    be computed now."""
    try:
        head, _ = preset_lines(file)
    except BadInput:  # damaged: the renders are there to be scored again
        return False
    return head.code == code and set(head.lacking) <= set(preset.lacking())
