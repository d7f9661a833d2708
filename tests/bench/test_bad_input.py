"""Whatever is wrong: one line, status 2, nothing half-written, and what was finished before stays as it is."""

import os
import pickle
import resource
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ihbench.clock.ledger import Ledger
from ihbench.files import locks
from ihbench.files.atomic import read_json
from ihbench.record.results import read_result
from ihbench.record.store import RunFolder
from ihbench.scene import data_source
from tests.conftest import contents, tiny_protocol

SUBJECT = "CoreView_standin-1"


@pytest.fixture
def data(bench, tmp_path):
    """A copy of the stand-in that a test may spoil, to be given with --data."""
    with bench.in_its_world():
        source = data_source.standin_root("zju_mocap")
    leave = shutil.ignore_patterns("CoreView_standin-2", "mask_cihp", "new_vertices")
    return shutil.copytree(source, tmp_path / "data", ignore=leave)


def complaint(outcome):
    """The one line on stderr beside the lines that only tell how far the work is."""
    assert outcome.status == 2, outcome
    assert outcome.out == ""
    lines = [line for line in outcome.err.splitlines() if not line.startswith(("zju_occ@1", "stage 1"))]
    assert len(lines) == 1, lines
    assert lines[0].startswith("ihbench: ")
    return lines[0].removeprefix("ihbench: ")


@pytest.fixture
def refused(bench_with_run):
    """Run a command beside a finished run; its complaint, after looking at what it left behind."""

    def check(*words):
        runs = bench_with_run.runs
        before = contents(runs)
        line = complaint(bench_with_run(*words))
        after = contents(runs)
        assert {name: data for name, data in after.items() if name in before} == before
        new = {runs / name for name in after.keys() - before.keys()}
        assert {path.name for path in new} <= {"run.json", "lock"}
        for path in new:
            if path.name == "run.json":
                outcome = read_json(path)["outcome"]
                assert (outcome["status"], outcome["reason"]) == ("failed", line)
        return line

    check.bench = bench_with_run
    return check


@pytest.fixture
def refused_run(refused, data):
    """The same for a run on the spoilt data, with a seed that has no finished run yet."""

    def check(*words, **choice):
        return refused(*refused.bench.run_words("--data", data, "--seed", 7, *words, **choice))

    return check


def a_training_picture(data):
    return data / SUBJECT / "Camera_B1" / "000100.jpg"


def a_test_picture(data):
    return data / SUBJECT / "Camera_B17" / "000480.jpg"


def read_object(path):
    return np.load(path, allow_pickle=True).item()


def write_object(path, value):
    np.save(path, np.array(value, dtype=object), allow_pickle=True)


# ------------------------------------------------------------------------------------------------------- data


def test_the_copy_itself_is_good(bench, data, mannequin):
    """Otherwise every refusal below might have another cause."""
    assert bench.run("--data", data, method=mannequin).status == 0


def test_no_such_data_folder(refused, tmp_path):
    line = refused(*refused.bench.run_words("--data", tmp_path / "nowhere"))
    assert f"{tmp_path / 'nowhere'}: does not exist" in line
    assert "--data" in line


