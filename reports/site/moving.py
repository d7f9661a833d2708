"""The avatar tab's content: every run's avatar baked for the page, what that costs, pictures from around, motions."""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench import registry
from ihbench.body.canonical import canonical_pose
from ihbench.body.pose import BodyPose
from ihbench.body.skeleton import PARENTS
from ihbench.camera import Camera
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files.pictures import encoded, one_line
from ihbench.metrics.eight_bit import displayed
from ihbench.record.finished_run import FinishedRun
from ihbench.record.results import RunResult
from ihbench.record.shareable import without_places
from ihbench.reports.site.avatars import PAINTED, BakedAvatar, price
from ihbench.reports.site.baking import Baked, bake
from ihbench.reports.site.corrections import Corrections, samples_of
from ihbench.reports.site.frames import Files, OpenScenes, SceneFrames
from ihbench.reports.site.tables import number
from ihbench.scene.contracts import TestView
from ihbench.scene.regions import HIDDEN, NEVER_SEEN, VISIBLE
from ihbench.scene.sightings import FINE
from ihbench.scene.spread import spread
from ihbench.scoring.scoring import Scorer
from ihbench.show.detail import drawn
from ihbench.show.framing import Framing, orbit
from ihbench.show.motion import Motion, Stand, find_motion, placed, stand_of
from ihbench.show.subject import CAPTURE, Subject

A_POSE = "a_pose"
SHOWN = ("march", "lunge", "bow", "turn", "wave", "kick")  # of the registered motions, as far as there are
FPS = 15.0
MOST_FRAMES = 90  # of a capture's own motion
UNITS = 1e4  # steps of a radian in which angles travel
PRICED_VIEWS = 4
PRICED_MOTIONS = ("bow", "march")
AROUND, SIDE = 12, 256  # pictures of a turntable, and their px
FEW, PATIENCE = 4, 20.0  # of a method whose first two pictures take longer than that, s
GROUND = (1.0, 1.0, 1.0)
QUALITY = 88  # of these pictures: they are to be looked at, nothing is measured on them
PROCEDURAL = "procedural"
BAKING_POSES = 6


def avatars(
    results: Sequence[RunResult],
    frames: Sequence[SceneFrames],
    files: Files,
    scenes: OpenScenes,
    progress: Progress,
    share: bool = False,
) -> tuple[dict[str, Any], dict[str, bytes]]:
    """`avatars`, `motions` and what belongs to them as JSON, and the files that a page carries inside.

    `share`: of avatars on another body than the bench's own, whose template and weights are under its licence, only
    pictures.
    """
    made: dict[int, dict[str, Any]] = {}
    carried = Files()
    motions: dict[str, dict[str, Any]] = {}
    for k, run in enumerate(results):
        if run.status != "done" or not (run.folder / "avatar").is_dir():
            continue
        progress.say(f"avatar of {run.method} on {run.scene}, seed {run.seed}")
        shown = next((f for f in frames if k in f.runs), None)
        try:
            made[k] = _avatar(run, shown, files, carried, scenes, motions, share)
        except Exception as error:  # of somebody's method, too: one avatar must not take the page along
            reason = str(error) if isinstance(error, BadInput) else f"{type(error).__name__}: {one_line(error)}"
            reason = without_places(reason, run.folder)
            made[k] = {"reason": reason, "turntable": [], "price": {}, "labels": {}, "capture": ""}
    return {
        "avatars": {str(k): about for k, about in made.items()},
        "motions": motions,
        "parents": list(PARENTS),
        "a_pose": canonical_pose(A_POSE).ravel().tolist(),
    }, carried.content


def _avatar(
    run: RunResult,
    shown: SceneFrames | None,
    files: Files,
    carried: Files,
    scenes: OpenScenes,
    motions: dict[str, dict[str, Any]],
    share: bool,
) -> dict[str, Any]:
    finished = FinishedRun(run.folder, scenes.data, scenes.body)
    subject, opened = Subject(finished), scenes.of(run)
    scorer = None if isinstance(opened, str) else opened[1]
    about: dict[str, Any] = {"turntable": _turntable(subject, files), "price": {}, "labels": {}, "capture": ""}
    if share and subject.body.name != PROCEDURAL:
        return about | {"reason": f"its body, {subject.body.name}, may not be passed on with its weights (--share)"}
    rest = BodyPose(canonical_pose(A_POSE), subject.betas, np.zeros(3))
    views = [] if scorer is None else [scorer.scene.train[i] for i in spread(len(scorer.scene.train), BAKING_POSES)]
    seen = None if scorer is None else scorer.scene.training.sightings[FINE].visibility
    made = bake(subject, [view.body_pose for view in views] or [rest], seen)
    if isinstance(made, str):
        return about | {"reason": made}
    own, skin = made.avatar.packed()
    name = f"{shown.group if shown else 0} {run.scene}"
    clips = {motion: find_motion(motion, FPS, subject.body, subject.betas) for motion in _chosen()}
    if "shared" not in motions:
        motions["shared"] = {motion: _packed(clip) for motion, clip in clips.items()}
    if scorer is not None:
        captured = _captured(subject)
        motions.setdefault(name, {CAPTURE: _packed(captured)})
        clips[CAPTURE] = captured
    corrections = _corrections(made, subject, clips, rest, _tests(scorer, shown))
    return about | made.avatar.about | {
        "reason": "",
        "own": carried.add(own, ".bin"),
        "skin": carried.add(skin, ".bin"),
        "labels": _shares(made.avatar),
        "pixel": subject.pixel,
        "capture": name if name in motions else "",
        "price": _prices(made.avatar, subject, scorer, shown, clips, corrections),
        "corrected": corrections and corrections.about | {"file": carried.add(corrections.packed(), ".bin")},
    }  # fmt: skip


