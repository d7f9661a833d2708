"""`ihbench figures teaser`: from occluded photographs to an avatar that is turned around and moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ihbench.clock.progress import Progress
from ihbench.document.picture_sheet import Panel, PictureSheet
from ihbench.errors import BadInput
from ihbench.record.finished_run import FinishedRun
from ihbench.reports.figures.side_by_side import MARGIN, Table, occluded_views
from ihbench.scene.contracts import TrainView
from ihbench.scene.spread import spread
from ihbench.scoring.contact_sheet import picture_window, with_occluder
from ihbench.show.rendering import film
from ihbench.show.shots import View
from ihbench.show.subject import Subject

SIZE = 256  # px
SIDES = (0, 1, 2, 3)  # of an orbit of four: front, left, back, right
MOVED = (("march", 0.25), ("lunge", 0.5))  # motion, and when in its course


def teaser(runs: Sequence[FinishedRun], views: int) -> PictureSheet:
    """A row for each run: `views` occluded training images, the avatar from four sides, and in two poses that nobody
    filmed.

    Raises `BadInput` for runs that may not stand in one table, and for motions that are not registered.
    """
    table = Table(runs)
    rows: list[tuple[str, list[Panel | None]]] = []
    several = len(table.labels) > 1
    for scene in table.scenes:
        occluded = occluded_views(scene.made_on)
        shown = [occluded[k] for k in spread(len(occluded), views)]
        inputs: list[Panel | None] = [Panel(_cut(view)) for view in shown]
        inputs += [None] * (views - len(inputs))
        for label, (run, _) in scene.runs.items():
            subject = Subject(run)
            pictures = [*_sides(subject), *_moved(subject)]
            head = f"{scene.name}: {label}" if several else scene.name
            rows.append((head, [*inputs, *(Panel(picture[picture_window(picture)]) for picture in pictures)]))
    columns = ("training input",) * views + ("front", "left", "back", "right", *(name for name, _ in MOVED))
    caption = (
        f"{table.people} under {table.conditions}: occluded training images (grey: behind the occluder), the avatar "
        f"from four sides, and in poses that nobody filmed. {table.shown_seeds}"
    )
    return PictureSheet(columns, rows, caption)


def _cut(view: TrainView) -> NDArray[np.uint8]:
    """The middle of a training image, where the person is."""
    rows, columns = picture_window(view.image)
    pad = int(MARGIN * (rows.stop - rows.start)) + 1
    height, width = view.mask.shape
    whole = slice(max(rows.start - 4 * pad, 0), min(rows.stop + pad, height))
    return with_occluder(view)[whole, max(columns.start - pad, 0) : min(columns.stop + pad, width)]


def _sides(subject: Subject) -> Iterator[NDArray[np.uint8]]:
    return film([subject], View(orbit=len(SIDES), size=(SIZE,))).frames(Progress.silent())


def _moved(subject: Subject) -> Iterator[NDArray[np.uint8]]:
    for name, share in MOVED:
        whole = film([subject], View(motion=name, camera="front", size=(SIZE,)))
        if not len(whole):
            raise BadInput(f"motion {name!r}: has no frames")
        (take,) = whole.takes
        one = take.shots[min(int(share * len(take.shots)), len(take.shots) - 1)]
        yield from replace(whole, takes=[replace(take, shots=[one])]).frames(Progress.silent())