def test_a_data_folder_without_the_layout(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    line = refused(*refused.bench.run_words("--data", tmp_path / "empty"))
    assert f"{tmp_path / 'empty'}: no layout of zju_mocap (no subject of this layout in it" in line


@pytest.mark.parametrize("camera", ["Camera_B1", "Camera_B17"])
def test_a_missing_camera_folder(refused_run, data, camera):
    shutil.rmtree(data / SUBJECT / camera)
    assert f"{data / SUBJECT / camera}: no such folder" in refused_run()


@pytest.mark.parametrize("picture", [a_training_picture, a_test_picture])
def test_a_truncated_picture(refused_run, data, picture, mannequin):
    path = picture(data)
    path.write_bytes(path.read_bytes()[:5000])
    assert f"{path}: damaged or cut short" in refused_run(method=mannequin)


def test_a_mask_of_another_size_than_its_picture(refused_run, data):
    path = data / SUBJECT / "mask" / "Camera_B1" / "000100.png"
    Image.open(path).resize((512, 512)).save(path)
    line = refused_run()
    assert f"{path}: 512×512 px, but the camera's images are 1024×1024 px" in line


def test_annots_with_wrong_shapes(refused_run, data):
    path = data / SUBJECT / "annots.npy"
    annots = read_object(path)
    annots["cams"]["K"] = [K[:2] for K in annots["cams"]["K"]]
    write_object(path, annots)
    line = refused_run()
    assert line.startswith(f"{path}: expected cams['K']")
    assert line.endswith("found [2, 3]")


def test_nan_among_the_parameters(refused_run, data):
    path = data / SUBJECT / "new_params" / "100.npy"
    params = read_object(path)
    params["poses"][0, 5] = np.nan
    write_object(path, params)
    assert f"{path}: NaN or infinity in 'poses'" in refused_run()


@pytest.mark.parametrize("name", ["annots.npy", "new_params/100.npy"])
def test_a_hostile_pickle_is_refused_and_does_not_run(refused_run, data, tmp_path, name):
    class Payload:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "it-ran"),)

    path = data / SUBJECT / name
    write_object(path, {"cams": Payload(), "ims": [], "poses": Payload()})
    assert str(path) in refused_run()
    assert not (tmp_path / "it-ran").exists()
    pickle.loads(pickle.dumps(Payload()))  # the payload is a real one
    assert (tmp_path / "it-ran").exists()


def test_fewer_frames_than_the_protocol_reads(refused_run, data):
    path = data / SUBJECT / "annots.npy"
    annots = read_object(path)
    write_object(path, {**annots, "ims": annots["ims"][:450]})
    line = refused_run()
    assert "has 450 frames" in line
    assert "needs frame 480" in line


def test_everybody_hidden_in_every_frame(refused_run, refused, tmp_path, monkeypatch):
    from ihbench.methods.inpainthuman.stages.stage1 import Stage1

    monkeypatch.setattr(Stage1, "_one_step", lambda *_: pytest.fail("a step was made"))
    protocol = tiny_protocol(
        tmp_path / "blind.toml",
        ("covers = { fraction = 0.8", "covers = { fraction = 1.0"),
        ("[occlusion.strips]", '[occlusion.strips]\n"standin-1" = [512, 1024]\n'),
    )
    line = refused_run("--protocol", protocol)
    assert line == "scene standin-1: no training view shows a visible person pixel; nothing to fit"


# ------------------------------------------------------------------------------------------------------ words


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("runn --protocol zju_occ", "unknown command 'runn': did you mean 'run'?"),
        ("run --protocol zju_ocd", "unknown protocol 'zju_ocd': did you mean 'zju_occ'?"),
        ("run --protocol zju_occ --method inpainthumann", "did you mean 'inpainthuman'?"),
        ("run --protocol zju_occ --scene standin-0", "unknown scene 'standin-0'"),
        ("run --protocol zju_occ --profile quik", "did you mean 'quick'?"),
        ("run --protocol zju_occ --occlusion.rule fixed-stripe", "did you mean 'fixed-strip'?"),
        ("run --protocol zju_occ --keep level", "did you mean 'levels'?"),
        ("run --protocol zju_occ --sede 3", "Perhaps you meant: --seed"),
        ("run --protocol zju_occ --seed three", "Error parsing --seed"),
        ("run --protocol zju_occ --seed", "--seed"),
        ("run --protocol zju_occ --seed -1", "--seed -1: expected"),
        ("run --protocol zju_occ --method.stepps 3", "Perhaps you meant: --method.steps"),
        ("run", "--protocol STR"),
        (
            "run --protocol nowhere.toml",
            "nowhere.toml: cannot be opened (No such file or directory)",
        ),
        ("plan --protocol zju_occ --profile quik", "did you mean 'quick'?"),
        ("plan --protocol zju_occ --method nobody", "unknown method 'nobody'"),
        ("protocol show zju_ocd", "did you mean 'zju_occ'?"),
        ("report --format mdd", "did you mean 'md'?"),
        ("data check nowhere", "data folder nowhere: does not exist"),
        ("data standin --out x --subjects 0", "--subjects 0: expected 1 to 99"),
        ("data standin --out x --dataset peeple", "zju_mocap"),
    ],
)
def test_a_wrong_word_is_answered_with_the_right_one(refused, words, told):
    words = words.split()
    if words[0] in ("run", "report"):
        words += ["--runs", str(refused.bench.runs)]
    assert told in refused(*words)


