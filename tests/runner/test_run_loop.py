"""`ihbench run` from the command line to the run folder."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

import ihbench
from ihbench.clock.progress import Progress
from ihbench.files import atomic
from ihbench.files.atomic import read_json, read_json_lines
from ihbench.methods.inpainthuman.config import QUICK
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.metrics import psnr
from ihbench.record.results import read_result
from ihbench.runner import run_loop
from ihbench.scene.contracts import MaskState
from ihbench.scene.data_source import locate
from ihbench.scene.protocol import load_protocol
from ihbench.scene.views import open_scene
from ihbench.scoring.calibration import ROWS, Calibration
from tests.conftest import contents

SWITCHES = {
    "precision": "float32",
    "texels": 32,
    "levels": (16, 256),
    "decoder_width": 32,
    "position_map": 16,
    "steps": 8,
    "inpaint.on": False,
}
VIEWS = 4  # test views of the tiny protocol


def by_view(folder):
    """Every per-view score of a run's own row, to the last bit."""
    return {(row["camera"], row["frame"]): row["scores"] for row in read_json_lines(folder / "scores.jsonl")}


def means(folder, row="inpainthuman"):
    return {str(identity): mean.value for identity, mean in read_result(folder).rows[row].items()}


@pytest.fixture
def no_fit(monkeypatch):
    """Fitting is an error from here on."""

    def fit(*_, **__):
        raise AssertionError("fitted again")

    monkeypatch.setattr(InpaintHuman, "fit", fit)


# ------------------------------------------------------------------------------------------ what is left behind


def test_a_run_ends_with_a_table_that_says_stand_in_and_with_a_complete_folder(finished):
    assert finished.outcome.status == 0
    assert "stand-in v2 seed 0" in finished.outcome.out
    assert "| inpainthuman" in finished.outcome.out
    assert str(finished.folder / "contact_sheet.png") in finished.outcome.out
    files = {name for name in contents(finished.folder) if not name.startswith("renders/")}
    assert files == {
        "run.json",
        "scores.jsonl",
        "calibration.jsonl",
        "curve.jsonl",
        "contact_sheet.png",
        "avatar/avatar.json",
        "avatar/avatar.safetensors",
        "checkpoints/stage1.safetensors",
        "lock",
    }
    assert len(list((finished.folder / "renders").rglob("*.png"))) == VIEWS == len(by_view(finished.folder))
    sheet = np.asarray(Image.open(finished.folder / "contact_sheet.png"))
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 100


def test_progress_goes_to_stderr_and_not_to_stdout(finished):
    assert "zju_occ@1 standin-1" in finished.outcome.err
    assert finished.outcome.out.startswith("## zju_occ@1")


def test_the_numbers_are_those_of_the_pictures(finished, studio):
    """PSNR of the renders on disk against the truth, region `full`: what scores.jsonl says, up to 8 bits."""
    protocol = load_protocol(str(studio.protocol))
    with studio.in_its_world():
        capture, _ = locate(protocol, None, ("standin-1",)).open("standin-1", None, Progress.silent())
        views = {(view.camera_id, view.frame): view.image for view in open_scene(capture, protocol).test}
    scores = by_view(finished.folder)
    assert views.keys() == scores.keys()
    for (camera, frame), truth in views.items():
        picture = Image.open(finished.folder / "renders" / camera / f"{frame:06d}.png")
        here = psnr(np.asarray(picture, np.float32) / 255, truth)
        assert here == pytest.approx(scores[camera, frame]["psnr/pooled/range1/full/v1"], abs=0.02)


def test_truth_is_perfect_and_nothing_else_is(finished):
    perfect = {"psnr": math.inf, "ssim": 1.0, "flip": 0.0}
    rows = read_result(finished.folder).rows
    assert set(rows) == {"inpainthuman", *ROWS}
    for identity, mean in rows["truth"].items():
        if identity.metric == "lpips":
            assert "ihbench weights fetch lpips-vgg" in mean.reason or "region" in mean.reason
            continue
        assert mean.value == pytest.approx(perfect[identity.metric], abs=1e-12)
        for row in set(rows) - {"truth", "truth-8bit"}:
            worse = rows[row][identity].value - mean.value
            assert worse > 0 if identity.metric == "flip" else worse < 0


def test_stages_add_up_to_the_wall_clock(finished):
    record = read_json(finished.folder / "run.json")
    books = record["ledger"]
    top = {path: stage["seconds"] for path, stage in books["stages"].items() if "/" not in path}
    assert {"occlude", "load", "plan", "visibility", "fit", "evaluate", "score"} <= set(top)
    assert record["about"]["fit_seconds"] == pytest.approx(top["fit"])
    assert 0.5 * books["seconds"] < sum(top.values()) <= books["seconds"] * (1 + 1e-9)  # the rest is in no stage


