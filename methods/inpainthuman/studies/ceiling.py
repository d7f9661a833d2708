"""What a finished run would have reached with a better painter: stage 3 again, from paintings that know the truth.

An oracle test. It splits what a run lacks in hidden pixels into what its painter cost and what nothing that a painter
does can mend. For scenes whose truth behind the occluder is known: stand-ins, and captures under a made-up occlusion.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from ihbench.clock.checkpoints import state_file
from ihbench.clock.ledger import Ledger
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.methods.inpainthuman.avatar.avatar import GaussianAvatar
from ihbench.methods.inpainthuman.inpainting.painted_view import PaintedView
from ihbench.methods.inpainthuman.stages.stage1 import Stage1
from ihbench.methods.inpainthuman.stages.stage2 import STATE as PAINTED_STATE
from ihbench.methods.inpainthuman.stages.stage2 import Stage2
from ihbench.methods.inpainthuman.stages.stage3 import Stage3
from ihbench.metrics import Identity, mean_over_frames
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import read_result
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.views import OccludedScene, uncovered
from ihbench.scoring.scoring import Scorer

STATES = (Stage1.name, PAINTED_STATE)


@dataclass(frozen=True)
class CeilingRow:
    """An avatar, and how good the paintings were that it learned from."""

    name: str
    truth: float | None  # share of the way from the painted colours to the true ones; None for stage 1 alone
    painted_psnr: float  # dB, over painted person pixels; NaN for stage 1 alone
    scores: Mapping[Identity, float]  # identity -> mean over the scene's own test views


def ceiling(
    folder: Path, shares: Sequence[float], data: Path | None, body: Path | None, device: str, progress: Progress
) -> list[CeilingRow]:
    """Stage 1 alone, the run as it was, and for each share in (0, 1] stage 3 from paintings moved so far to the truth
    in colour, with the true silhouettes.

    The run folder is only read. Raises `BadInput` for a run that is not InpaintHuman's, not done, has painted
    nothing, or whose data are not to be had.
    """
    result = read_result(folder)
    if result.method != "inpainthuman" or result.status != "done":
        raise BadInput(f"{folder}: is a run of {result.method}, {result.status}; expected one of inpainthuman, done")
    missing = [state for state in STATES if not state_file(folder, state).is_file()]
    if missing:
        raise BadInput(f"{folder}: has no saved state {missing[0]}; only runs that paint have a ceiling of painting")
    run = FinishedRun(folder, data, body)
    scene, model = run.scene, run.body
    whole = uncovered(scene).train
    fitted = GaussianAvatar.load(folder / "avatar", model)
    seed = result.seed
    scorer = Scorer.build(scene)
    rows = []
    with TemporaryDirectory() as copy:
        ledger = lent(folder, Path(copy), STATES)

        def stage1() -> GaussianAvatar:
            avatar = GaussianAvatar(fitted.config, model, fitted.betas, seed).to(device)
            Stage1(avatar, scene.training, seed, ledger).run(Progress.silent())  # takes what is saved
            return avatar

        avatar = stage1()
        rows.append(CeilingRow("stage 1 alone", None, math.nan, _scores(avatar, scorer, scene)))
        painted = Stage2(avatar, scene.training, fitted.config.inpaint, seed, ledger).run(Progress.silent())
        taken = [view for view in painted if view.index < len(whole)]
        if not taken:
            raise BadInput(f"{folder}: painted no training view")
        own = {identity: mean.value for identity, mean in result.own.items()}
        rows.append(CeilingRow("as painted", 0.0, painted_psnr(taken, whole), own))
        turntable = painted[len(taken) :]  # their truth is not to be had
        for share in shares:
            better = [with_truth(view, whole[view.index], share) for view in taken]
            avatar = stage1()
            Stage3(avatar, scene.training, [*better, *turntable], seed, Ledger()).run(progress)
            name = "true images" if share == 1 else f"{share:.0%} of the way to the true images"
            rows.append(CeilingRow(name, share, painted_psnr(better, whole), _scores(avatar, scorer, scene)))
    return rows


def with_truth(painted: PaintedView, true: TrainView, share: float) -> PaintedView:
    """The painted view with its generated pixels moved towards the true image, and with the true silhouette."""
    view, made = painted.view, painted.generated
    mixed = view.image + share * (true.image.astype(np.float64) - view.image)
    image = np.where(made[..., None], np.rint(mixed), view.image).astype(np.uint8)
    return replace(painted, view=replace(view, image=image, mask=np.where(made, true.mask, view.mask)))


def painted_psnr(painted: Sequence[PaintedView], whole: Sequence[TrainView]) -> float:
    """PSNR in dB over the generated pixels that show the person in truth or in the painting, all views pooled."""
    squares, count = 0.0, 0
    for one in painted:
        true = whole[one.index]
        person = (true.mask == MaskState.PERSON) | (one.view.mask == MaskState.PERSON)
        where = one.generated & person
        difference = one.view.image[where].astype(np.float64) - true.image[where]
        squares += float((difference**2).sum())
        count += difference.size
    if not count:
        return math.nan
    return math.inf if squares == 0 else 10 * math.log10(255**2 * count / squares)


def lent(folder: Path, copy: Path, states: Sequence[str]) -> Ledger:
    """A ledger with copies of some of the run's states: what is done with it leaves the run as it is."""
    (copy / "checkpoints").mkdir()
    for state in states:
        shutil.copyfile(state_file(folder, state), state_file(copy, state))
    return Ledger(copy)


def _scores(avatar: GaussianAvatar, scorer: Scorer, scene: OccludedScene) -> dict[Identity, float]:
    background = scene.protocol.image.background
    own = [k for k, key in enumerate(scene.test_keys) if not key.group]
    rows = {"now": lambda loaded: avatar.render(loaded.view.camera, loaded.view.body_pose, background)[0]}
    views = [scored.scores["now"].scores for scored in scorer.scored(rows, own)]
    return {Identity.parse(i): mean_over_frames([view[i] for view in views]).value for i in views[0]}
