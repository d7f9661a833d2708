"""Captures with too little in them, damaged or hostile files, and predictions that are none."""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ihbench.body import texel_table
from ihbench.camera import Camera
from ihbench.clock.events import Warned
from ihbench.clock.ledger import Ledger
from ihbench.config_fields import replaced
from ihbench.data.data_check import fitness
from ihbench.errors import BadInput
from ihbench.files.atomic import read_json, write_json
from ihbench.files.images import read_image
from ihbench.files.safe_pickle import load_npy, load_pickle
from ihbench.scene.contracts import MaskState
from ihbench.scene.occlusion import apply_rule
from ihbench.scene.plan import measure_scene
from ihbench.scene.protocol import Protocol, Span
from ihbench.scene.views import OccludedScene, open_scene
from ihbench.scene.visibility import texel_visibility
from ihbench.scoring.calibration import Calibration
from ihbench.scoring.scoring import Scorer
from ihbench.stress.case import Answer, Case, Unit, words_of
from ihbench.stress.drawn_capture import (
    SIZE,
    WHITE,
    DrawnCapture,
    a_camera,
    a_pose,
    small_protocol,
    the_body,
    train_view,
    turning_capture,
)

COUNT = "pixels, texels and views are counted"
REFUSED = "it must be refused, and the line must say this"
EXACT = "the definition gives this and nothing else"

