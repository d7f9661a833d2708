"""The run loop: one protocol, scene, method, configuration and seed -> a run folder with scores.

Killed at any moment, the same call goes on at the last saved state and ends with the same numbers. Failure,
divergence and interruption are outcomes with a reason.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, fields
from dataclasses import field as dataclass_field
from functools import cached_property
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from ihbench import config_fields, registry
from ihbench.clock import machine
from ihbench.clock.events import Reused
from ihbench.clock.progress import Progress
from ihbench.config_fields import SEEDS, Values, flat, with_fields
from ihbench.errors import BadInput
from ihbench.metrics import Identity, mean_over_frames
from ihbench.record.finished_run import FinishedRun
from ihbench.record.provenance import command
from ihbench.record.results import RunResult
from ihbench.record.schema import CurvePoint, RunIdentity
from ihbench.record.source_digest import code_of, shipped_digest
from ihbench.record.store import RunFolder, is_finished
from ihbench.runner.recorded_run import RecordedRun, about_scene, identity_of, recorded
from ihbench.runner.score_stage import ScoreStage
from ihbench.runner.snapshots import Snapshots
from ihbench.scene.contracts import Avatar, Capture, TestView
from ihbench.scene.data_source import DataSource
from ihbench.scene.method_spec import method_spec
from ihbench.scene.plan import Omission, SceneMeasure, absent_regions, measure_scene
from ihbench.scene.protocol import Protocol
from ihbench.scene.views import OccludedScene, open_scene
from ihbench.scoring.curve_views import curve_views
from ihbench.scoring.scoring import Scorer

if TYPE_CHECKING:
    from ihbench.body import Body

CURVE_VIEWS = 6  # test views on which the quality-time curve is measured


@dataclass(frozen=True)
class RunRequest:
    """What is to be run on one scene."""

    protocol: Protocol
    method: str
    config: Any  # the method's frozen configuration dataclass
    seed: Annotated[int, SEEDS] = 0
    device: str = "cpu"
    runs: Path = Path("runs")
    body: Path | None = None  # SMPL model file, for real data
    force: bool = False  # do it again even if it is done
    keep: tuple[str, ...] = ()  # fields that the plan must not change; "all" for none
    share: bool = False  # take saved states from other runs where they would come out the same
    command: tuple[str, ...] = dataclass_field(default_factory=command)  # for the record only

    def __post_init__(self) -> None:
        config_fields.check(self, "", ("seed", "device", "runs", "force", "keep", "share"))


def configuration(method: str, profile: str, switches: Values) -> Any:
    """A method's configuration under a profile, with some fields replaced. Raises `BadInput` for unknown fields."""
    config = method_spec(method).profile(profile)
    known = [*flat(config), *(field.name for field in fields(config))]
    for name in switches:
        if name not in known:
            raise BadInput(f"method {method!r}: unknown switch {name!r}: {registry.nearest(name, known)}")
    return with_fields(config, switches)


def run_scene(request: RunRequest, source: DataSource, scene: str, progress: Progress) -> RunResult:
    """Run on one scene, or find the finished run."""
    clock = _Clock()
    capture, body = source.open(scene, request.body, progress)
    identity = run_identity(request, capture, body)
    about = about_scene(capture, request.protocol, request.device, request.command)
    before = {"open": clock.lap()}
    occluded = None
    if request.force or not is_finished(request.runs, identity):
        occluded = open_scene(capture, request.protocol)  # what does not fit is refused before a folder is made
        before["occlude"] = clock.lap()
    return recorded(
        request.runs,
        identity,
        about,
        request.force,
        lambda folder: _Run(
            request, occluded or open_scene(capture, request.protocol), body, folder, progress, before
        ),
    )


class _Clock:
    """Seconds since it was last asked, wall and CPU."""

    def __init__(self) -> None:
        self._last = time.perf_counter(), time.process_time()

    def lap(self) -> tuple[float, float]:
        last, self._last = self._last, (time.perf_counter(), time.process_time())
        return self._last[0] - last[0], self._last[1] - last[1]


