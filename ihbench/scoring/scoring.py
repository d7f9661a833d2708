"""Scoring predicted images of test views against their truth, region by region."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.machine import usable_cores
from ihbench.clock.threads import single_threaded_libraries
from ihbench.errors import BadInput
from ihbench.metrics.eight_bit import rounded
from ihbench.metrics.evaluate import Preset, evaluate, find_preset
from ihbench.metrics.identity import Score
from ihbench.metrics.images import as_image, check_range
from ihbench.scene.contracts import TestView
from ihbench.scene.occlusion import withheld
from ihbench.scene.regions import SurfaceMap
from ihbench.scene.sightings import FINE
from ihbench.scene.views import OccludedScene, TestViewKey

AHEAD = 3  # test views read in the background while one is predicted
MOST_WORKERS = 8  # threads; each holds a view
# A renderer without a last clamp leaves [0, 1] in places; presets clip that or take it as it is. Beyond this a whole
# run's pictures are of another range, and clipping them would make a score of nothing.
RENDER_BELOW, RENDER_ABOVE = 0.5, 1.0


@dataclass(frozen=True)
class ViewScores:
    """Identity string -> score of one test view."""

    key: TestViewKey
    scores: dict[str, Score]


@dataclass(frozen=True)
class LoadedView:
    """A test view with its region masks."""

    index: int
    key: TestViewKey
    view: TestView
    regions: dict[str, NDArray[np.bool_] | str]


@dataclass(frozen=True)
class ScoredView:
    """A test view with what was predicted for it and the scores of every row."""

    loaded: LoadedView
    images: dict[str, NDArray | None]  # row -> [H, W, 3] float in [0, 1] or uint8; None where there is none
    scores: dict[str, ViewScores]  # row -> scores


Predictor = Callable[[LoadedView], NDArray | None]  # -> [H, W, 3], or None where there is no prediction


@dataclass(frozen=True)
class Scorer:
    """Everything needed to score images of one scene; holds the truth, so methods never get it."""

    scene: OccludedScene
    surface: SurfaceMap
    presets: tuple[Preset, ...]

    @classmethod
    def build(cls, scene: OccludedScene, presets: Sequence[str] | None = None) -> Scorer:
        """Decide from the training views what was seen of the surface. The presets are the protocol's own by default.

        Raises `BadInput` for an unknown preset.
        """
        named = tuple(find_preset(name) for name in presets or scene.protocol.metrics.presets)
        seen = scene.training.sightings[FINE]
        return cls(scene, SurfaceMap.build(scene.capture.model, seen.texels, seen.visibility), named)

    @cached_property
    def withheld(self) -> dict[str, str]:
        """Regions without numbers in this scene, each with the reason."""
        return withheld(self.region_names) if self.scene.hiding.in_scene else {}

    @cached_property
    def region_names(self) -> tuple[str, ...]:
        """The protocol's regions, and those that the presets take or need beside them."""
        names = list(self.scene.protocol.metrics.regions)
        for preset in self.presets:
            names += [*preset.regions(names), *preset.needs]
        return tuple(dict.fromkeys(names))

    def load(self, index: int) -> LoadedView:
        view = self.scene.test[index]
        regions = self.surface.regions(view, self.region_names, self.scene.protocol.metrics.box_padding)
        return LoadedView(index, self.scene.test_keys[index], view, regions)

    def score(
        self,
        loaded: LoadedView,
        image: NDArray | None,  # [H, W, 3] uint8 or float with peak 1
        slow: bool = True,
    ) -> ViewScores:
        """Score one image; pixels whose truth nobody knows count as right, also where windows reach them. Raises
        `BadInput` when it has another size, layout or range than the test view."""
        protocol = self.scene.protocol
        background = protocol.image.background
        scores: dict[str, Score] = {}
        if image is not None:
            image = as_prediction(image, loaded)
            if loaded.view.hidden is not None:
                # whoever drew the person there and whoever left them out are told the same
                truth = loaded.view.image
                paint = rounded(truth) if image.dtype == np.uint8 else truth.astype(image.dtype)
                image = np.where(loaded.view.hidden[..., None], paint, image)
        for preset in self.presets:
            if image is None:
                scores |= preset.absent(protocol.metrics.regions, background, "no prediction of this view")
            else:
                over = protocol.metrics.regions
                scores |= evaluate(  # hdr: `as_prediction` has looked at the range
                    image, loaded.view.image, loaded.regions, preset, background, slow, over, self.withheld, hdr=True
                )
        return ViewScores(loaded.key, scores)

    def scored(
        self,
        rows: Mapping[str, Predictor],
        indices: Sequence[int],
        *,
        after_each: Callable[[LoadedView, dict[str, NDArray | None]], None] | None = None,
        threaded: bool = False,
        slow: bool = True,
    ) -> Iterator[ScoredView]:
        """Score several predictors over the same test views, in order, each view read once.

        Reading, scoring and `after_each` (writing files, say) run on other threads beside the prediction, which runs
        on this one, or also on those when the predictors allow it (`threaded`). A few views are held at a time. An
        exception from any of them ends it.
        """
        workers = min(max(usable_cores(), 2), MOST_WORKERS)

        def finish(loaded: LoadedView, images: dict[str, NDArray | None] | None) -> ScoredView:
            if images is None:
                images = {name: predict(loaded) for name, predict in rows.items()}
            images = {name: None if image is None else as_prediction(image, loaded) for name, image in images.items()}
            scores = {name: self.score(loaded, image, slow) for name, image in images.items()}
            if after_each is not None:
                after_each(loaded, images)
            return ScoredView(loaded, images, scores)

        with single_threaded_libraries(), ThreadPoolExecutor(workers) as pool:
            try:
                waiting: deque[Future] = deque()
                if threaded:
                    for index in indices:
                        waiting.append(pool.submit(lambda index=index: finish(self.load(index), None)))
                        if len(waiting) > workers + AHEAD:
                            yield waiting.popleft().result()
                else:
                    coming = deque(pool.submit(self.load, index) for index in indices[:AHEAD])
                    for k in range(len(indices)):
                        loaded = coming.popleft().result()
                        if k + AHEAD < len(indices):
                            coming.append(pool.submit(self.load, indices[k + AHEAD]))
                        images = {name: predict(loaded) for name, predict in rows.items()}
                        waiting.append(pool.submit(finish, loaded, images))
                        if len(waiting) > workers:
                            yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
            finally:
                pool.shutdown(wait=True, cancel_futures=True)


def as_prediction(image: Any, loaded: LoadedView) -> NDArray:
    """What a predictor gave for a test view, as an array [H, W, 3], uint8 or float with peak 1. Raises `BadInput`."""
    expected = loaded.view.image.shape
    try:
        array = as_image(image, "image", hdr=True)
        check_range(array, "image", below=RENDER_BELOW, above=RENDER_ABOVE, otherwise="")
    except ValueError as error:
        raise BadInput(f"prediction of {loaded.key.name}: {error}") from error
    if array.shape != expected:
        raise BadInput(f"prediction of {loaded.key.name}: has shape {array.shape}, expected {expected}")
    return array
