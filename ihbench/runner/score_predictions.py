"""Scoring somebody else's renders as a run like any other."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from ihbench.clock.progress import Progress
from ihbench.data.prepared import Prepared
from ihbench.record.provenance import command
from ihbench.record.results import RunResult, read_result
from ihbench.record.schema import PredictionFiles
from ihbench.record.source_digest import bench_code
from ihbench.record.store import RunFolder
from ihbench.runner.recorded_run import RecordedRun, about_scene, identity_of, recorded
from ihbench.runner.score_stage import ScoreStage
from ihbench.scene.data_source import DataSource
from ihbench.scene.protocol import Protocol
from ihbench.scene.views import OccludedScene, open_scene
from ihbench.scoring.prediction_doubts import Doubts
from ihbench.scoring.predictions import Predictions, find_alpha, find_predictions
from ihbench.scoring.scoring import Scorer
from ihbench.version import __version__

if TYPE_CHECKING:
    from ihbench.body import Body


@dataclass(frozen=True)
class ScoreRequest:
    """What is to be scored."""

    protocol: Protocol
    folder: Path
    name: str  # the row's name in tables
    pattern: str | None = None
    runs: Path = Path("runs")
    body: Path | None = None  # SMPL model file, for real data
    force: bool = False
    alpha: str | None = None  # what the colours of transparent pixels are, see `ihbench.scoring.predictions`
    prepared: Prepared | None = None  # what was handed out to the code that drew the images


def score_scene(request: ScoreRequest, source: DataSource, scene: str, progress: Progress) -> RunResult:
    """Score a folder's images of one scene, or find that it is done. Raises `BadInput` as `find_predictions` does."""
    capture, body = source.open(scene, request.body, progress)
    if request.prepared is not None:
        request.prepared.check(capture, body)
    opened = open_scene(capture, request.protocol)
    predictions = find_predictions(request.folder, scene, opened.test_keys, request.pattern, source.scenes)
    background = request.protocol.image.background
    predictions = replace(predictions, alpha=find_alpha(list(predictions.files.values()), background, request.alpha))
    code = f"{__version__}+{bench_code(request.protocol)}"
    config = {"predictions": predictions.digest}
    identity = identity_of(request.protocol, capture, body, request.name, config, 0, code)
    files = PredictionFiles(
        predictions.missing,
        predictions.surplus,
        tuple(predictions.notes()),
        folder=request.folder.resolve().name,
        pattern=predictions.pattern,
        alpha=predictions.alpha,
        views=len(opened.test_keys),
    )
    about = replace(
        about_scene(capture, request.protocol, "cpu", command()), predictions=files, changed={}, left_out=()
    )
    result = recorded(
        request.runs,
        identity,
        about,
        request.force,
        lambda folder: _ScoreRun(request, predictions, opened, body, folder, progress),
    )
    before = result.about.predictions
    files = replace(files, doubts=() if before is None else before.doubts)
    if before == files:
        return result
    folder = RunFolder.open(result.folder)  # the same images were scored before, beside other stray files
    with folder.lock():
        folder.describe(predictions=files)
        folder.save()
    return read_result(result.folder)


class _ScoreRun(RecordedRun):
    """The scoring of one scene in progress."""

    def __init__(
        self,
        request: ScoreRequest,
        found: Predictions,
        scene: OccludedScene,
        body: Body,
        folder: RunFolder,
        progress: Progress,
    ):
        super().__init__(folder, progress)
        self.request, self.found, self.scene, self.body = request, found, scene, body

    def work(self) -> None:
        with self.ledger.stage("load"):
            self.scene.train.preload().wait()
        with self.ledger.stage("visibility"):
            scorer = Scorer.build(self.scene)
        with self.ledger.stage("score"):
            stage = ScoreStage(scorer, self.folder, self.request.runs, self.progress, self.request.force)
            background = self.scene.protocol.image.background
            doubts = Doubts(background)
            stage.run(
                self.request.name,
                lambda loaded: self.found.read(loaded.key, background),
                threaded=True,
                look=doubts.look,
            )
            files = self.folder.about.predictions
            if files is not None:
                self.folder.describe(predictions=replace(files, doubts=tuple(doubts.notes())))
        self.describe(hidden_share=self.scene.hiding.hidden_share(), fit_seconds=None)
        self.folder.set_status("done", ledger=self.ledger)
