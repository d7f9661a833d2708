"""The pictures of a site: of some test views what training showed, the truth, every run's prediction, and the
regions, as small files whose pixels are those that were scored."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files.pictures import encoded, read_rgb
from ihbench.metrics.eight_bit import displayed
from ihbench.metrics.images import bounds
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import RunResult, by_group, grouped
from ihbench.record.schema import score_lines
from ihbench.record.shareable import without_places
from ihbench.scene.mask_state import MaskState
from ihbench.scene.spread import spread
from ihbench.scoring.scoring import LoadedView, Scorer

# colours of Okabe and Ito, which the colour-blind tell apart; the page's legend has the same
REGIONS = {"visible": (0, 158, 115), "hidden": (213, 94, 0), "never_seen": (204, 121, 167), "box": (0, 114, 178)}
UNKNOWN = (112, 112, 112)
LARGEST_SIDE = 1024  # px; larger pictures are left out of a page


@dataclass
class Files:
    """Files of a site by name; equal contents are kept once."""

    content: dict[str, bytes] = field(default_factory=dict)

    def add(self, data: bytes, suffix: str) -> str:
        """Its name."""
        name = hashlib.sha256(data).hexdigest()[:16] + suffix
        self.content[name] = data
        return name

    def add_picture(self, picture: NDArray[np.uint8]) -> str:
        """[H, W, 3], without any loss."""
        return self.add(encoded(picture, "WEBP", lossless=True, method=3), ".webp")

    def add_mask(self, mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> str:
        """[H, W]: the colour inside, nothing outside."""
        from PIL import Image

        image = Image.fromarray(mask.astype(np.uint8), "P")
        image.putpalette([0, 0, 0, *colour])
        buffer = io.BytesIO()
        image.save(buffer, "PNG", transparency=0, bits=1, optimize=True)
        return self.add(buffer.getvalue(), ".png")


@dataclass(frozen=True)
class SceneFrames:
    """The pictures of one scene under one protocol."""

    group: int
    scene: str
    runs: tuple[int, ...]
    views: tuple[dict[str, Any], ...]  # camera, frame, size, truth, input, masks, predictions by run
    reason: str  # why there is no truth beside the predictions; "" where there is

    @property
    def as_json(self) -> dict[str, Any]:
        return {
            "group": self.group, "scene": self.scene, "runs": list(self.runs), "views": list(self.views),
            "reason": without_places(self.reason),
        }  # fmt: skip


@dataclass(frozen=True)
class OpenScenes:
    """Opens the scenes that runs were made on, each once: reading what training showed takes a while."""

    data: Path | None
    body: Path | None
    kept: dict[Any, tuple[FinishedRun, Scorer] | str] = field(default_factory=dict)

    def of(self, run: RunResult) -> tuple[FinishedRun, Scorer] | str:
        """The run opened again with what scores it, or why that cannot be."""
        key = (*run.group, run.scene, run.identity.data)
        if key not in self.kept:
            try:
                opened = FinishedRun(run.folder, self.data, self.body)
                self.kept[key] = opened, Scorer.build(opened.scene)
            except BadInput as error:
                self.kept[key] = str(error)
        return self.kept[key]


def scene_frames(
    results: Sequence[RunResult], files: Files, scenes: OpenScenes, most: int, progress: Progress
) -> list[SceneFrames]:
    """Pictures of up to about `most` test views of every scene: spread over all of them, and of every run the worst
    of its headline region and of what was hidden."""
    found = []
    numbers = {id(run): k for k, run in enumerate(results)}
    for g, runs in enumerate(by_group(results).values()):
        done = [run for run in runs if run.status == "done"]
        for scene, row in sorted(grouped((run.scene, run) for run in done).items()):
            progress.say(f"pictures of {scene} under {row[0].identity.protocol}")
            found.append(_scene(g, scene, {numbers[id(run)]: run for run in row}, files, scenes, most))
    return found


def _scene(
    group: int, name: str, runs: Mapping[int, RunResult], files: Files, scenes: OpenScenes, most: int
) -> SceneFrames:
    opened = scenes.of(next(iter(runs.values())))
    if isinstance(opened, str):
        keys = _rendered(runs.values())
        views = [_predictions(camera, frame, runs, files) for camera, frame in _some(keys, most)]
        return SceneFrames(group, name, tuple(runs), tuple(v for v in views if v["predictions"]), opened)
    finished, scorer = opened
    keys = finished.scene.test_keys
    at = {(key.camera_id, key.frame): k for k, key in enumerate(keys)}
    chosen = {*spread(len(keys), most)} | {at[key] for run in runs.values() for key in _worst(run) if key in at}
    views = []
    for k in sorted(chosen):
        truth = _truth(scorer.load(k), scorer, files)
        made = _predictions(keys[k].camera_id, keys[k].frame, runs, files)
        views.append(made | truth | {"window": _united(made["window"], truth["window"], truth["size"])})
    return SceneFrames(group, name, tuple(runs), tuple(views), "")


def _some(keys: Sequence[tuple[str, int]], most: int) -> list[tuple[str, int]]:
    return [keys[k] for k in spread(len(keys), most)] if keys else []


def _rendered(runs: Any) -> list[tuple[str, int]]:
    """Camera and frame of every picture that the runs have left."""
    files = [file for run in runs for file in sorted((run.folder / "renders").glob("*/*.png"))]
    return list(dict.fromkeys((file.parent.name, int(file.stem)) for file in files if file.stem.isdecimal()))


def _worst(run: RunResult) -> list[tuple[str, int]]:
    """Camera and frame of the test view that is worst, in the first metric, of the headline region and of what was
    hidden."""
    try:
        lines = [line for line in score_lines(run.folder / "scores.jsonl") if line.row == run.method]
    except (BadInput, OSError):
        return []
    worst = []
    for region in (run.headline, "hidden"):
        for i in [i for i in run.own if i.region == region][:1]:
            finite = [line for line in lines if i in line.scores and math.isfinite(line.scores[i])]
            sign = 1 if i.display.higher_is_better else -1
            for line in sorted(finite, key=lambda line: sign * line.scores[i])[:1]:
                worst.append((str(line.camera), line.frame))
    return worst


def _predictions(camera: str, frame: int, runs: Mapping[int, RunResult], files: Files) -> dict[str, Any]:
    made, window, size = {}, None, [0, 0]
    for k, run in runs.items():
        if (picture := _render(run.folder, camera, frame)) is not None:
            made[str(k)] = files.add_picture(picture)
            size = [picture.shape[1], picture.shape[0]]
            window = _united(window, _person(picture), size)
    return {"camera": camera, "frame": frame, "size": size, "predictions": made, "masks": {}, "window": window}


def _person(picture: NDArray[np.uint8]) -> list[int] | None:
    """[left, top, right, bottom] px of what differs from the corner's colour; None where nothing does."""
    area = bounds((np.abs(picture.astype(int) - picture[0, 0].astype(int)) > 8).any(-1))
    return None if area is None else [area[1].start, area[0].start, area[1].stop, area[0].stop]