def test_json_stays_one_object_when_the_input_is_bad(bench):
    import json

    for words in ("run --protocol zju_ocd --json", "run --protocol zju_occ --json --sede 3"):
        outcome = bench(*words.split())
        assert outcome.status == 2
        assert json.loads(outcome.out) == {"status": "bad input", "error": outcome.err.strip()[len("ihbench: ") :]}


# ------------------------------------------------------------------------------------------------- run folders


def test_a_report_without_runs(bench):
    assert f"no run folders under {bench.runs}" in complaint(bench("report", "--runs", bench.runs))
    line = complaint(bench("report", bench.runs / "one"))
    assert f"{bench.runs / 'one'}: not a run folder" in line


def test_an_export_of_a_run_without_an_avatar(bench, broken_mannequin):
    assert bench.run(method=broken_mannequin).status == 1
    (folder,) = bench.folders()
    assert complaint(bench("export", folder)) == f"{folder}: has no avatar (status failed); finish the run first"
    assert not list(folder.glob("*.ply"))


@pytest.mark.parametrize("pose", ["a_poze", "810"])
def test_an_export_in_a_pose_nobody_knows(refused, finished, pose):
    folder = refused.bench.folders()[0]
    assert pose in refused("export", folder, "--pose", pose)


def test_a_run_that_another_process_is_writing(bench_with_run, monkeypatch):
    monkeypatch.setattr(locks, "WAIT", 0.2)
    (folder,) = bench_with_run.folders()
    with RunFolder.open(folder).lock():
        assert f"{folder}: being written by process {os.getpid()}" in complaint(bench_with_run.run("--force"))
        assert bench_with_run.run().status == 0  # found: it needs no writing


def test_a_done_run_whose_scores_were_lost(bench_with_run):
    (folder,) = bench_with_run.folders()
    (folder / "scores.jsonl").unlink()
    for words in (bench_with_run.run_words(), ["report", folder]):
        assert complaint(bench_with_run(*words)).endswith("run the same command with --force")


# --------------------------------------------------------------------------------------------------- disk full


FULL = Path("/dev/full")


@contextmanager
def disk_full_for(part, monkeypatch):
    """Every file with `part` in its path lies on a device that is full."""

    write = Path.write_bytes
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", lambda self, data: write(FULL if part in str(self) else self, data))
        yield


@pytest.mark.usefixtures("mannequin")
@pytest.mark.parametrize(
    ("part", "method"),
    [
        ("checkpoints", "inpainthuman"),
        ("avatar.json", "inpainthuman"),
        ("renders", "mannequin"),
        ("calibration", "mannequin"),
        ("scores.jsonl", "mannequin"),
        ("contact_sheet", "mannequin"),
    ],
)
def test_a_full_disk_ends_the_run_in_one_line_and_the_same_command_continues(bench, part, method, monkeypatch):
    with disk_full_for(part, monkeypatch):
        line = complaint(bench.run(method=method))
    assert line.startswith("disk full while writing ")
    assert part in line
    (folder,) = bench.folders()
    assert read_result(folder).status == "failed"
    assert not any(name.endswith((".tmp", ".part")) for name in contents(bench.runs))
    assert bench.run(method=method).status == 0
    assert read_result(folder).status == "done"


def test_a_full_disk_from_the_start_leaves_no_record(bench, monkeypatch):
    with disk_full_for("run.json", monkeypatch):
        assert complaint(bench.run()).startswith("disk full while writing ")
    assert contents(bench.runs) == {}


