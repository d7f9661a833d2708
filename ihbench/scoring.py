"""Scoring predicted images of test views against their truth, region by region."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.errors import BadInput
from ihbench.metrics import evaluate
from ihbench.metrics.identity import Score
from ihbench.regions import SurfaceMap
from ihbench.scene import TestView
from ihbench.views import OccludedScene, TestViewKey
from ihbench.visibility import Visibility, texel_visibility

if TYPE_CHECKING:
    from ihbench.body import Body
    from ihbench.body.uv import Texels

VISIBILITY_TEXELS = 256  # side of the UV grid on which "seen in training" is decided
AHEAD = 2  # test views read in the background while one is scored


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
class Scorer:
    """Everything needed to score images of one scene; holds the truth, so methods never get it."""

    scene: OccludedScene
    surface: SurfaceMap
    texels: Texels
    visibility: Visibility

    @classmethod
    def build(cls, scene: OccludedScene, body: Body) -> Scorer:
        """Decide from the training views what was seen of the surface."""
        from ihbench.body.uv import texel_table

        texels = texel_table(body, VISIBILITY_TEXELS)
        visibility = texel_visibility(scene.train, body, texels)
        return cls(scene, SurfaceMap.build(body, texels, visibility), texels, visibility)

    def load(self, index: int) -> LoadedView:
        protocol, view = self.scene.protocol, self.scene.test[index]
        regions = self.surface.regions(view, protocol.regions, protocol.box_padding)
        return LoadedView(index, self.scene.test_keys[index], view, regions)

    def load_all(self, indices: Sequence[int]) -> Iterator[LoadedView]:
        """The chosen test views in order, read ahead on other threads (decoding and drawing release the lock)."""
        with ThreadPoolExecutor(AHEAD) as pool:
            waiting = [pool.submit(self.load, index) for index in indices[: AHEAD + 1]]
            for k in range(len(indices)):
                loaded = waiting.pop(0).result()
                if k + AHEAD + 1 < len(indices):
                    waiting.append(pool.submit(self.load, indices[k + AHEAD + 1]))
                yield loaded

    def score(self, loaded: LoadedView, image: NDArray[np.float32]) -> ViewScores:
        """Score one image. Raises `BadInput` when it has another size than the test view."""
        if image.shape != loaded.view.image.shape:
            raise BadInput(
                f"prediction of {loaded.key.name}: has shape {image.shape}, expected {loaded.view.image.shape}"
            )
        scores: dict[str, Score] = {}
        for preset in self.scene.protocol.presets:
            scores |= evaluate(image, loaded.view.image, loaded.regions, preset, self.scene.protocol.image.background)
        return ViewScores(loaded.key, scores)

    def score_rows(
        self,
        rows: dict[str, Callable[[TestView], NDArray[np.float32]]],
        indices: Sequence[int],
        after_each: Callable[[LoadedView, dict[str, NDArray[np.float32]]], None],
    ) -> dict[str, list[ViewScores]]:
        """Score several predictors over the same test views, each view read once."""
        results: dict[str, list[ViewScores]] = {name: [] for name in rows}
        for loaded in self.load_all(indices):
            images = {name: predict(loaded.view) for name, predict in rows.items()}
            for name, image in images.items():
                results[name].append(self.score(loaded, image))
            after_each(loaded, images)
        return results