def run_identity(request: RunRequest, capture: Capture, body: Body) -> RunIdentity:
    """Everything that affects the answer."""
    config = {**asdict(request.config), "keep": list(request.keep), **_outside(request)}
    code = code_of(request.protocol, request.method)
    return identity_of(request.protocol, capture, body, request.method, config, request.seed, code)


def load_avatar(run: FinishedRun, device: str = "cpu", folder: Path | None = None) -> Any:
    """The avatar of a run, or a snapshot of it in another folder. Raises `BadInput` where it has none."""
    if not (folder or run.folder / "avatar").is_dir():
        raise BadInput(f"{run.folder}: has no avatar (status {run.record.outcome.status}); finish the run first")
    identity = run.record.identity
    spec = method_spec(identity.method)
    return spec.create(spec.profile(identity.profile)).load(folder or run.folder / "avatar", run.body, device)


class RenderClock:
    """Milliseconds that an avatar takes to draw a view: from the call until the image is there, on the device too;
    without reading or writing files. Scoring goes on beside it on other threads, as it does in every run."""

    def __init__(self) -> None:
        self.milliseconds: list[float] = []

    @contextmanager
    def timing(self, device: str) -> Iterator[None]:
        machine.synchronize(device)
        start = time.perf_counter()
        yield
        machine.synchronize(device)
        self.milliseconds.append(1000 * (time.perf_counter() - start))

    @property
    def median_ms(self) -> float | None:
        """None where nothing was drawn."""
        return round(median(self.milliseconds), 3) if self.milliseconds else None


class _Run(RecordedRun):
    """One run of a method in progress: its parts, in the order in which they happen."""

    def __init__(
        self,
        request: RunRequest,
        scene: OccludedScene,
        body: Body,
        folder: RunFolder,
        progress: Progress,
        before: Mapping[str, tuple[float, float]],  # s, wall and CPU, that opening the scene took
    ):
        super().__init__(folder, progress, request.device, self._curve_point)
        self.snapshots = self.ledger.watcher = Snapshots(folder.path)
        for stage, clocks in before.items():
            self.ledger.book(stage, *clocks)
        self.request, self.occluded, self.capture, self.body = request, scene, scene.capture, body
        self.scorer: Scorer | None = None

    def work(self) -> None:
        with self.ledger.stage("import"):
            from ihbench.render.splat import warm_up  # brings torch, which `ihbench plan` must not load

        request, scene = self.request, self.occluded
        with scene.train.preload() as preloading:  # beside planning and compiling
            with self.ledger.stage("plan"):
                measure = measure_scene(scene)
                config, left_out, withheld = _planned(request, measure)
                hidden_share = scene.hiding.hidden_share()
            with self.ledger.stage("compile"):
                method = method_spec(request.method).create(config)
                machine.warm_up(request.device)
                warm_up(request.device)
            with self.ledger.stage("load"):
                preloading.wait()
        with self.ledger.stage("visibility"):
            self.scorer = Scorer.build(scene)
        self.describe(
            changed=_changed(request, withheld),
            left_out=tuple(left_out),
            measure=asdict(measure),
            hidden_share=hidden_share,
        )
        if request.share:
            with self.ledger.stage("share"):
                self._take_shared_states()
        self.folder.set_status("running", ledger=self.ledger)
        with self.ledger.stage("fit"):
            avatar = method.fit(
                scene.training, device=request.device, seed=request.seed, ledger=self.ledger, progress=self.progress
            )
        with self.ledger.stage("save"), self.folder.saving_avatar():
            avatar.save(self.folder.path / "avatar")
        self.snapshots.end()
        self.folder.set_status("running", ledger=self.ledger)
        with self.ledger.stage("score"):
            clock = RenderClock()
            stage = ScoreStage(self.scorer, self.folder, request.runs, self.progress, request.force)
            stage.run(request.method, lambda loaded: self._render(avatar, loaded.view, clock))
        self.describe(render_ms=clock.median_ms)
        self.folder.set_status("done", ledger=self.ledger)

    def _take_shared_states(self) -> None:
        """Copy saved states of finished runs that differ only in fields on which these states do not depend. Their
        seconds count as this run's own: the clock is saved with a state."""
        from ihbench.runner.shared_states import reusable_run, reuse_state

        for state, free in method_spec(self.request.method).shared_states.items():
            other = reusable_run(self.request.runs, self.folder, state, free, machine.identity())
            if other is not None:
                self.ledger.events += reuse_state(other, self.folder, state)  # that it went back, say
                self.ledger.event(Reused(state, other.record.digest))

    def _render(self, avatar: Avatar, view: TestView, clock: RenderClock | None = None) -> NDArray[np.float32]:
        background, frames = self.request.protocol.image.background, self.occluded.hiding.frames
        frame = view.frame if view.frame in frames else None  # whose pose it has: the capture has one a frame
        with nullcontext() if clock is None else clock.timing(self.request.device):
            return avatar.render(view.camera, view.body_pose, background, frame)[0]

    def _curve_point(self, step: int, seconds: float, avatar: Avatar) -> None:
        """Score a checkpoint on a few fixed test views. The fit clock stands still meanwhile."""
        assert self.scorer is not None
        chosen, keys = self._curve_views, self.scorer.scene.test_keys
        rows = {"now": lambda loaded: self._render(avatar, loaded.view)}
        views = [scored.scores["now"].scores for scored in self.scorer.scored(rows, chosen, slow=False)]
        scores = {Identity.parse(i): mean_over_frames([view[i] for view in views]).value for i in views[0]}
        on = tuple(keys[k].name for k in chosen)
        of = sum(not key.group for key in keys)
        self.folder.add_curve_point(CurvePoint(step, seconds, scores, len(chosen), of, on))

    @cached_property
    def _curve_views(self) -> list[int]:
        assert self.scorer is not None
        return curve_views(self.scorer, CURVE_VIEWS)