EVERYTHING = (SIZE // 2, 2 * SIZE)  # mid and width of a strip over the whole image, px
FRAMES = 5


def empty(_camera: int, _frame: int, pixels: NDArray) -> NDArray:
    return np.zeros_like(pixels)


def whole(_camera: int, _frame: int, pixels: NDArray) -> NDArray:
    return np.ones_like(pixels)


def protocol_for(capture: DrawnCapture, **options: Any) -> Protocol:
    return small_protocol(n_frames=capture.n_frames, **options)


def _scorer(capture: DrawnCapture, protocol: Protocol) -> Scorer:
    return Scorer.build(open_scene(capture, protocol))


@cache
def usual() -> Scorer:
    """Five frames, four cameras, half of the person hidden in most frames."""
    capture = turning_capture(FRAMES)
    return _scorer(capture, protocol_for(capture))


def _states(scene: OccludedScene) -> list[int]:
    """Pixels of each mask state in the covered training frames."""
    views = [view for view, covered in zip(scene.train, scene.hiding.covered, strict=True) if covered]
    masks = np.stack([view.mask for view in views])
    return [int((masks == state).sum()) for state in MaskState]


# ----------------------------------------------------------------------------------------------------
# Too little to see


def _nobody_to_hide() -> Answer:
    capture = replace(turning_capture(FRAMES), edit_silhouette=empty)
    return Answer(words_of(BadInput, lambda: open_scene(capture, protocol_for(capture))), "no person pixel in any")


def _nobody_to_score() -> Answer:
    """Frames without a person: the regions are empty, and their scores absent with a reason."""
    capture = replace(turning_capture(FRAMES), edit_silhouette=empty)
    scorer = _scorer(capture, protocol_for(capture, rule="none"))
    loaded = scorer.load(0)
    scores = scorer.score(loaded, loaded.view.image, slow=False).scores
    return Answer(scores["psnr/pooled/range1/body/v1"].reason, "empty region")


def _all_hidden() -> Answer:
    """A strip over the whole image: every pixel of a covered frame is unknown, no texel is seen, some are faced."""
    capture = turning_capture(FRAMES)
    scene = open_scene(capture, protocol_for(capture, strip=EVERYTHING))
    background, person, _ = _states(scene)
    covered = [view for view, is_covered in zip(scene.train, scene.hiding.covered, strict=True) if is_covered]
    seen = texel_visibility(covered, the_body(), texel_table(the_body(), 64))
    return Answer([background, person, int(seen.seen.sum()), int((seen.faced > 0).any())], [0, 0, 0, 1])


def _all_hidden_regions() -> Answer:
    """With every frame hidden the body has no visible pixel, and hidden and never seen share it."""
    capture = turning_capture(FRAMES)
    protocol = protocol_for(capture, strip=EVERYTHING)
    protocol = replaced(protocol, {"occlusion.covers.fraction": 1.0})
    scorer = _scorer(capture, protocol)
    found = []
    for index in range(len(scorer.scene.test_keys)):
        regions = scorer.load(index).regions
        body, visible, hidden, never = (np.asarray(regions[n]) for n in ("body", "visible", "hidden", "never_seen"))
        found.append([int(visible.sum()), int((hidden ^ never ^ body).sum())])
    return Answer(found, 0)


def _hidden_share(fraction: float) -> Answer:
    """The strip for all of the person hides all of it, that for none nothing."""
    capture = turning_capture(FRAMES)
    protocol = protocol_for(capture)
    protocol = replaced(protocol, {"occlusion.fraction": fraction})
    return Answer(apply_rule(protocol, capture).hidden_share(), fraction)


def _one_frame() -> Answer:
    capture = turning_capture(1)
    protocol = protocol_for(capture, rule="none")
    scene = open_scene(capture, protocol)
    measure = measure_scene(scene)
    return Answer([len(scene.train), measure.motion_deg, measure.turn_deg], [1, 0, 0])


def _one_camera() -> Answer:
    """The only camera trains, and none is left to test on."""
    capture = turning_capture(FRAMES)
    capture = replace(capture, cameras=capture.cameras[:1])
    protocol = replaced(protocol_for(capture), {"test.cameras.start": 1})
    return Answer(words_of(BadInput, lambda: open_scene(capture, protocol)), "leaves no test view")


def _missing(what: str, change: dict[str, Any]) -> Answer:
    capture = turning_capture(FRAMES)
    protocol = replaced(protocol_for(capture), change)
    return Answer(words_of(BadInput, lambda: open_scene(capture, protocol)), what)


def _short_capture() -> Answer:
    """`data check` says it without opening a picture."""
    capture = turning_capture(FRAMES)
    return Answer(fitness(capture, small_protocol(n_frames=FRAMES + 1)), "has 5 frames, needs frame 5")


def _behind_camera() -> Answer:
    """A body behind the camera faces nobody, and nothing divides by its depth."""
    camera, about = a_camera(), np.diag([-1.0, 1, -1])
    view = train_view(Camera(camera.K, about @ camera.R, about @ camera.t, SIZE, SIZE), a_pose())
    seen = texel_visibility([view], the_body(), texel_table(the_body(), 64))
    return Answer([int(seen.faced.sum()), int(seen.seen.sum())], 0)


def _camera_in_body() -> Answer:
    """A camera inside the chest: whatever it sees, every texel gets an answer."""
    camera = a_camera()
    inside = Camera(camera.K, np.eye(3), -the_body().v_template.mean(0), SIZE, SIZE)
    view = replace(train_view(inside, a_pose()), mask=np.full((SIZE, SIZE), MaskState.PERSON, np.uint8))
    seen = texel_visibility([view], the_body(), texel_table(the_body(), 64))
    return Answer([int((seen.seen > seen.faced).sum()), int(seen.never_seen.sum() + (seen.faced > 0).sum())],
                  [0, len(seen.faced)])  # fmt: skip


def _whole_turn() -> Answer:
    """Joints whose axis-angle grows by 2π from frame to frame do not move."""
    poses = []
    for k in range(3):
        pose = a_pose(0.3, 0.5)
        rotations = pose.pose.copy()
        length = np.linalg.norm(rotations, axis=1, keepdims=True)
        rotations += 2 * math.pi * k * np.divide(rotations, length, out=np.zeros_like(rotations), where=length > 0)
        poses.append(replace(pose, pose=rotations))
    capture = DrawnCapture(poses, turning_capture(1).cameras)
    measure = measure_scene(open_scene(capture, protocol_for(capture, rule="none")))
    return Answer([measure.motion_deg, measure.turn_deg], 0, math.inf)


# ----------------------------------------------------------------------------------------------------
# Regions and pictures


def _partition() -> Answer:
    """Visible, hidden and never seen are disjoint and make up the body, in every test view."""
    scorer, found = usual(), []
    for index in range(len(scorer.scene.test_keys)):
        regions = scorer.load(index).regions
        count = sum(np.asarray(regions[name], np.int64) for name in ("visible", "hidden", "never_seen"))
        found.append(int(np.count_nonzero(np.not_equal(count, regions["body"]))))
    return Answer(found, 0)


def _full_silhouette() -> Answer:
    """A silhouette that is the whole image: every pixel gets a label from the nearest body pixel."""
    capture = replace(turning_capture(FRAMES), edit_silhouette=whole)
    scorer = _scorer(capture, protocol_for(capture, rule="none"))
    regions = scorer.load(0).regions
    labelled = sum(np.asarray(regions[name], np.int64) for name in ("visible", "hidden", "never_seen"))
    return Answer(labelled, 1)


def _sized(size: int) -> Answer:
    """The protocol's image has another size than the photograph: the truth still scores as the truth."""
    capture = turning_capture(FRAMES)
    scorer = _scorer(capture, protocol_for(capture, size=size, rule="none"))
    loaded = scorer.load(0)
    scores = scorer.score(loaded, loaded.view.image, slow=False).scores
    return Answer(
        [*loaded.view.image.shape, scores["psnr/pooled/range1/full/v1"].value], [size, size, 3, math.inf]
    )  # fmt: skip


def _truth(change: Callable[[NDArray], NDArray]) -> Answer:
    """The truth, in any form that 8 bits can hold, has no error."""
    scorer = usual()
    loaded = scorer.load(0)
    scores = scorer.score(loaded, change(loaded.view.image), slow=False).scores
    found = [score.value for name, score in scores.items() if not score.absent]
    perfect = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    return Answer(found, [perfect[name.split("/")[0]] for name, score in scores.items() if not score.absent])


def _prediction(image: Callable[[NDArray], NDArray | None], name: str, words: str) -> Answer:
    """Why a prediction has no score."""
    scorer = usual()
    loaded = scorer.load(0)
    try:
        score = scorer.score(loaded, image(loaded.view.image), slow=False).scores[name]
    except BadInput as error:
        return Answer(str(error), words)
    return Answer(score.reason, words)


def _nan_elsewhere() -> Answer:
    """A NaN outside the body costs the whole frame its score, and the body nothing."""
    scorer = usual()
    loaded = scorer.load(0)
    worse = loaded.view.image * np.float32(0.9)
    spoiled = worse.copy()
    row, column = np.argwhere(~np.asarray(loaded.regions["body"]))[0]
    spoiled[row, column] = math.nan
    clean, found = (scorer.score(loaded, image, slow=False).scores for image in (worse, spoiled))
    name = "ssim/gauss11-1.5/range1/{}/v1".format
    return Answer([found[name("full")].value, found[name("body")].value], [math.nan, clean[name("body")].value])


def _no_color() -> Answer:
    """Calibration rows of a scene in which nobody was ever visible are finite."""
    capture = turning_capture(FRAMES)
    scorer = _scorer(capture, protocol_for(capture, strip=EVERYTHING))
    hidden = [view for view, covered in zip(scorer.scene.train, scorer.scene.hiding.covered, strict=True) if covered]
    calibration = Calibration.build(replace(scorer.scene.training, views=hidden))
    view = scorer.load(0).view
    rows = [calibration.predict(row, view) for row in ("nearest-frame", "mean-colour-body", "pasted-texture")]
    return Answer(int((~np.isfinite(np.stack(rows))).sum()), 0)


# ----------------------------------------------------------------------------------------------------
# Files


@contextmanager
def _file(name: str, content: bytes) -> Iterator[Path]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        yield path


def _read(reader: Callable[[Path], Any], name: str, content: bytes, words: str) -> Answer:
    with _file(name, content) as path:
        said = words_of(BadInput, lambda: reader(path))
    return Answer(said.replace(str(path), name), words)  # the folder's name is another every time


class _Caller:
    """Pickles as a call of a function that must not be called."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str, ...]]:
        return eval, ("1 + 1",)


def _nested(depth: int) -> bytes:
    """Lists of two references to the list before: two to the power of this many elements when written out."""
    value: list[Any] = []
    for _ in range(depth):
        value = [value, value]
    return pickle.dumps({"shapes": value})


def _npy(array: NDArray, cut: int = 0) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()[: len(file.getvalue()) - cut]


def _json_round_trip() -> Answer:
    """What strict JSON lacks comes back as it went in; text that looks like it stays text."""
    given = {"a": [math.nan, math.inf, -math.inf, -0.0, 5e-324, 1.7976931348623157e308, 0.1]}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.json"
        write_json(path, given | {"text": "nan"})
        back = read_json(path)
    same = back["text"] == "nan" and math.copysign(1, back["a"][3]) == -1
    return Answer([*back["a"], float(same)], [*given["a"], 1.0])


def _damaged_state(cut: int) -> Answer:
    """A checkpoint that lost its end counts as absent, and an event says so."""
    with TemporaryDirectory() as folder:
        ledger = Ledger(Path(folder))
        ledger.save_state("stage", {"x": np.arange(100.0)}, {"step": 3})
        path = Path(folder) / "checkpoints" / "stage.safetensors"
        path.write_bytes(path.read_bytes()[:-cut])
        lost = ledger.load_state("stage") is None
        said = [event.data["what"] for event in ledger.events if event.kind == Warned.kind]
    return Answer(f"lost {lost}: {said}", "lost True: ['checkpoint stage is damaged")


def _bad_mask_pixels() -> Answer:
    """Three-state masks hold three states: any other number would be nobody's pixel."""
    scene = usual().scene
    states = np.unique(np.concatenate([np.unique(view.mask) for view in scene.train]))
    return Answer(states, [int(state) for state in MaskState])


picture = partial(read_image, background=WHITE)


def _data(name: str, what: str, unit: Unit, tolerance: float, why: str, function: Callable[[], Answer]) -> Case:
    return Case(name, "data", what, unit, tolerance, why, function)


PSNR_FULL = "psnr/pooled/range1/full/v1"

CASES = [
    _data("nobody-to-hide", "a strip for frames without a person", "words", 0, REFUSED, _nobody_to_hide),
    _data("nobody-to-score", "test frames without a person", "words", 0, REFUSED, _nobody_to_score),
    _data("all-hidden", "a strip over the whole image", "absolute", 0, COUNT, _all_hidden),
    _data("all-hidden-regions", "every training frame hidden", "absolute", 0, COUNT, _all_hidden_regions),
    _data("strip-of-everything", "a strip for 100 % of the person", "absolute", 0, COUNT,
          partial(_hidden_share, 1.0)),
    _data("strip-of-nothing", "a strip for 0 % of the person", "absolute", 0, COUNT, partial(_hidden_share, 0.0)),
    _data("one-frame", "one training frame", "absolute", 1e-5, "an arccosine near 1 keeps half of the digits",
          _one_frame),
    _data("one-camera", "one camera", "words", 0, REFUSED, _one_camera),
    _data("camera-missing", "the training camera is not there", "words", 0, REFUSED,
          partial(_missing, "training needs camera index 9", {"train.camera": 9})),
    _data("frames-missing", "frames that are not there", "words", 0, REFUSED,
          partial(_missing, "has 5 frames", {"test.frames": Span(0, 9, 1)})),
    _data("short-capture", "a capture a frame too short is told apart from a fit one", "words", 0, REFUSED,
          _short_capture),
    _data("body-behind-camera", "a body behind the training camera", "absolute", 0, COUNT, _behind_camera),
    _data("camera-in-body", "a training camera inside the body", "absolute", 0, COUNT, _camera_in_body),
    _data("motion-whole-turns", "axis-angles that differ by whole turns", "absolute", 1e-5,
          "an arccosine near 1 keeps half of the digits", _whole_turn),
    _data("regions-partition", "visible, hidden and never seen make up the body", "absolute", 0, COUNT, _partition),
    _data("silhouette-whole-image", "a silhouette that is the whole image", "absolute", 0, COUNT, _full_silhouette),
    *(
        _data(f"image-{size}", f"a protocol of {size} px for photographs of {SIZE} px", "absolute", 0, EXACT,
              partial(_sized, size))
        for size in (4, 2 * SIZE)
    ),
    _data("truth-float64", "the truth in float64", "absolute", 0, EXACT, partial(_truth, lambda x: x.astype(float))),
    _data("truth-uint8", "the truth in 8 bits", "absolute", 0, EXACT,
          partial(_truth, lambda x: np.rint(x * 255).astype(np.uint8))),
    _data("truth-float16", "the truth in half precision", "absolute", 0, EXACT + "; 8 bits take its rounding away",
          partial(_truth, lambda x: x.astype(np.float16))),
    _data("prediction-none", "a view without a prediction", "words", 0, REFUSED,
          partial(_prediction, lambda x: None, PSNR_FULL, "no prediction of this view")),
    _data("prediction-size", "a prediction of another size", "words", 0, REFUSED,
          partial(_prediction, lambda x: x[1:], PSNR_FULL, "expected (48, 48, 3)")),
    _data("prediction-nan", "a prediction of NaN", "words", 0, REFUSED,
          partial(_prediction, lambda x: x * np.float32(math.nan), PSNR_FULL, "NaN or infinite pixel")),
    _data("prediction-nan-elsewhere", "a NaN outside the body", "absolute", 1e-14,
          "a region's mean may be taken from the frame's where that is finite: the sum has another order",
          _nan_elsewhere),
    _data("calibration-nobody-visible", "calibration rows where nobody was ever visible", "absolute", 0, COUNT,
          _no_color),
    _data("mask-states", "the states of training masks", "absolute", 0, EXACT, _bad_mask_pixels),
    _data("pickle-calls", "a pickle that calls a function", "words", 0, REFUSED,
          partial(_read, load_pickle, "x.pkl", pickle.dumps(_Caller()), "eval")),
    _data("pickle-cut", "a pickle that lost its end", "words", 0, REFUSED,
          partial(_read, load_pickle, "x.pkl", pickle.dumps({"a": list(range(100))})[:-20], "x.pkl")),
    _data("pickle-bomb", "a pickle of 2^60 elements in a kilobyte", "words", 0, REFUSED,
          partial(_read, load_pickle, "x.pkl", _nested(60), "x.pkl")),
    _data("npy-cut", "an array that lost its end", "words", 0, REFUSED,
          partial(_read, load_npy, "x.npy", _npy(np.arange(100.0), 8), "x.npy")),
    _data("picture-none", "a prediction file that is no picture", "words", 0, REFUSED,
          partial(_read, picture, "x.png", b"no picture", "cannot be read as an image")),
    _data("picture-object-array", "a prediction file of Python objects", "words", 0, REFUSED,
          partial(_read, picture, "x.npy", _npy(np.array([None])), "floats in [0, 1], got object")),
    _data("json-cut", "a record that lost its end", "words", 0, REFUSED,
          partial(_read, read_json, "x.json", b'{"a": [1, 2', "not valid JSON")),
    _data("json-not-finite", "NaN, infinities, -0 and the ends of float64", "absolute", 0, "not a bit may change",
          _json_round_trip),
    _data("state-cut", "a checkpoint that lost its last byte", "words", 0, REFUSED, partial(_damaged_state, 1)),
]  # fmt: skip
