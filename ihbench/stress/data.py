"""Captures with too little in them, damaged or hostile files, and predictions that are none."""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Callable, Iterator, Mapping
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
from ihbench.metrics.identity import Score
from ihbench.scene.contracts import MaskState, TrainView
from ihbench.scene.occlusion import apply_rule
from ihbench.scene.plan import measure_scene
from ihbench.scene.protocol import Span
from ihbench.scene.views import OccludedScene, open_scene
from ihbench.scene.visibility import texel_visibility
from ihbench.scoring.calibration import Calibration
from ihbench.scoring.scoring import Scorer
from ihbench.stress.case import Answer, Case, words_of
from ihbench.stress.drawn_capture import (
    SIZE,
    WHITE,
    DrawnCapture,
    Edit,
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
PSNR_FULL = "psnr/pooled/range1/full/v1"

EVERYTHING = (SIZE // 2, 2 * SIZE)  # mid and width of a strip over the whole image, px
FRAMES = 5


def filled(value: bool) -> Edit:
    return lambda camera, frame, pixels: np.full_like(pixels, value)


protocol_with = partial(small_protocol, n_frames=FRAMES)


@cache
def person() -> DrawnCapture:
    """Five frames, four cameras."""
    return turning_capture(FRAMES)


def _scorer(capture: DrawnCapture, **options: Any) -> Scorer:
    return Scorer.build(open_scene(capture, protocol_with(**options)))


@cache
def usual() -> Scorer:
    """Of `person`, half of it hidden in most frames."""
    return _scorer(person())


def _covered(scene: OccludedScene) -> list[TrainView]:
    """The training views that the rule occludes."""
    return [view for view, covered in zip(scene.train, scene.hiding.covered, strict=True) if covered]


def _scores(scorer: Scorer, change: Callable[[NDArray], NDArray | None] = lambda truth: truth) -> dict[str, Score]:
    """Of a prediction made from the first test view's truth."""
    loaded = scorer.load(0)
    return scorer.score(loaded, change(loaded.view.image), slow=False).scores


def _regions(scorer: Scorer, *names: str) -> Iterator[list[NDArray[np.int64]]]:
    """The named regions of every test view."""
    for index in range(len(scorer.scene.test_keys)):
        regions = scorer.load(index).regions
        yield [np.asarray(regions[name], np.int64) for name in names]


# ----------------------------------------------------------------------------------------------------
# Too little to see


def _not_opened(words: str, change: Mapping[str, object], **of_capture: Any) -> Answer:
    capture, protocol = replace(person(), **of_capture), replaced(protocol_with(), change)
    return Answer(words_of(BadInput, lambda: open_scene(capture, protocol)), words)


def _nobody_to_score() -> Answer:
    scores = _scores(_scorer(replace(person(), edit_silhouette=filled(False)), rule="none"))
    return Answer(scores["psnr/pooled/range1/body/v1"].reason, "empty region")


def _all_hidden() -> Answer:
    """A strip over the whole image: every pixel of a covered frame is unknown, no texel is seen, some are faced."""
    covered = _covered(open_scene(person(), protocol_with(strip=EVERYTHING)))
    known = sum(int((view.mask != MaskState.UNKNOWN).sum()) for view in covered)
    seen = texel_visibility(covered, the_body(), texel_table(the_body(), 64))
    return Answer([known, int(seen.seen.sum()), int((seen.faced > 0).any())], [0, 0, 1])


def _all_hidden_regions() -> Answer:
    """With every frame hidden the body has no visible pixel, and hidden and never seen share it."""
    protocol = replaced(protocol_with(strip=EVERYTHING), {"occlusion.covers.fraction": 1.0})
    regions = _regions(Scorer.build(open_scene(person(), protocol)), "body", "visible", "hidden", "never_seen")
    return Answer([[int(v.sum()), int((h ^ n ^ body).sum())] for body, v, h, n in regions], 0)


def _hidden_share(fraction: float) -> Answer:
    protocol = replaced(protocol_with(), {"occlusion.fraction": fraction})
    return Answer(apply_rule(protocol, person()).hidden_share(), fraction)


def _one_frame() -> Answer:
    scene = open_scene(turning_capture(1), small_protocol(n_frames=1, rule="none"))
    measure = measure_scene(scene)
    return Answer([len(scene.train), measure.motion_deg, measure.turn_deg], [1, 0, 0])


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
    measure = measure_scene(open_scene(capture, small_protocol(n_frames=3, rule="none")))
    return Answer([measure.motion_deg, measure.turn_deg], 0, math.inf)


# ----------------------------------------------------------------------------------------------------
# Regions and pictures


PARTS = ("visible", "hidden", "never_seen")


def _partition() -> Answer:
    """Visible, hidden and never seen are disjoint and make up the body, in every test view."""
    regions = _regions(usual(), "body", *PARTS)
    return Answer([int(np.count_nonzero(sum(parts) != body)) for body, *parts in regions], 0)


def _full_silhouette() -> Answer:
    """A silhouette that is the whole image: every pixel gets a label from the nearest body pixel."""
    scorer = _scorer(replace(person(), edit_silhouette=filled(True)), rule="none")
    return Answer(sum(next(_regions(scorer, *PARTS))), 1)


def _sized(size: int) -> Answer:
    """The protocol's image has another size than the photograph: the truth still scores as the truth."""
    scorer = _scorer(person(), size=size, rule="none")
    got = *scorer.load(0).view.image.shape, _scores(scorer)[PSNR_FULL].value
    return Answer(got, [size, size, 3, math.inf])


def _truth(change: Callable[[NDArray], NDArray]) -> Answer:
    values = {name: score.value for name, score in _scores(usual(), change).items() if not score.absent}
    perfect = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    return Answer(list(values.values()), [perfect[name.split("/")[0]] for name in values])


def _prediction(image: Callable[[NDArray], NDArray | None], words: str) -> Answer:
    try:
        return Answer(_scores(usual(), image)[PSNR_FULL].reason, words)
    except BadInput as error:
        return Answer(str(error), words)


def _nan_elsewhere() -> Answer:
    """A NaN outside the body costs the whole frame its score, and the body nothing."""
    scorer = usual()
    loaded = scorer.load(0)
    worse = loaded.view.image * np.float32(0.9)
    spoiled = worse.copy()
    row, column = np.argwhere(~np.asarray(loaded.regions["body"]))[0]
    spoiled[row, column] = math.nan
    clean, got = (scorer.score(loaded, image, slow=False).scores for image in (worse, spoiled))
    name = "ssim/gauss11-1.5/range1/{}/v1".format
    return Answer([got[name("full")].value, got[name("body")].value], [math.nan, clean[name("body")].value])


def _no_color() -> Answer:
    scorer = _scorer(person(), strip=EVERYTHING)
    calibration = Calibration.build(replace(scorer.scene.training, views=_covered(scorer.scene)))
    view = scorer.load(0).view
    rows = [calibration.predict(row, view) for row in ("nearest-frame", "mean-colour-body", "pasted-texture")]
    return Answer(int((~np.isfinite(np.stack(rows))).sum()), 0)


# ----------------------------------------------------------------------------------------------------
# Files


def _read(reader: Callable[[Path], Any], name: str, content: bytes, words: str) -> Answer:
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(content)
        refusal = words_of(BadInput, lambda: reader(path))
    return Answer(refusal.replace(str(path), name), words)  # the folder's name is another every time


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
    with TemporaryDirectory() as folder:
        ledger = Ledger(Path(folder))
        ledger.save_state("stage", {"x": np.arange(100.0)}, {"step": 3})
        path = Path(folder) / "checkpoints" / "stage.safetensors"
        path.write_bytes(path.read_bytes()[:-cut])
        lost = ledger.load_state("stage") is None
        said = [event.data["what"] for event in ledger.events if event.kind == Warned.kind]
    return Answer(f"lost {lost}: {said}", "lost True: ['checkpoint stage is damaged")


picture = partial(read_image, background=WHITE)


_data = partial(Case, group="data")
_refused = partial(_data, unit="words", tolerance=0, why=REFUSED)
_counted = partial(_data, unit="absolute", tolerance=0, why=COUNT)
_exact = partial(_data, unit="absolute", tolerance=0, why=EXACT)


CASES = [
    _refused("nobody-to-hide", "a strip for frames without a person",
             partial(_not_opened, "no person pixel in any", {}, edit_silhouette=filled(False))),
    _refused("nobody-to-score", "test frames without a person", _nobody_to_score),
    _counted("all-hidden", "a strip over the whole image", _all_hidden),
    _counted("all-hidden-regions", "every training frame hidden", _all_hidden_regions),
    _counted("strip-of-everything", "a strip for 100 % of the person", partial(_hidden_share, 1.0)),
    _counted("strip-of-nothing", "a strip for 0 % of the person", partial(_hidden_share, 0.0)),
    _data("one-frame", "one training frame", _one_frame, "absolute", 1e-5,
          "an arccosine near 1 keeps half of the digits"),
    _refused("one-camera", "one camera",
             partial(_not_opened, "leaves no test view", {"test.cameras.start": 1}, cameras=[a_camera()])),
    _refused("camera-missing", "the training camera is not there",
             partial(_not_opened, "training needs camera index 9", {"train.camera": 9})),
    _refused("frames-missing", "frames that are not there",
             partial(_not_opened, "has 5 frames", {"test.frames": Span(0, 9, 1)})),
    _refused("short-capture", "a capture a frame too short is told apart from a fit one",
             lambda: Answer(fitness(person(), small_protocol(n_frames=FRAMES + 1)), "has 5 frames, needs frame 5")),
    _counted("body-behind-camera", "a body behind the training camera", _behind_camera),
    _counted("camera-in-body", "a training camera inside the body", _camera_in_body),
    _data("motion-whole-turns", "axis-angles that differ by whole turns", _whole_turn, "absolute", 1e-5,
          "an arccosine near 1 keeps half of the digits"),
    _counted("regions-partition", "visible, hidden and never seen make up the body", _partition),
    _counted("silhouette-whole-image", "a silhouette that is the whole image", _full_silhouette),
    *(
        _exact(f"image-{size}", f"a protocol of {size} px for photographs of {SIZE} px", partial(_sized, size))
        for size in (4, 2 * SIZE)
    ),
    _exact("truth-float64", "the truth in float64", partial(_truth, lambda x: x.astype(float))),
    _exact("truth-uint8", "the truth in 8 bits", partial(_truth, lambda x: np.rint(x * 255).astype(np.uint8))),
    _data("truth-float16", "the truth in half precision", partial(_truth, lambda x: x.astype(np.float16)), "absolute",
          0, EXACT + "; 8 bits take its rounding away"),
    _refused("prediction-none", "a view without a prediction",
             partial(_prediction, lambda x: None, "no prediction of this view")),
    _refused("prediction-size", "a prediction of another size",
             partial(_prediction, lambda x: x[1:], "expected (48, 48, 3)")),
    _refused("prediction-nan", "a prediction of NaN",
             partial(_prediction, lambda x: x * np.float32(math.nan), "NaN or infinite pixel")),
    _data("prediction-nan-elsewhere", "a NaN outside the body", _nan_elsewhere, "absolute", 1e-14,
          "a region's mean may be taken from the frame's where that is finite: the sum has another order"),
    _counted("calibration-nobody-visible", "calibration rows where nobody was ever visible", _no_color),
    _exact("mask-states", "the states of training masks",
           lambda: Answer(np.unique([view.mask for view in usual().scene.train]), list(map(int, MaskState)))),
    _refused("pickle-calls", "a pickle that calls a function",
             partial(_read, load_pickle, "x.pkl", pickle.dumps(_Caller()), "eval")),
    _refused("pickle-cut", "a pickle that lost its end",
             partial(_read, load_pickle, "x.pkl", pickle.dumps({"a": list(range(100))})[:-20], "x.pkl")),
    _refused("pickle-bomb", "a pickle of 2^60 elements in a kilobyte",
             partial(_read, load_pickle, "x.pkl", _nested(60), "x.pkl")),
    _refused("npy-cut", "an array that lost its end",
             partial(_read, load_npy, "x.npy", _npy(np.arange(100.0), 8), "x.npy")),
    _refused("picture-none", "a prediction file that is no picture",
             partial(_read, picture, "x.png", b"no picture", "cannot be read as an image")),
    _refused("picture-object-array", "a prediction file of Python objects",
             partial(_read, picture, "x.npy", _npy(np.array([None])), "floats in [0, 1], got object")),
    _refused("json-cut", "a record that lost its end",
             partial(_read, read_json, "x.json", b'{"a": [1, 2', "not valid JSON")),
    _data("json-not-finite", "NaN, infinities, -0 and the ends of float64", _json_round_trip, "absolute", 0,
          "not a bit may change"),
    _refused("state-cut", "a checkpoint that lost its last byte", partial(_damaged_state, 1)),
]  # fmt: skip