def test_the_curve_ends_at_the_score(finished):
    """The tiny protocol has fewer test views than the curve uses, so its last point must be the result."""
    *_, last = read_json_lines(finished.folder / "curve.jsonl")
    assert last["step"] == SWITCHES["steps"]
    assert last["views"] == VIEWS
    quick = {identity: v for identity, v in means(finished.folder).items() if not identity.startswith("lpips")}
    assert last["scores"] == quick
    assert last["seconds"] <= read_json(finished.folder / "run.json")["about"]["fit_seconds"]


def test_json_is_one_object_and_nothing_else(bench_with_run, finished):
    outcome = bench_with_run.run("--json")
    (line,) = outcome.out.splitlines()
    told = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is not strict JSON"))
    assert (outcome.status, told["status"]) == (0, "done")
    (run,) = told["runs"]
    assert run["standin"] == "stand-in v2 seed 0"
    assert run["scores"]["inpainthuman"] == atomic.encode(means(finished.folder))
    assert run["scores"]["truth"]["psnr/pooled/range1/full/v1"] == "inf"


# --------------------------------------------------------------------------------------------- the same run


@pytest.mark.usefixtures("no_fit")
def test_the_same_run_is_found_and_its_folder_left_alone(bench_with_run, finished):
    outcome = bench_with_run.run()
    assert outcome.status == 0
    assert [folder.name for folder in bench_with_run.folders()] == [finished.folder.name]
    assert contents(bench_with_run.folders()[0]) == contents(finished.folder)
    row = next(line for line in finished.outcome.out.splitlines() if "inpainthuman" in line)
    assert row in outcome.out.splitlines()


@pytest.mark.usefixtures("no_fit")
def test_a_notebook_finds_the_run_of_the_command_line(bench_with_run, finished):
    with bench_with_run.in_its_world():
        protocol, runs = str(bench_with_run.protocol), bench_with_run.runs
        result = ihbench.run(protocol, "standin-1", runs=runs, progress=Progress.silent(), **SWITCHES)
    assert result.folder.name == finished.folder.name


def test_force_repeats_the_run_bit_for_bit(bench_with_run, finished, monkeypatch):
    fitted = []
    fit = InpaintHuman.fit
    monkeypatch.setattr(InpaintHuman, "fit", lambda self, *a, **k: fitted.append(1) or fit(self, *a, **k))
    assert bench_with_run.run("--force").status == 0
    (folder,) = bench_with_run.folders()
    assert fitted
    assert by_view(folder) == by_view(finished.folder)
    again, before = contents(folder), contents(finished.folder)
    assert again["avatar/avatar.safetensors"] == before["avatar/avatar.safetensors"]
    assert {n for n in again if n.startswith("renders/") and again[n] != before[n]} == set()


@pytest.mark.parametrize("change", ["--seed 1", "--method.steps 3", "--occlusion.rule none"])
def test_what_moves_the_answer_makes_another_run(bench_with_run, finished, change):
    assert bench_with_run.run(*change.split()).status == 0
    (other,) = {folder.name for folder in bench_with_run.folders()} - {finished.folder.name}
    other = bench_with_run.runs / other
    assert contents(bench_with_run.runs / finished.folder.name) == contents(finished.folder)
    assert by_view(other).keys() == by_view(finished.folder).keys()
    assert all(by_view(other)[view] != scores for view, scores in by_view(finished.folder).items())
    theirs, ours = (read_json(folder / "run.json")["identity"] for folder in (other, finished.folder))
    assert (theirs["protocol_digest"] != ours["protocol_digest"]) == ("--occlusion" in change)


def test_every_seed_is_a_run_of_its_own(bench, mannequin):
    outcome = bench.run("--seed", 0, 1, method=mannequin)
    assert outcome.status == 0
    assert [read_json(folder / "run.json")["identity"]["seed"] for folder in bench.folders()] == [0, 1]
    assert "| mannequin | 1 | 0, 1 |" in outcome.out


def test_a_method_is_told_the_frame_of_a_pose_that_it_was_trained_on(bench, mannequin, monkeypatch):
    assert bench("list", "methods").status == 0  # imports it
    from own_method.method import MannequinAvatar

    told, render = set(), MannequinAvatar.render
    monkeypatch.setattr(MannequinAvatar, "render", lambda *words: told.add(words[-1]) or render(*words))
    assert bench.run("--test-frames", "0:75:50", method=mannequin).status == 0
    assert told == {0, None}


def test_calibration_is_computed_once_for_all_methods_and_seeds(bench_with_run, mannequin, monkeypatch):
    assert bench_with_run.run(method=mannequin).status == 0
    monkeypatch.setattr(Calibration, "build", lambda *_: pytest.fail("computed again"))
    assert bench_with_run.run("--seed", 1, method=mannequin).status == 0
    rows = {(folder / "calibration.jsonl").read_bytes() for folder in bench_with_run.folders()}
    assert len(bench_with_run.folders()) == 3
    assert len(rows) == 1


