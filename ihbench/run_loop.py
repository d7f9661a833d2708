"""The run loop: one protocol, scene, method, configuration and seed -> a run folder with scores.

Killed at any moment, the same call goes on at the last saved state and ends with the same numbers. Failure,
divergence and interruption are outcomes with a reason.
"""

from __future__ import annotations

import gc
import hashlib
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ihbench import __version__, atomic, machine, registry
from ihbench.body import load_body
from ihbench.calibration import ROWS, Calibration
from ihbench.contact_sheet import SheetRow, contact_sheet, write_png
from ihbench.data_source import DataSource, locate, open_capture, own_body, own_data, standin_root
from ihbench.errors import BadInput, Diverged
from ihbench.ledger import Ledger
from ihbench.metrics import mean_over_frames
from ihbench.plan import Omission, SceneMeasure, absent_regions, measure_scene
from ihbench.progress import Progress
from ihbench.protocol import Protocol, load_protocol
from ihbench.results import RunResult, read_result, view_rows
from ihbench.scene import Avatar, Capture, Method, TestView, TrainingSet
from ihbench.scoring import LoadedView, Scorer
from ihbench.store import RunFolder, RunIdentity
from ihbench.views import OccludedScene, hidden_fraction, open_scene

if TYPE_CHECKING:
    from ihbench.body import Body

CURVE_VIEWS = 6  # test views on which the quality-time curve is measured
SHEET_VIEWS = 5  # test views on the contact sheet
SHEET_SIZE = 512  # px; smaller images are enlarged on it by a whole factor
TRACEBACK = "traceback.txt"  # of a run that failed, in its folder


@dataclass(frozen=True)
class RunRequest:
    """What is to be run on one scene."""

    protocol: Protocol
    method: str
    config: Any  # the method's frozen configuration dataclass
    seed: int = 0
    device: str = "cpu"
    runs: Path = Path("runs")
    body: Path | None = None  # SMPL model file, for real data
    force: bool = False  # do it again even if it is done
    keep: tuple[str, ...] = ()  # fields that the plan must not change; "all" for none


def run(
    protocol: str = "zju_occ",
    scene: str = "standin-1",
    *,
    method: str = "inpainthuman",
    profile: str = "quick",
    data: Path | str | None = None,
    runs: Path | str = "runs",
    body: Path | str | None = None,
    seed: int = 0,
    device: str = "cpu",
    force: bool = False,
    progress: Progress | None = None,
    **switches: Any,
) -> RunResult:
    """Run one method on one scene, as `ihbench run` does; `switches` are fields of the method's configuration.

    Raises `BadInput` for anything the caller got wrong. Divergence and failure are statuses of the result.
    """
    chosen = load_protocol(protocol, profile)
    config = configuration(method, profile, switches)
    request = RunRequest(
        chosen, method, config, seed, device, Path(runs), None if body is None else Path(body), force
    )
    source = locate(chosen, None if data is None else Path(data), (scene,))
    return run_scene(request, source, scene, progress or Progress())


def load_scene(
    protocol: str = "zju_occ",
    scene: str = "standin-1",
    *,
    profile: str = "quick",
    data: Path | str | None = None,
    body: Path | str | None = None,
    progress: Progress | None = None,
) -> tuple[OccludedScene, Body]:
    """Training and test views of one scene under a protocol, loaded lazily, and the body model of its poses."""
    chosen = load_protocol(protocol, profile)
    source = locate(chosen, None if data is None else Path(data), (scene,))
    capture, model = source.open(scene, None if body is None else Path(body), progress or Progress())
    return open_scene(capture, chosen), model


def configuration(method: str, profile: str, switches: dict[str, Any]) -> Any:
    """A method's configuration under a profile, with some fields replaced. Raises `BadInput` for unknown fields."""
    registry.entry_point("method", method)
    profiles = registry.load("config", method).PROFILES
    if profile not in profiles:
        raise BadInput(f"method {method!r}: unknown profile {profile!r}: {registry.nearest(profile, list(profiles))}")
    config = profiles[profile]
    known = [field.name for field in fields(config)]
    for name in switches:
        if name not in known:
            raise BadInput(f"method {method!r}: unknown switch {name!r}: {registry.nearest(name, known)}")
    return replace(config, **switches)


