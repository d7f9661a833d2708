"""The commands as functions: what they take, what they refuse, and that both are one."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ihbench
from ihbench.clock.progress import Progress
from ihbench.errors import BadInput
from ihbench.files.atomic import read_json
from ihbench.metrics import Identity
from ihbench.runner.run_loop import RunRequest
from ihbench.scene.data_source import locate
from ihbench.scene.protocol import load_protocol

QUIET = Progress.silent()


@pytest.fixture
def call(bench, mannequin):
    """Call one of the functions with the tiny protocol, the mannequin and an empty runs folder."""

    def run(function, *positional, **arguments):
        own = {"protocol": bench.protocol, "runs": bench.runs, "method": mannequin, "progress": QUIET}
        own = {"load_scene": {k: own[k] for k in ("protocol", "progress")}, "score": own}.get(function, own)
        if function == "score":
            own = {name: value for name, value in own.items() if name != "method"}
        with bench.in_its_world():
            return getattr(ihbench, function)(*positional, **own | arguments)

    return run


WRONG = [
    ({"seed": [0, 1]}, "seed .*: expected one"),
    ({"seed": np.arange(2)}, "seed .*: expected one"),
    ({"seed": True}, "seed True: expected a whole number"),
    ({"seed": 1.0}, "seed 1.0: expected a whole number"),
    ({"seed": "1"}, "seed '1': expected a whole number"),
    ({"seed": -1}, "seed -1: expected 0 to 4294967295"),
    ({"seed": 2**32}, "seed 4294967296: expected 0 to 4294967295"),
    ({"seed": None}, "seed None"),
    ({"scene": ["standin-1"]}, "scene .*: expected one"),
    ({"scene": "standin-x"}, "unknown scene 'standin-x'"),
    ({"scene": ""}, "scene ''"),
    ({"scene": None}, "scene None: expected a text"),
    ({"protocol": "zju_oc"}, "did you mean 'zju_occ'"),
    ({"protocol": 3}, "protocol 3: expected a text"),
    ({"profile": "fast"}, "unknown profile 'fast'"),
    ({"method": "mannekin"}, "did you mean 'mannequin'"),
    ({"device": "tpu"}, "device 'tpu': expected one of cpu, cuda"),
    ({"device": "cuda"}, "torch sees no CUDA device"),
    ({"force": "no"}, "force 'no': expected True or False"),
    ({"force": 1}, "force 1: expected True or False"),
    ({"runs": 3}, "runs 3: expected a path"),
    ({"runs": ""}, "runs '': expected a path"),
    ({"data": "nowhere"}, "data folder nowhere: does not exist"),
    ({"progress": False}, "progress False: expected"),
    ({"keep": ["brightnes"]}, "did you mean 'brightness'"),
    ({"keep": "all"}, "keep 'all': expected a tuple"),
    ({"image_size": "64"}, "image_size '64': expected a whole number"),
    ({"image_size": 7}, "image_size 7: expected 8 to 8192"),
    ({"image_size": 64.0}, "image_size 64.0"),
    ({"train_frames": 5}, "train_frames 5: expected a text"),
    ({"train_frames": "0:99999"}, "needs frame"),
    ({"test_frames": "5:1"}, "a stop above the start"),
    ({"occlusion": "curtain"}, "unknown occlusion 'curtain'"),
    ({"occlusion": 0.5}, "occlusion 0.5: expected"),
    ({"occlusion": {"share": 0.5}}, "occlusion 'share': .*known: rule, fraction, covers"),
    ({"occlusion": {"fraction": [0.1, 0.2]}}, "occlusion.fraction 0.1 0.2: expected one"),
    ({"occlusion": {"fraction": 2}}, "occlusion.fraction 2: expected 0 to 1"),
    ({"occlusion": {"covers": float("nan")}}, "occlusion.covers nan: expected 0 to 1"),
    ({"occlusion": {"rule": 5}}, "occlusion.rule 5"),
    ({"choices": {"image.edg": "soft"}}, "choices 'image.edg': did you mean 'image.edge'"),
    ({"choices": {"image.background": (0, 0, 2)}}, "choices.image.background 0 0 2: expected 0 to 1"),
    ({"brightnes": 0.5}, "did you mean 'brightness'"),
    ({"brightness": "bright"}, "--method.brightness 'bright': expected a number"),
    ({"brightness": float("nan")}, "--method.brightness nan"),
]


@pytest.mark.parametrize(("arguments", "said"), WRONG)
def test_a_wrong_argument_is_refused_before_anything_is_written(call, bench, arguments, said):
    with pytest.raises(BadInput, match=said) as refusal:
        call("run", **arguments)
    assert "\n" not in str(refusal.value)
    assert not bench.runs.exists()


SHARED = ("protocol", "profile", "data", "progress", "image_size", "train_frames", "test_frames", "occlusion")


@pytest.mark.parametrize("function", ["load_scene", "ablate", "score"])
@pytest.mark.parametrize(("arguments", "said"), [case for case in WRONG if next(iter(case[0])) in SHARED])
def test_the_other_functions_refuse_the_same(call, bench, tmp_path, function, arguments, said):
    predictions = tmp_path / "predictions"
    predictions.mkdir()
    more = {"ablate": {"vary": {"brightness": [0.1]}, "workers": 0}, "score": {"scene": "standin-1"}}.get(
        function, {}
    )
    with pytest.raises(BadInput, match=said):
        call(function, *([predictions] if function == "score" else []), **more | arguments)
    assert not bench.runs.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"vary": {"brightnes": [0.1]}}, "no such switch"),
        ({"vary": {"brightness": [0.1, 0.1]}}, "stands there twice"),
        ({"vary": {"brightness": []}}, "expected a value or more"),
        ({"vary": {"brightness": ["x"]}}, "--method.brightness 'x'"),
        ({"vary": ["brightness"]}, "vary .*: expected a mapping"),
        ({"vary": {"brightness": [0.1]}, "switches": {"brightness": 0.2}}, "leave one of the two out"),
        ({"vary": {"brightness": [0.1]}, "switches": {"colour": 0.2}}, "no switch 'colour'"),
        ({"vary": {"brightness": [0.1]}, "ladder": "table2"}, "expected one of the two"),
        ({"ladder": "table2"}, "registers no ladder"),
        ({"vary": {"brightness": [0.1]}, "seed": ()}, "expected one number or more"),
        ({"vary": {"brightness": [0.1]}, "seed": [0, 0]}, "stands there twice"),
        ({"vary": {"brightness": [0.1]}, "seed": [0, 2**40]}, "0 to 4294967295"),
        ({"vary": {"brightness": [0.1]}, "seed": True}, "seed True"),
        ({"vary": {"brightness": [0.1]}, "workers": -1}, "workers -1: expected 0 to 1024"),
        ({"vary": {"brightness": [0.1]}, "share": "yes"}, "share 'yes': expected True or False"),
    ],
)
def test_an_ablation_that_cannot_be_is_refused(call, bench, arguments, said):
    with pytest.raises(BadInput, match=said):
        call("ablate", **{"workers": 0} | arguments)
    assert not bench.runs.exists()


def test_numpys_numbers_lists_and_paths_as_text_are_taken(call, bench):
    result = call(
        "run", seed=np.int64(3), brightness=np.float32(0.25), image_size=np.int32(48), keep=["brightness"],
        runs=str(bench.runs), protocol=Path(bench.protocol),
    )  # fmt: skip
    identity = read_json(result.folder / "run.json")["identity"]
    assert (result.status, identity["seed"], identity["config"]["brightness"]) == ("done", 3, 0.25)
    assert identity["protocol"].endswith("+size=48")


def test_frames_occlusion_and_size_are_those_of_the_command_line(call, bench, mannequin):
    words = ("--train-frames", "0:300:100", "--test-frames", "0:300:150", "--image-size", "48", "--occlusion.rule",
             "central-band", "--occlusion.fraction", "0.3", "--occlusion.covers", "0.5", "--seed", "1",
             "--protocol.image.edge", "soft")  # fmt: skip
    assert bench.run(*words, method=mannequin).status == 0
    same = {
        "train_frames": "0:300:100", "test_frames": "0:300:150", "image_size": 48,
        "occlusion": {"rule": "central-band", "fraction": 0.3, "covers": 0.5}, "choices": {"image.edge": "soft"},
    }  # fmt: skip
    result = call("run", seed=1, **same)
    assert bench.folders() == [result.folder]  # found, not run again
    scene, _ = call("load_scene", **same)
    assert [view.frame for view in scene.train] == [0, 100, 200]
    assert scene.test[0].image.shape[0] == 48
    (scored,) = call("score", result.folder / "renders", scene="standin-1", name="theirs", profile="quick", **same)
    own = Identity.parse("psnr/pooled/range1/full/v1")
    assert scored.rows["theirs"][own].value == pytest.approx(result.rows[mannequin][own].value, abs=0.02)


def test_an_ablation_from_python_is_that_of_the_command_line(call, bench, mannequin, tmp_path, monkeypatch):
    words = ("--vary", "brightness=0.1:0.4", "--set", "seed-step=0.2", "--seed", "0", "--scene", "standin-1")
    base = ("ablate", "--protocol", bench.protocol, "--runs", bench.runs, "--method", mannequin, "--workers", "0")
    told = json.loads(bench(*base, *words, "--json").out)
    found = call(
        "ablate", scene="standin-1", vary={"brightness": [0.1, 0.4]}, switches={"seed_step": 0.2}, seed=0,
        workers=0, out=tmp_path / "out",
    )  # fmt: skip
    assert found.numbers == told == read_json(tmp_path / "out" / "ablation.json")
    assert len(bench.folders()) == len(found.results) == 2
    assert found.problems == []
    monkeypatch.setattr("own_method.method.Mannequin.fit", lambda *_, **__: [].pop())
    failed = call("ablate", scene="standin-1", vary={"brightness": [0.2]}, seed=0, workers=0)
    (problem,) = failed.problems
    assert "IndexError: pop from empty list" in problem
    assert str(failed.results[0].folder / "traceback.txt") in problem
    assert problem in failed.text.replace("\\", "")


@pytest.mark.parametrize(
    "wrong", [{"seed": [0, 1]}, {"seed": 2**64}, {"force": "no"}, {"keep": "all"}, {"runs": "x"}]
)
def test_no_request_is_made_of_what_no_function_takes(wrong):
    """Whoever calls the run loop itself comes by the same check."""
    with pytest.raises(BadInput, match=next(iter(wrong))):
        RunRequest(load_protocol("zju_occ"), "inpainthuman", None, **wrong)


def test_a_span_of_any_size_is_refused_before_it_is_listed(studio):
    """A list of 10^15 frames would take the memory of the machine."""
    protocol = load_protocol(str(studio.protocol)).with_fields({"train.frames": "0:1000000000000000"})
    with studio.in_its_world(), pytest.raises(BadInput, match="needs frame 999999999999999"):
        locate(protocol, None, ("standin-1",)).open("standin-1", None, QUIET)
