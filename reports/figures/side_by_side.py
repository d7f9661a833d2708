"""`ihbench figures visual` and `ablation`: test views of several runs beside the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ihbench.body.skinning_numpy import axis_angle_to_matrix
from ihbench.document.picture_sheet import Panel, PictureSheet
from ihbench.errors import BadInput
from ihbench.files.images import read_image
from ihbench.metrics.eight_bit import displayed
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import RunResult, read_result
from ihbench.record.row_labels import by_label
from ihbench.record.schema import score_lines
from ihbench.record.store import RunFolder
from ihbench.runner.score_stage import render_path
from ihbench.scene.contracts import MaskState, TestView, TrainView
from ihbench.scene.method_spec import method_spec
from ihbench.scene.spread import spread
from ihbench.scene.views import OccludedScene
from ihbench.scoring.contact_sheet import GREY, common_window, error_image, with_occluder
from ihbench.scoring.scoring import LoadedView, Scorer

MARGIN = 0.04  # of the body's height, for hair and clothes
INPUT, TRUTH = "training input", "ground truth"


def visual(runs: Sequence[FinishedRun], views: int) -> PictureSheet:
    """A row for each test view, of every person: occluded input, truth, and what each row of the table rendered, with
    the view's PSNR. `views` of each person, evenly spread.

    Raises `BadInput` for runs that may not stand in one table, and for pictures that are missing.
    """
    table = Table(runs)
    rows: list[tuple[str, list[Panel | None]]] = []
    for scene in table.scenes:
        for loaded in scene.spread(views):
            images, truth = scene.renders(loaded), scene.truth(loaded)
            window = common_window([truth, *(image for image in images.values() if image is not None)])
            panels: list[Panel | None] = [Panel(scene.training_input(loaded)), Panel(truth[window])]
            panels += [
                None if image is None else Panel(image[window], scene.quality(label, loaded))
                for label, image in images.items()
            ]
            rows.append((f"{scene.name}, {loaded.key.name}", panels))
    caption = f"Held-out test views of {table.people} under {table.conditions}. {table.note}"
    return PictureSheet((INPUT, TRUTH, *map(table.head, table.labels)), rows, caption)


def ablation(runs: Sequence[FinishedRun], views: int) -> PictureSheet:
    """Two rows for each test view: what each variant rendered beside the truth, and its error times four.

    Raises `BadInput` as `visual`, and for runs of several methods.
    """
    table = Table(runs)
    methods = {run.method for run in table.results}
    if len(methods) > 1:
        raise BadInput(f"runs of the methods {', '.join(sorted(methods))}; an ablation compares variants of one")
    rows: list[tuple[str, list[Panel | None]]] = []
    for scene in table.scenes:
        for loaded in scene.spread(views):
            images, truth = scene.renders(loaded), scene.truth(loaded)
            window = common_window([truth, *(image for image in images.values() if image is not None)])
            drawn: list[Panel | None] = [Panel(truth[window])]
            wrong: list[Panel | None] = [None]
            for label, image in images.items():
                drawn.append(None if image is None else Panel(image[window], scene.quality(label, loaded)))
                wrong.append(None if image is None else Panel(scene.error(loaded, image)[window]))
            rows += [(f"{scene.name}, {loaded.key.name}", drawn), ("error x 4", wrong)]
    caption = f"Variants of {methods.pop()} on {table.people} under {table.conditions}. {table.note}"
    own = [_without(label, table.results[0].method) for label in table.labels]
    return PictureSheet((TRUTH, *own), rows, caption)


def occluded_views(scene: OccludedScene) -> list[TrainView]:
    """The training views in which something is hidden; all of them where nothing is."""
    views = list(scene.train)
    return [view for view in views if (view.mask == MaskState.UNKNOWN).any()] or views


def _without(label: str, method: str) -> str:
    """The label without the method's name, which all of them have: what sets the variant apart."""
    apart = label.removeprefix(method).strip()
    return apart.removeprefix("(").removesuffix(")") if apart else label


