"""`ihbench figures inpaint`: training views before and after painting, beside what was behind the occluder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ihbench.clock.checkpoints import state_file
from ihbench.document.picture_sheet import Panel, PictureSheet
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.stages.stage2 import STATE, saved_paintings
from ihbench.methods.inpainthuman.studies.ceiling import lent, painted_psnr
from ihbench.methods.inpainthuman.studies.grid import HIDDEN
from ihbench.metrics.images import bounds, grown
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result
from ihbench.scene.contracts import MaskState
from ihbench.scene.views import uncovered
from ihbench.scoring.contact_sheet import with_occluder

MARGIN = 4  # px around the person


def inpaint(runs: Sequence[FinishedRun], views: int) -> PictureSheet:
    """A row for each training view, the `views` of every run of which most was painted: what was filmed, what was
    asked of the painter (magenta), what stage 3 learned from, and the truth with the PSNR of what was painted.

    Raises `BadInput` for runs that are not InpaintHuman's, are not done, or have painted nothing.
    """
    rows: list[tuple[str, list[Panel | None]]] = []
    results = [read_result(run.folder) for run in runs]
    for run, result in zip(runs, results, strict=True):
        painted = _painted(run)
        filmed = run.scene.train
        truth = None if run.scene.hiding.in_scene else uncovered(run.scene).train
        taken = [view for view in painted if view.index < len(filmed) and view.generated.any()]
        if not taken:
            raise BadInput(f"{run.folder}: painted no training view")
        for one in sorted(taken, key=lambda view: -int(view.generated.sum()))[:views]:
            original = filmed[one.index]
            person = (one.view.mask == MaskState.PERSON) | (original.mask != MaskState.BACKGROUND)
            area = bounds(person) or (slice(None), slice(None))
            window = grown(area, MARGIN, person.shape)
            shown = with_occluder(original)
            asked = np.where(one.generated[..., None], HIDDEN, shown)
            done = np.where(one.generated[..., None], one.view.image, shown)
            panels: list[Panel | None] = [Panel(image[window]) for image in (shown, asked, done)]
            if truth is None:
                panels.append(None)
            else:
                quality = painted_psnr([one], truth)
                note = f"painted: {quality:.1f} dB" if np.isfinite(quality) else ""
                panels.append(Panel(truth[one.index].image[window], note))
            rows.append((f"{result.scene}, frame {original.frame}", panels))
    first = results[0]
    caption = (
        f"Training views of {', '.join(dict.fromkeys(r.scene for r in results))} under {first.identity.protocol}, "
        f"{first.identity.profile} profile, seeds {', '.join(map(str, sorted({r.seed for r in results})))}, of each "
        "those of which most was painted: filmed (grey: behind the occluder), asked of the painter (magenta: surface "
        "that no training view shows), painted, true. Numbers: PSNR of painted person pixels, in dB."
    )
    return PictureSheet(("training input", "asked", "painted", "ground truth"), rows, caption)


def _painted(run: FinishedRun) -> list[PaintedView]:
    result = read_result(run.folder)
    if result.method != "inpainthuman" or result.status != "done":
        raise BadInput(f"{run.folder}: is a run of {result.method}, {result.status}; the figure is of inpainthuman's")
    if not state_file(run.folder, STATE).is_file():
        raise BadInput(f"{run.folder}: has no saved state {STATE}; only runs that paint have one")
    with TemporaryDirectory() as copy:
        painted = saved_paintings(lent(run.folder, Path(copy), (STATE,)))
    if painted is None:
        raise BadInput(f"{run.folder}: its saved state {STATE} is damaged; run the same command with --force")
    return painted