def test_force_and_damage_compute_the_calibration_again(bench, mannequin):
    assert bench.run(method=mannequin).status == 0
    (folder,), (shared,) = bench.folders(), (bench.runs / "calibration").iterdir()
    before = (folder / "calibration.jsonl").read_bytes()
    lines = before.splitlines(keepends=True)
    for seed, damage in enumerate((before[: len(before) // 2], b"".join(lines[:-1]), b"", before * 2), 1):
        shared.write_bytes(damage)
        assert bench.run("--seed", seed, method=mannequin).status == 0
        assert shared.read_bytes() == before
    shared.write_bytes(before.replace(b"inf", b"9.0"))
    assert bench.run("--force", method=mannequin).status == 0
    assert (folder / "calibration.jsonl").read_bytes() == shared.read_bytes() == before


def test_the_headline_comes_first_in_80_columns_then_the_picture(bench, mannequin):
    words = [word for word in bench.run_words(method=mannequin) if word != "--full"]
    lines = bench(*words).out.splitlines()
    assert lines[0].startswith("zju_occ@1, quick profile, stand-in v2")
    assert lines[2].split()[:3] == ["region", "body", "PSNR"]
    assert lines[4].split()[0] == "mannequin"
    (folder,) = bench.folders()
    assert f"contact sheet: {folder / 'contact_sheet.png'}" in lines
    assert [line for line in lines if len(line) > 80 and not line.startswith("contact sheet: ")] == []
    assert "\x1b" not in "".join(lines)


# ------------------------------------------------------------------------- occlusion, and what the plan leaves out


def test_only_occluded_frames_have_unknown_pixels_and_none_without_an_occluder(studio):
    protocol = load_protocol(str(studio.protocol))
    with studio.in_its_world():
        capture, _ = locate(protocol, None, ("standin-1",)).open("standin-1", None, Progress.silent())
    unknown = {
        rule.occlusion.rule: [bool((v.mask == MaskState.UNKNOWN).any()) for v in open_scene(capture, rule).train]
        for rule in (protocol, protocol.with_fields({"occlusion.rule": "none"}))
    }
    assert unknown == {"fixed-strip": [True] * 4 + [False], "none": [False] * 5}


def test_without_an_occluder_no_surface_is_hidden_and_the_table_says_why(bench, mannequin):
    outcome = bench.run("--occlusion.rule", "none", method=mannequin)
    (folder,) = bench.folders()
    about = read_json(folder / "run.json")["about"]
    assert about["measure"]["hidden_texels"] == about["hidden_share"] == 0
    assert [o["field"] for o in about["left_out"]] == ["hidden"]
    assert math.isnan(means(folder, "mannequin")["psnr/pooled/range1/hidden/v1"])
    assert (
        "left out by the plan, mannequin on standin-1: hidden → None: every texel that faced the training camera"
        in outcome.out
    )


def run_with_the_profiles_levels(bench, *more):
    """One step of a fit whose levels nobody has set."""
    words = bench.run_words("--method.steps", 1, *more)
    at = words.index("--method.levels")
    del words[at : at + 3]
    outcome = bench(*words)
    (folder,) = bench.folders()
    levels = read_json(folder / "avatar" / "avatar.json")["config"]["levels"]
    return outcome, read_json(folder / "run.json")["about"]["left_out"], levels


def test_the_plan_leaves_out_what_the_scene_cannot_use_and_says_so(bench):
    outcome, (omission,), levels = run_with_the_profiles_levels(bench)
    assert (omission["field"], omission["value"]) == ("levels", levels)
    assert 0 < len(levels) < len(QUICK.levels)
    assert f"on standin-1: levels → {levels}: {omission['reason']}" in outcome.out


def test_the_plan_leaves_alone_what_somebody_has_set(finished):
    """The finished run names its levels, of which the second is finer than its images."""
    assert read_json(finished.folder / "run.json")["about"]["left_out"] == []
    assert read_json(finished.folder / "avatar" / "avatar.json")["config"]["levels"] == [16, 256]


def test_drawing_is_timed_for_every_test_view_and_the_median_is_kept(bench, mannequin, monkeypatch):
    """By a clock that only the avatar moves."""
    from own_method.method import MannequinAvatar

    now, took = [0.0], iter([0.001, 0.009, 0.002, 0.004])
    draw = MannequinAvatar.render

    def slow(self, camera, body_pose, background, frame):
        now[0] += next(took, 0.0)
        return draw(self, camera, body_pose, background, frame)

    monkeypatch.setattr(MannequinAvatar, "render", slow)
    monkeypatch.setattr("ihbench.clock.ledger.Ledger.offer", lambda *_, **__: None)  # the curve draws, too
    monkeypatch.setattr(run_loop, "time", SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 0.0))
    outcome = bench.run("--json", method=mannequin)
    assert outcome.status == 0
    (folder,) = bench.folders()
    assert read_json(folder / "run.json")["about"]["render_ms"] == 3.0
    assert json.loads(outcome.out)["runs"][0]["render_ms"] == 3.0


@pytest.mark.parametrize("kept", ["levels", "all"])
def test_keep_holds_the_plan_back(bench, kept):
    outcome, left_out, levels = run_with_the_profiles_levels(bench, "--keep", kept)
    assert left_out == []
    assert levels == list(QUICK.levels)
    assert "keep=levels" in outcome.out