def run_scene(request: RunRequest, source: DataSource, scene: str, progress: Progress) -> RunResult:
    """Run on one scene, or find the finished run."""
    capture, body = source.open(scene, request.body, progress)
    identity = run_identity(request, capture, body)
    about = {
        "standin": capture.standin,
        "variant": capture.variant,
        "headline": request.protocol.headline,
        "device": request.device,
    }
    folder = RunFolder.create(request.runs, identity, about, request.force)
    with folder.lock():
        if not folder.finished:
            gc.collect()  # what an earlier run in this process left in cycles is not this run's memory
            machine.reset_peak_memory()
            try:
                _Run(request, capture, body, folder, progress).guarded()
            except BaseException:
                folder.settle(keep_new=False)
                raise
            folder.settle(keep_new=True)
    return read_result(folder.path)


def run_identity(request: RunRequest, capture: Capture, body: Body) -> RunIdentity:
    """Everything that affects the answer."""
    return RunIdentity(
        protocol=request.protocol.name,
        protocol_digest=request.protocol.digest,
        dataset=capture.dataset,
        scene=capture.name,
        data=f"{capture.standin or capture.variant} {_capture_digest(capture, request.protocol)}",
        method=request.method,
        config={**asdict(request.config), "keep": list(request.keep)},
        profile=request.protocol.profile,
        seed=request.seed,
        body=body.content_sha(),
        code=f"{__version__}+{_source_digest(registry.package_folder('method', request.method))}",
    )


def load_avatar(folder: Path, data: Path | None, body: Path | None) -> tuple[Any, Callable[[], Capture]]:
    """The avatar of a run, and a function that opens the run's capture for its poses."""
    record = RunFolder.open(folder).record
    about, identity = record["about"], record["identity"]
    if not (folder / "avatar").is_dir():
        raise BadInput(f"{folder}: has no avatar (status {record['status']}); finish the run first")
    if not about["standin"] and own_body(body) is None:
        raise BadInput(f"{folder}: was fitted on real data; name the SMPL model file with --body or IHBENCH_BODY")
    model = load_body(None if about["standin"] else own_body(body))
    method: Method = registry.load("method", identity["method"])(
        configuration(identity["method"], identity["profile"], {})
    )

    def capture() -> Capture:
        root = own_data(data)
        if root is None and not about["standin"]:
            raise BadInput(f"{folder}: was fitted on real data; name the folder of your copy with --data")
        root = root or standin_root(identity["dataset"])
        found = open_capture(identity["dataset"], root, identity["scene"], body)[0]
        if found.standin != about["standin"]:
            raise BadInput(
                f"{root}: holds {found.standin or 'real data'}, the run was fitted on "
                f"{about['standin'] or 'real data'}; name its data with --data"
            )
        return found

    return method.load(folder / "avatar", model), capture