def _chosen() -> list[str]:
    known = registry.names("motion")
    return [motion for motion in SHOWN if motion in known]


def _tests(scorer: Scorer | None, shown: SceneFrames | None) -> dict[str, TestView]:
    """The pictured test views by what a page calls them."""
    if scorer is None or shown is None:
        return {}
    at = {(key.camera_id, key.frame): k for k, key in enumerate(scorer.scene.test_keys)}
    keys = [(view["camera"], view["frame"]) for view in shown.views]
    return {f"{camera}/{frame}": scorer.scene.test[at[camera, frame]] for camera, frame in keys}


def _corrections(
    made: Baked, subject: Subject, clips: Mapping[str, Motion], rest: BodyPose, tests: Mapping[str, TestView]
) -> Corrections | None:
    """Of the A-pose, of the pictured test views and along the motions; None where the avatar needs none."""
    if made.corrections is None:
        return None
    of, samples = made.corrections, {}
    samples["rest"] = of(rest)[None]
    samples |= {f"view {name}": of(view.body_pose)[None] for name, view in tests.items()}
    for name, clip in clips.items():
        poses = clip.body_poses(subject.betas)
        samples[f"motion {name}"] = np.stack([of(poses[k]) for k in samples_of(len(poses), clip.cyclic)])
    return Corrections.of(samples)


def _shares(baked: BakedAvatar) -> dict[str, float]:
    """Share of the Gaussians that each label has; zeros where nothing is known."""
    labels = baked.labels
    part = labels & 3
    found = {"visible": part == VISIBLE, "hidden": part == HIDDEN, "never_seen": part == NEVER_SEEN}
    found["painted"] = labels & PAINTED > 0
    return {name: float(mask.mean()) for name, mask in found.items()}


def _prices(
    baked: BakedAvatar,
    subject: Subject,
    scorer: Scorer | None,
    shown: SceneFrames | None,
    clips: Mapping[str, Motion],
    corrections: Corrections | None,
) -> dict[str, list[Any]]:
    """Where it was measured -> [PSNR, IoU]: in some of the pictured test views, and early in a motion."""
    prices: dict[str, list[Any]] = {}
    if scorer is None or shown is None:
        return prices
    background, tests = scorer.scene.protocol.image.background, _tests(scorer, shown)
    for name in [list(tests)[i] for i in spread(len(tests), PRICED_VIEWS)]:
        view, correction = tests[name], corrections and corrections.at(f"view {name}")
        found = price(baked, subject, view.camera, view.body_pose, background, correction)
        prices[name] = [number(found.psnr), number(found.iou)]
    for name in [name for name in PRICED_MOTIONS if name in clips]:
        frame = len(clips[name]) // 4
        pose, correction = _pose(clips[name], frame, subject), corrections and corrections.at(f"motion {name}", frame)
        camera = _framing(subject, pose).camera(0, 20.0, SIDE, SIDE)
        found = price(baked, subject, camera, pose, background, correction)
        prices[f"motion {name}"] = [number(found.psnr), number(found.iou)]
    return prices


def _pose(motion: Motion, frame: int, subject: Subject) -> BodyPose:
    return motion.body_poses(subject.betas)[frame]


def _framing(subject: Subject, pose: BodyPose) -> Framing:
    """A camera's view of one pose in SMPL's axes."""
    stand = stand_of(subject.body, pose, np.array([0.0, 1.0, 0.0]))
    return Framing.of([subject.body.pose(pose)], [0], stand.pelvis[None], stand)


def _turntable(subject: Subject, files: Files) -> list[str]:
    """Pictures of the A-pose from around, the first from the front; drawn no finer than it was photographed."""
    pose = BodyPose(canonical_pose(A_POSE), subject.betas, np.zeros(3))
    framing, names = _framing(subject, pose), []

    def picture(camera: Camera) -> NDArray[np.float32]:
        return drawn(subject.avatar, camera, pose, GROUND, None, subject.body, subject.pixel)[0]

    begun = time.monotonic()
    picture(framing.camera(0, 0.0, SIDE, SIDE))  # compiles, where something is compiled
    first = picture(framing.camera(0, 0.0, SIDE, SIDE))
    around = AROUND if time.monotonic() - begun < PATIENCE else FEW
    for k, camera in enumerate(orbit(framing, around, SIDE, SIDE)):
        rgb = first if k == 0 else picture(camera)
        names.append(files.add(encoded(displayed(np.asarray(rgb)), "WEBP", quality=QUALITY), ".webp"))
    return names


def _captured(subject: Subject) -> Motion:
    """The training frames' poses, upright and facing the camera at the start, as far as a page has room."""
    whole = subject.motion(CAPTURE, FPS)
    some = spread(len(whole), MOST_FRAMES)
    body, rest = subject.body, subject.body.shaped(subject.betas)[1][0]
    return placed(Motion(whole.pose[some], whole.transl[some], FPS), body, subject.betas, Stand(np.eye(3), rest))


def _packed(motion: Motion) -> Mapping[str, Any]:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(motion.pose.reshape(-1, 3)).as_rotvec()  # none beyond half a turn
    angles: NDArray[np.int16] = np.rint(turns * UNITS).astype("<i2")
    return {"fps": motion.fps, "frames": len(motion), "pose": b64encode(angles.tobytes()).decode("ascii")}
