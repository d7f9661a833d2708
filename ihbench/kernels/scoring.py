"""Scoring a subject's test views as `ihbench score` does: reading, regions, metrics and writing, overlapped.

On the stand-in of `zju_occ` at the profile `paper`, which is made first if no run has made it yet (about a minute,
kept in the cache): 374 views of 512², read from 1024² JPEG and PNG files. LPIPS is left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ihbench.kernels.measuring import Row, peak_mib, row_of, timed
from ihbench.kernels.metrics import METRIC_SETS, headline_with

if TYPE_CHECKING:
    from ihbench.scoring.scoring import LoadedView, Scorer

PROTOCOL, PROFILE = "zju_occ", "paper"
VIEWS = 374


def score_rows(repeats: int, views: int = VIEWS, profile: str = PROFILE) -> list[Row]:
    """One row for each set of metrics: all views, predictions read from PNG files and written again as renders.

    The predictions are the truth a pixel off. `repeats` above 3 are 3.
    """
    from ihbench.clock.progress import Progress
    from ihbench.files.images import write_png
    from ihbench.metrics.eight_bit import rounded
    from ihbench.scene.data_source import locate
    from ihbench.scene.protocol import load_protocol
    from ihbench.scene.views import open_scene
    from ihbench.scoring.scoring import Scorer

    protocol = load_protocol(PROTOCOL, profile)
    source = locate(protocol, None, (protocol.subjects.standin[0],))
    capture, _ = source.open(source.scenes[0], None, Progress())
    scene = open_scene(capture, protocol)
    indices = range(min(views, len(scene.test_keys)))
    rows = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        scene.train.preload().wait()
        built = Scorer.build(scene)
        for index in indices:
            off = np.roll(scene.test[index].image, 1, axis=1)
            write_png(folder / "in" / f"{index}.png", rounded(off))
        for case, metrics in METRIC_SETS.items():
            samples, memory = [], None
            for k in range(min(repeats, 3)):
                fresh = open_scene(capture, protocol)  # holds no view of the last pass
                scorer = replace(built, scene=fresh, presets=(headline_with(metrics),))
                step = partial(timed, partial(_score_all, scorer, folder, indices))
                if k == 0:
                    memory = peak_mib(lambda step=step, samples=samples: samples.append(step()))
                if len(samples) == k:
                    samples.append(step())
            name = f"{len(indices)} views@{protocol.image.size}"
            rows.append(row_of("score", name, case, samples, memory, None))
    return rows


def _score_all(scorer: Scorer, folder: Path, indices: Sequence[int]) -> None:
    """Read, score and write the images of some test views, as `ihbench score` does."""
    from ihbench.files.images import read_image, write_png

    def predict(loaded: LoadedView) -> NDArray:
        return read_image(folder / "in" / f"{loaded.index}.png", scorer.scene.protocol.image.background)

    def write(loaded: LoadedView, images: dict[str, NDArray | None]) -> None:
        image = images["score"]
        assert image is not None
        write_png(folder / "out" / f"{loaded.index}.png", image)

    for _ in scorer.scored({"score": predict}, indices, after_each=write, threaded=True):
        pass