class _Run:
    """One run in progress: its parts, in the order in which they happen."""

    def __init__(self, request: RunRequest, capture: Capture, body: Body, folder: RunFolder, progress: Progress):
        self.request, self.capture, self.body, self.folder, self.progress = request, capture, body, folder, progress
        before = folder.record["ledger"]
        self.ledger = Ledger(folder.path, device=request.device, state=before, on_checkpoint=self._curve_point)
        if before is not None:
            folder.restarted()
            (folder.path / TRACEBACK).unlink(missing_ok=True)
        self.scorer: Scorer | None = None

    def guarded(self) -> None:
        """Run, and record how it ended. Only bad input and interruption are passed on."""
        try:
            self._run()
        except Diverged as outcome:
            self.ledger.event("diverged", step=outcome.step, reason=outcome.reason)
            self._end("diverged", str(outcome))
        except BadInput as outcome:
            self._end("failed", str(outcome))
            raise
        except KeyboardInterrupt:
            self._end("interrupted", "interrupted by the user")
            raise
        except Exception as outcome:
            reason = f"{type(outcome).__name__}: {str(outcome).splitlines()[0] if str(outcome) else 'no message'}"
            atomic.write_text(self.folder.path / TRACEBACK, traceback.format_exc())
            self._end("failed", f"{reason} (see {TRACEBACK})")

    def _end(self, status: str, reason: str) -> None:
        self._describe()
        try:
            self.folder.set_status(status, reason, self.ledger)
        except BadInput as error:  # the disk that failed the run may fail its record too; the first reason counts
            self.progress.say(f"the run's record could not be written: {error}")

    def _describe(self, **more: Any) -> None:
        self.folder.record["about"] |= more | {
            "fit_seconds": self.ledger.fit_seconds,
            "total_seconds": self.ledger.seconds,
            "peak_mb": machine.peak_memory_mb(),
        }

    def _run(self) -> None:
        from ihbench.render.splat import warm_up  # brings torch, which `ihbench plan` must not load

        request, protocol = self.request, self.request.protocol
        with self.ledger.stage("occlude"):
            scene = open_scene(self.capture, protocol)
        with self.ledger.stage("load"):
            scene.train.preload()
        with self.ledger.stage("plan"):
            measure = measure_scene(self.capture, protocol, self.body)
            config, left_out = _planned(request, measure)
        with self.ledger.stage("visibility"):
            self.scorer = Scorer.build(scene, self.body)
        self._describe(
            changed=_changed(request),
            left_out=[asdict(o) for o in left_out],
            measure=asdict(measure),
            hidden_share=hidden_fraction(scene),
        )
        self.folder.set_status("running", ledger=self.ledger)
        with self.ledger.stage("compile"):
            method: Method = registry.load("method", request.method)(config)
            warm_up(request.device)
        training = TrainingSet(scene.train, self.body, protocol.image.background, self.capture.name)
        with self.ledger.stage("fit"):
            avatar = method.fit(
                training, device=request.device, seed=request.seed, ledger=self.ledger, progress=self.progress
            )
        avatar.save(self.folder.path / "avatar")
        self.folder.set_status("running", ledger=self.ledger)
        with self.ledger.stage("score"):
            self._score(scene, avatar)
        self._describe()
        self.folder.set_status("done", ledger=self.ledger)

    def _render(self, avatar: Avatar, view: TestView) -> NDArray[np.float32]:
        return avatar.render(view.camera, view.body_pose, self.request.protocol.image.background)[0]

    def _curve_point(self, step: int, seconds: float, avatar: Avatar) -> None:
        """Score a checkpoint on a few fixed test views. The fit clock stands still meanwhile."""
        assert self.scorer is not None
        chosen = _spread(len(self.scorer.scene.test_keys), CURVE_VIEWS)
        rows = self.scorer.score_rows({"now": lambda view: self._render(avatar, view)}, chosen, lambda *_: None)
        scores = {
            identity: mean_over_frames([view.scores[identity] for view in rows["now"]]).value
            for identity in rows["now"][0].scores
        }
        self.folder.add_curve_point({"step": step, "seconds": seconds, "views": len(chosen), "scores": scores})

    def _score(self, scene: OccludedScene, avatar: Avatar) -> None:
        assert self.scorer is not None
        name, cached = self.request.method, self._calibration_file()
        rows: dict[str, Callable[[TestView], NDArray[np.float32]]] = {name: lambda view: self._render(avatar, view)}
        lines = atomic.read_json_lines(cached) if cached.is_file() and not self.request.force else None
        if lines is None:
            calibration = Calibration.build(
                scene.train, self.body, self.scorer.texels, scene.protocol.image.background
            )
            rows |= {row: (lambda view, row=row: calibration.predict(row, view)) for row in ROWS}
        on_sheet, sheet = _spread(len(scene.test_keys), SHEET_VIEWS), []
        with self.progress.task("scoring", len(scene.test_keys)) as task:

            def after_each(loaded: LoadedView, images: dict[str, NDArray[np.float32]]) -> None:
                image = images[name]
                path = self.folder.renders / loaded.key.camera_id / f"{loaded.key.frame:06d}.png"
                write_png(path, np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8))
                if loaded.index in on_sheet:
                    sheet.append(_sheet_row(scene, loaded, image))
                task.advance()

            results = self.scorer.score_rows(rows, range(len(scene.test_keys)), after_each)
        if lines is None:
            lines = [line for row in ROWS for line in view_rows(row, results[row])]
            atomic.write_json_lines(cached, lines)
        atomic.write_json_lines(self.folder.path / "calibration.jsonl", lines)
        self.folder.write_scores(view_rows(name, results[name]))
        title = f"{self.folder.identity['protocol']}  {self.capture.name}  {name}  {self.request.protocol.profile}"
        zoom = max(1, SHEET_SIZE // self.request.protocol.image.size)
        if self.capture.standin:
            title += f"  ({self.capture.standin})"
        write_png(self.folder.path / "contact_sheet.png", contact_sheet(sheet, title, zoom))

    def _calibration_file(self) -> Path:
        """Calibration rows depend on data and protocol only: they are computed once for all methods and seeds."""
        identity = self.folder.identity
        parts = (__version__, *(identity[k] for k in ("protocol_digest", "scene", "data", "body")))
        digest = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
        return self.request.runs / "calibration" / f"{digest}.jsonl"


def _planned(request: RunRequest, measure: SceneMeasure) -> tuple[Any, list[Omission]]:
    """The configuration without what the scene does not need, and what that was."""
    left_out = absent_regions(measure, request.protocol.regions)
    if "all" in request.keep:
        return request.config, left_out
    proposed = [o for o in registry.load("config", request.method).leave_out(request.config, measure)]
    proposed = [o for o in proposed if o.field not in request.keep]
    return replace(request.config, **{o.field: o.value for o in proposed}), proposed + left_out


def _changed(request: RunRequest) -> list[str]:
    """Switches that differ from the profile, and the protocol's occlusion if it was replaced, for table rows."""
    base = registry.load("config", request.method).PROFILES[request.protocol.profile]
    changed = [
        f"{field.name}={getattr(request.config, field.name)}"
        for field in fields(base)
        if getattr(request.config, field.name) != getattr(base, field.name)
    ]
    return [*changed, f"keep={','.join(request.keep)}"] if request.keep else changed


def _spread(n: int, k: int) -> list[int]:
    """k of n indices, evenly spread from the first to the last."""
    return sorted({int(i) for i in np.linspace(0, n - 1, min(k, n)).round()})


def _sheet_row(scene: OccludedScene, loaded: LoadedView, image: NDArray[np.float32]) -> SheetRow:
    protocol, capture = scene.protocol, scene.capture
    frames = protocol.training_frames(capture.name, capture.n_frames)
    nearest = min(range(len(frames)), key=lambda k: abs(frames[k] - loaded.key.frame))
    return SheetRow(loaded.key.name, scene.train[nearest].image, loaded.view.image, image)


def _capture_digest(capture: Capture, protocol: Protocol) -> str:
    """Hash of the cameras, body poses, images and masks that the protocol uses of a capture."""
    digest = hashlib.sha256()
    n_frames = capture.n_frames
    trained = [(protocol.train_camera, frame) for frame in protocol.training_frames(capture.name, n_frames)]
    tested = [
        (camera, frame)
        for camera in protocol.testing_cameras(len(capture.camera_ids))
        for frame in protocol.testing_frames(capture.name, n_frames)
    ]
    views = [(camera, frame) for camera, frame in trained + tested if frame < n_frames]
    for index in dict.fromkeys(camera for camera, _ in views):
        camera = capture.camera(index)
        distortion = np.zeros(5) if camera.distortion is None else camera.distortion
        for value in (camera.K, camera.R, camera.t, distortion, np.array([camera.width, camera.height])):
            digest.update(np.ascontiguousarray(value, np.float64).tobytes())
    for frame in sorted({frame for _, frame in views}):
        pose = capture.body_pose(frame)
        for value in (pose.pose, pose.betas, pose.transl):
            digest.update(np.ascontiguousarray(value).tobytes())
    for camera, frame in views:
        digest.update(capture.content_digest(camera, frame, protocol.silhouette))
    return digest.hexdigest()[:10]


def _source_digest(package: Path) -> str:
    """Hash of a method's own source files: edited code is another run."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]