@dataclass(frozen=True)
class _Scene:
    """One person: the runs of it, by the labels of their rows."""

    name: str
    runs: dict[str, tuple[FinishedRun, RunResult]]

    @cached_property
    def made_on(self) -> OccludedScene:
        return next(iter(self.runs.values()))[0].scene

    @cached_property
    def scorer(self) -> Scorer:
        return Scorer.build(self.made_on)

    def spread(self, views: int) -> Iterator[LoadedView]:
        own = [k for k, key in enumerate(self.made_on.test_keys) if not key.group] or list(
            range(len(self.made_on.test_keys))
        )
        return (self.scorer.load(own[k]) for k in spread(len(own), views))

    @cached_property
    def occluded(self) -> list[TrainView]:
        return occluded_views(self.made_on)

    def training_input(self, loaded: LoadedView) -> NDArray[np.uint8]:
        """The training view that shows the person most nearly from the same side, cut to the person."""
        side = _side(loaded.view)
        view = max(self.occluded, key=lambda view: np.trace(side.T @ _side(view)))
        pixels = view.camera.project(self.made_on.capture.model.pose(view.body_pose))[:, :2]
        height, width = view.mask.shape
        margin = MARGIN * np.ptp(pixels[:, 1])
        (left, top), (right, bottom) = pixels.min(0) - margin, pixels.max(0) + margin
        rows = slice(int(np.clip(top, 0, height - 1)), int(np.clip(bottom, 1, height)) + 1)
        columns = slice(int(np.clip(left, 0, width - 1)), int(np.clip(right, 1, width)) + 1)
        return with_occluder(view)[rows, columns]

    def truth(self, loaded: LoadedView) -> NDArray[np.uint8]:
        image = displayed(loaded.view.image)
        if loaded.view.hidden is not None:
            image[loaded.view.hidden] = GREY
        return image

    def error(self, loaded: LoadedView, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        error = error_image((image / 255).astype(np.float32), loaded.view.image)
        if loaded.view.hidden is not None:
            error[loaded.view.hidden] = GREY
        return error

    def renders(self, loaded: LoadedView) -> dict[str, NDArray[np.uint8] | None]:
        """Label -> what the run rendered; None for a view that it has no picture of."""
        images: dict[str, NDArray[np.uint8] | None] = {}
        for label, (run, _) in self.runs.items():
            file = render_path(RunFolder.open(run.folder), loaded)
            images[label] = displayed(read_image(file, (1.0, 1.0, 1.0))) if file.is_file() else None
        return images

    def quality(self, label: str, loaded: LoadedView) -> str:
        """PSNR of this view in the headline's region, as scores.jsonl has it."""
        run, result = self.runs[label]
        wanted = result.method, str(loaded.key.camera_id), loaded.key.frame
        for line in score_lines(run.folder / "scores.jsonl"):
            if (line.row, str(line.camera), line.frame) != wanted:
                continue
            for identity, value in line.scores.items():
                if (identity.metric, identity.region) == ("psnr", result.headline) and value is not None:
                    return f"{value:.2f} dB"
        return ""


def _side(view: TrainView | TestView) -> NDArray[np.float64]:
    """[3, 3] how the person is turned before the camera."""
    return view.camera.R @ axis_angle_to_matrix(view.body_pose.pose[0])


class Table:
    """Runs that may stand beside each other: the first seed of each row and person."""

    def __init__(self, runs: Sequence[FinishedRun]):
        opened = [(run, read_result(run.folder)) for run in runs]
        unfinished = [f"{result.folder} is {result.status}" for _, result in opened if result.status != "done"]
        if unfinished:
            raise BadInput(f"{unfinished[0]}; figures are of finished runs")
        groups = {result.group for _, result in opened}
        if len(groups) > 1:
            names = sorted({f"{protocol} ({profile}, {data})" for protocol, _, profile, data in groups})
            raise BadInput(f"runs under {' and '.join(names)} may not stand beside each other; name those of one")
        self.results = [result for _, result in opened]
        folders = {result.folder: run for run, result in opened}
        labelled = by_label(self.results)
        self.labels = tuple(labelled)
        scenes = sorted({result.scene for result in self.results})
        self.seeds = sorted({result.seed for result in self.results})
        self.scenes: list[_Scene] = []
        self.shown: set[int] = set()
        for scene in scenes:
            own: dict[str, tuple[FinishedRun, RunResult]] = {}
            for label, row in labelled.items():
                of_scene = sorted((r for r in row if r.scene == scene), key=lambda r: r.seed)
                if of_scene:
                    own[label] = folders[of_scene[0].folder], of_scene[0]
                    self.shown.add(of_scene[0].seed)
            self.scenes.append(_Scene(scene, own))

    def head(self, label: str) -> str:
        """The label with the method as its paper writes it, where the bench knows it."""
        for result in self.results:
            if label == result.method or label.startswith(f"{result.method} ("):
                with suppress(BadInput):
                    return method_spec(result.method).title + label[len(result.method) :]
        return label

    @property
    def people(self) -> str:
        return ", ".join(scene.name for scene in self.scenes)

    @property
    def conditions(self) -> str:
        first = self.results[0]
        data = first.about.standin or first.identity.dataset
        return f"{first.identity.protocol}, {first.identity.profile} profile ({data})"

    @property
    def shown_seeds(self) -> str:
        shown = ", ".join(map(str, sorted(self.shown)))
        more = f" of seeds {', '.join(map(str, self.seeds))}" if len(self.seeds) > 1 else ""
        return f"Seed{'s' if len(self.shown) > 1 else ''} {shown}{more}."

    @property
    def note(self) -> str:
        return f"{self.shown_seeds} Numbers: PSNR of the view in `{self.results[0].headline}`, in dB."