def test_an_avatar_that_is_too_large_for_the_disk(bench, finished, monkeypatch):
    """The avatar's tensors may be written by another library than everything else."""
    assert (finished.folder / "avatar" / "avatar.safetensors").stat().st_size > 30_000
    monkeypatch.setattr(Ledger, "save_state", lambda *_: None)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, hard))
    try:
        outcome = bench.run("--method.steps", 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "avatar" in complaint(outcome)
    assert not any(name.endswith((".tmp", ".part")) for name in contents(bench.runs))


# ------------------------------------------------------------------------- refused before a folder is made


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--train-frames 1000000:", "selects no training frame"),
        ("--train-frames 0:100000000000:1", "needs frame 99999999999 (training)"),
        ("--test-frames 0:1000:100", "needs frame 900 (test)"),
        ("--test-frames 5000:6000:10", "needs frame 5990 (test)"),
        ("--train-frames -5:10", "numbers from 0"),
        ("--train-frames 0:10:0", "numbers from 0"),
        ("--train-frames 10:5", "a stop above the start"),
        ("--train-frames 0:0", "a stop above the start"),
        ("--train-frames ٣:٩", "numbers from 0"),
        ("--train-frames 0:1_0", "numbers from 0"),
        ("--train-frames 5", "START:STOP:STEP"),
        ("--seed 4294967296", "0 to 4294967295"),
        ("--seed 9223372036854775808", "0 to 4294967295"),
        ("--seed -1", "0 to 4294967295"),
        ("--seed 0 1 0", "stands there twice"),
        ("--seed", "expected"),
        ("--keep", "expected one value or more"),
        ("--scene standin-1 standin-1", "stands there twice"),
        ("--occlusion.fraction 0.5 0.50", "stands there twice"),
        ("--occlusion.fraction", "expected one value or more"),
    ],
)
def test_no_folder_is_made_for_what_cannot_be(bench, mannequin, words, said):
    line = complaint(bench.run(*words.split(), method=mannequin))
    assert said in line
    assert not bench.runs.exists()


@pytest.mark.parametrize(
    "train", ["{ start = 6000, stop = 7000, step = 1 }", "{ start = 900, stop = 'max_frames', step = 1 }"]
)
def test_a_protocol_file_with_frames_beyond_the_capture_makes_no_folder(bench, mannequin, tmp_path, train):
    text = tiny_protocol(tmp_path / "mine.toml").read_text()
    (tmp_path / "mine.toml").write_text(
        text.replace("train = { frames = { step = 100 } }", f"train = {{ frames = {train} }}")
    )
    outcome = bench("run", "--protocol", tmp_path / "mine.toml", "--runs", bench.runs, "--method", mannequin)
    assert "training" in complaint(outcome)
    assert not bench.runs.exists()
    for command in (("plan", "--method", mannequin), ("prepare", "--profile", "quick", "--out", tmp_path / "out")):
        assert bench(*command, "--protocol", tmp_path / "mine.toml").status == 2
    assert not (tmp_path / "out").exists()


def test_a_rule_that_does_not_fit_the_data_makes_no_folder(bench, mannequin, monkeypatch):
    from ihbench.scene import occlusion

    def wrong(request):
        raise occlusion.BadInput("the strip is wider than the image")

    monkeypatch.setattr(
        occlusion.registry,
        "load",
        lambda kind, name, load=occlusion.registry.load: wrong if kind == "occlusion" else load(kind, name),
    )
    assert "wider than the image" in complaint(bench.run(method=mannequin))
    assert not bench.runs.exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--vary brightness=0.5:0.5", "stands there twice"),
        ("--vary brightness=0.5:0.50", "stands there twice"),
        ("--vary brightness=0.1 brightness=0.2", "stands there twice"),
        ("--vary brightness=0.1:0.2 --set brightness=0.3", "leave one of the two out"),
        ("--vary brightness=0.1:0.2 --set seed-step=1 seed_step=2", "stands there twice"),
        ("--vary =1", "expected NAME=VALUE"),
        ("--vary brightness=", "expected NAME=VALUE"),
        ("--vary brightness=0.1:", "expected a number"),
        ("--vary brightness=０.１:0.2", "expected a number"),
        ("--vary", "expected one value or more"),
        ("--vary brightness=0.1:0.2 --set", "expected one value or more"),
        ("--vary brightness=0.1:0.2 --seed 1 1", "stands there twice"),
        ("--vary brightness=0.1:0.2 --seed 99999999999", "0 to 4294967295"),
        ("--vary brightness=0.1:0.2 --keep", "expected one value or more"),
    ],
)
def test_a_grid_with_slips_runs_nothing(bench, mannequin, words, said):
    line = complaint(
        bench("ablate", "--protocol", bench.protocol, "--runs", bench.runs, "--method", mannequin, *words.split())
    )
    assert said in line
    assert not bench.runs.exists()