def _grown(window: list[int] | None, width: int, height: int) -> list[int] | None:
    """With a margin around it."""
    if window is None:
        return None
    margin = max(4, (window[3] - window[1]) // 12)
    left, top, right, bottom = window
    return [max(0, left - margin), max(0, top - margin), min(width, right + margin), min(height, bottom + margin)]


def _united(a: list[int] | None, b: list[int] | None, size: Sequence[int]) -> list[int] | None:
    """The window that holds both, inside a picture of this width and height."""
    if a is None or b is None:
        return a or b
    left, top = (max(0, min(a[k], b[k])) for k in (0, 1))
    right, bottom = (min(size[k - 2], max(a[k], b[k])) for k in (2, 3))
    return [left, top, right, bottom]


def _render(folder: Path, camera: str, frame: int) -> NDArray[np.uint8] | None:
    """[H, W, 3], or None where there is no such picture, none of a page's size, or none that can be read."""
    path = folder / "renders" / camera / f"{frame:06d}.png"
    if path.is_symlink() or not path.is_file():
        return None
    try:
        picture = read_rgb(path)
    except BadInput:
        return None
    return picture if max(picture.shape) <= LARGEST_SIDE else None


def _truth(loaded: LoadedView, scorer: Scorer, files: Files) -> dict[str, Any]:
    scene, view = scorer.scene, loaded.view
    frames = scene.protocol.training_frames(scene.capture.name, scene.capture.n_frames)
    nearest = min(range(len(frames)), key=lambda k: abs(frames[k] - view.frame))
    masks = {
        name: files.add_mask(region, REGIONS[name])
        for name, region in loaded.regions.items()
        if name in REGIONS and not isinstance(region, str) and region.any()
    }
    if view.hidden is not None and view.hidden.any():
        masks["unknown"] = files.add_mask(view.hidden, UNKNOWN)
    training = scene.train[nearest]
    if (occluded := training.mask == MaskState.UNKNOWN).any():
        masks["occluded"] = files.add_mask(occluded, UNKNOWN)
    return {
        "size": [view.camera.width, view.camera.height],
        "truth": files.add_picture(displayed(view.image)),
        "input": files.add_picture(training.image),
        "input_frame": frames[nearest],
        "window": _grown(_person(displayed(view.image)), view.camera.width, view.camera.height),
        "masks": masks,
        "K": view.camera.K.tolist(),
        "R": view.camera.R.tolist(),
        "t": view.camera.t.tolist(),
        "pose": np.round(view.body_pose.pose.ravel(), 7).tolist(),
        "transl": view.body_pose.transl.tolist(),
    }
