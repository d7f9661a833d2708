"""The scoring stage of a run: every test view against the truth, calibration rows beside it, a contact sheet."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.files.images import write_png
from ihbench.metrics.eight_bit import displayed
from ihbench.record.results import group_row, view_rows
from ihbench.record.schema import ScoreLine, score_lines
from ihbench.record.source_digest import bench_code
from ihbench.record.store import RunFolder
from ihbench.scene.spread import spread
from ihbench.scene.views import OccludedScene
from ihbench.scoring.calibration import ROWS, Calibration
from ihbench.scoring.contact_sheet import SheetRow, contact_sheet
from ihbench.scoring.scoring import LoadedView, Predictor, Scorer

SHEET_VIEWS = 5  # test views on the contact sheet
SHEET_SIZE = 512  # px; smaller images are enlarged on it by a whole factor


@dataclass(frozen=True)
class ScoreStage:
    """Scores one row, a method's or somebody's predictions, over all test views of a scene."""

    scorer: Scorer
    folder: RunFolder
    runs: Path  # where calibration rows are kept for all runs on the same data
    progress: Progress
    force: bool = False  # compute calibration rows again

    def run(
        self,
        name: str,
        predict: Predictor,
        threaded: bool = False,
        look: Callable[[LoadedView, NDArray], None] | None = None,
    ) -> None:
        """Write scores.jsonl, calibration.jsonl, renders/ and contact_sheet.png. `threaded`: see `Scorer.scored`.

        `look` is shown every image, on other threads.
        """
        scene = self.scorer.scene
        rows, kept = {name: predict}, self._kept_calibration()
        if kept is None:
            rows |= self.calibration_rows()
        on_sheet, sheet = spread(len(scene.test_keys), SHEET_VIEWS), []

        def write_render(loaded: LoadedView, images: dict[str, NDArray | None]) -> None:
            image = images[name]
            if image is not None:
                write_png(render_path(self.folder, loaded), displayed(image))
                if look is not None:
                    look(loaded, image)

        results = {row: [] for row in rows}
        with self.progress.task("scoring", len(scene.test_keys)) as task:
            indices = range(len(scene.test_keys))
            for scored in self.scorer.scored(rows, indices, after_each=write_render, threaded=threaded):
                for row, scores in scored.scores.items():
                    results[row].append(scores)
                if scored.loaded.index in on_sheet:
                    sheet.append(_sheet_row(scene, scored.loaded, scored.images[name]))
                task.advance()
        if kept is None:
            kept = [line for row in ROWS for line in view_rows(row, results[row])]
            atomic.write_json_lines(self._calibration_file(), as_json(kept))
        atomic.write_json_lines(self.folder.path / "calibration.jsonl", as_json(kept))
        self.folder.write_scores(view_rows(name, results[name]))
        identity, capture = self.folder.identity, scene.capture
        title = f"{identity.protocol}  {capture.name}  {name}  {scene.protocol.profile}"
        if capture.standin:
            title += f"  ({capture.standin})"
        zoom = max(1, SHEET_SIZE // scene.protocol.image.size)
        write_png(self.folder.path / "contact_sheet.png", contact_sheet(sheet, title, zoom))

    def calibration_rows(self) -> dict[str, Predictor]:
        """The predictors of the calibration rows."""
        calibration = Calibration.build(self.scorer.scene.training)
        return {row: (lambda loaded, row=row: calibration.predict(row, loaded.view)) for row in ROWS}

    def _kept_calibration(self) -> list[ScoreLine] | None:
        """Rows that an earlier run on the same data has computed. A damaged file is computed again."""
        file = self._calibration_file()
        if self.force or not file.is_file():
            return None
        try:
            lines = score_lines(file)
        except BadInput as damage:
            self.progress.say(f"calibration rows are computed again: {damage}")
            return None
        keys = self.scorer.scene.test_keys
        views = {(group_row(row, key.group), key.camera_id, key.frame) for row in ROWS for key in keys}
        return lines if {(line.row, line.camera, line.frame) for line in lines} == views else None

    def _calibration_file(self) -> Path:
        """Calibration rows depend on data, protocol and the bench's code only: computed once for all runs."""
        identity, protocol = self.folder.identity, self.scorer.scene.protocol
        parts = [bench_code(protocol), identity.protocol_digest, identity.scene, identity.data, identity.body]
        for preset in self.scorer.presets:
            parts += [*preset.identities(protocol.metrics.regions, protocol.image.background), *preset.lacking()]
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
        return self.runs / "calibration" / f"{digest}.jsonl"


def render_path(folder: RunFolder, loaded: LoadedView) -> Path:
    """Where the 8-bit image of a test view lies in a run folder."""
    return folder.renders / loaded.key.camera_id / f"{loaded.key.frame:06d}.png"


def _sheet_row(scene: OccludedScene, loaded: LoadedView, image: NDArray | None) -> SheetRow:
    truth = loaded.view.image
    shown = np.zeros_like(truth) if image is None else (displayed(image) / 255).astype(np.float32)
    label = loaded.key.name + (" (no prediction)" if image is None else "")
    return SheetRow(label, scene.nearest_training(loaded.key.frame).image, truth, shown, loaded.view.hidden)