def _planned(request: RunRequest, measure: SceneMeasure) -> tuple[Any, list[Omission], list[str]]:
    """The configuration without what the scene does not need, what that was, and fields that `keep` held back. A
    switch that differs from the profile was set by somebody, and stays."""
    spec = method_spec(request.method)
    own, base = flat(request.config), flat(spec.profile(request.protocol.profile))
    proposed = [o for o in spec.omissions(request.config, measure) if own[o.field] == base[o.field]]
    withheld = [o.field for o in proposed if "all" in request.keep or o.field in request.keep]
    taken = [o for o in proposed if o.field not in withheld]
    config = with_fields(request.config, {o.field: o.value for o in taken})
    return config, taken + absent_regions(measure, request.protocol.metrics.regions), withheld


def _changed(request: RunRequest, withheld: list[str]) -> Values:
    """What sets the run apart from the profile: switches with their values, and as "keep" what the plan was not let
    to leave out (a `keep` that changed nothing is no difference)."""
    base = flat(method_spec(request.method).profile(request.protocol.profile))
    changed = {name: value for name, value in flat(request.config).items() if value != base[name]}
    return {**changed, "keep": withheld} if withheld else changed


def _outside(request: RunRequest) -> dict[str, str]:
    """A hash of files outside the package that the configuration names, such as weights: same path, other content is
    another run. See `MethodSpec.outside_files`."""
    paths = method_spec(request.method).outside(request.config)
    if not paths:
        return {}
    digest = hashlib.sha256()
    for named_path in map(Path, paths):
        for path in [named_path] if named_path.is_file() else sorted(p for p in named_path.rglob("*") if p.is_file()):
            inside = path.relative_to(named_path if named_path.is_dir() else named_path.parent)
            digest.update(inside.as_posix().encode(errors="surrogateescape") + b"\0" + shipped_digest(path))
    return {"outside": digest.hexdigest()[:8]}
