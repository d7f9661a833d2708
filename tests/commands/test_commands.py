"""The commands beside `run`: plan, report, export, data, and what they say about a finished run."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from ihbench.files.atomic import read_json, read_json_lines
from ihbench.metrics import Identity
from ihbench.record.results import read_result
from ihbench.scene.data_source import standin_root
from tests.conftest import contents, tiny_protocol

BODY_PSNR = "psnr/pooled/range1/body/v1"


def table_row(text, label, metric="PSNR"):
    """The cells of a row in a metric's Markdown table, by column head."""
    (part,) = [
        part for part in text.split("### ")[1:] if part.startswith(f"{metric} ") and "interval" not in part[:99]
    ]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in part.splitlines() if line[:1] == "|"]
    (found,) = [row for row in rows if row[0].startswith(label)]
    return dict(zip(rows[0], found, strict=True))


# ------------------------------------------------------------------------------------------------------- plan


def test_plan_says_what_a_run_would_measure_and_leave_out(bench_with_run, finished):
    words = ["plan", "--protocol", bench_with_run.protocol, "--runs", bench_with_run.runs]
    plain = bench_with_run(*words, "--scene", "standin-1")
    told = json.loads(bench_with_run(*words, "--scene", "standin-1", "--json").out)
    about = read_json(finished.folder / "run.json")["about"]
    assert told["scenes"]["standin-1"]["measure"] == about["measure"]
    assert told["expected_seconds_per_scene"] == about["total_seconds"]
    assert "5 training views (4 occluded), 4 test views" in plain.out
    assert re.search(r"^  occlusion strip-generic \(mid \d+, width \d+\): hides ", plain.out, re.M)
    left_out = told["scenes"]["standin-1"]["left_out"]
    assert [omission["field"] for omission in left_out] == ["levels", "texels", "inpaint.ti", "inpaint.facing"]
    levels, texels, *_ = left_out
    assert f"left out: levels -> ({levels['value'][0]},): {levels['reason']}" in plain.out
    assert f"left out: texels -> {texels['value']}: {texels['reason']} (saves about" in plain.out
    assert "--keep FIELD" in plain.out
    assert (plain.status, plain.err) == (0, "")
    assert contents(bench_with_run.runs / finished.folder.name) == contents(finished.folder)


def test_plan_imports_neither_torch_nor_cv2(bench):
    words = ["plan", "--protocol", str(bench.protocol), "--scene", "standin-1"]
    code = (
        "import sys\nfrom ihbench.cli import main\n"
        f"status = main({words!r})\nprint(status, sorted({{'torch', 'cv2'}} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], env=bench.environment, capture_output=True, text=True)
    assert "left out: levels" in done.stdout
    assert done.stdout.splitlines()[-1] == "0 []", done.stderr


def test_plan_says_which_stand_ins_are_not_made_yet(bench, tmp_path):
    scenes = json.loads(bench("plan", "--protocol", bench.protocol, "--json").out)["scenes"]
    assert [name for name, found in scenes.items() if "measure" in found] == ["standin-1", "standin-2"]
    assert all("the run makes it" in scenes[f"standin-{k}"]["note"] for k in (3, 4, 5, 6))

    other = tiny_protocol(tmp_path / "other.toml", ("train = { frames = { step = 100 } }", ""))
    outcome = bench("plan", "--protocol", other, "--scene", "standin-1")
    assert outcome.status == 0
    assert "the run makes the rest of this stand-in" in outcome.out


# ------------------------------------------------------------------------------------------------------ report


def test_two_scenes_share_a_row_whose_number_is_the_mean_of_the_scenes_means(bench, mannequin):
    for scene in ("standin-1", "standin-2"):
        assert bench.run(scene=scene, method=mannequin).status == 0
    of_views = [
        np.mean([row["scores"][BODY_PSNR] for row in read_json_lines(folder / "scores.jsonl")])
        for folder in bench.folders()
    ]
    assert abs(of_views[0] - of_views[1]) > 0.02
    outcome = bench("report", "--runs", bench.runs)
    assert outcome.status == 0
    assert outcome.out.count("\n## ") + outcome.out.startswith("## ") == 1
    assert "### body: mean over scenes and 95% interval" in outcome.out
    cells = table_row(outcome.out, "mannequin")
    assert cells["scenes"] == "2"
    assert cells["**body**"] == f"{np.mean(of_views):.2f}"
    assert table_row(outcome.out, "*truth*")["scenes"] == "2"


def test_runs_under_other_occlusion_stand_in_another_table(bench, mannequin):
    for more in ((), ("--occlusion.rule", "none")):
        assert bench.run(*more, method=mannequin).status == 0
    text = bench("report", "--runs", bench.runs).out
    parts = {part.splitlines()[0].removeprefix("## "): part for part in text.split("\n\n## ")}
    assert [*parts] == [
        "zju_occ@1, quick profile",
        "zju_occ@1+occlusion=none, quick profile",
        *[name for name in parts if "occlusion costs" in name],
    ]
    for part in [*parts.values()][:2]:
        assert part.split("### Error against run time")[0].count("| mannequin |") == 3  # PSNR, SSIM, FLIP


def test_a_report_can_name_its_runs_and_its_file(bench_with_run, mannequin, tmp_path):
    assert bench_with_run.run(method=mannequin).status == 0
    chosen = next(folder for folder in bench_with_run.folders() if "mannequin" in folder.name)
    outcome = bench_with_run("report", chosen, "--out", tmp_path / "table.md")
    assert (outcome.status, outcome.out) == (0, "")
    text = (tmp_path / "table.md").read_text(encoding="utf-8")
    assert "| mannequin |" in text
    assert "| inpainthuman" not in text


def test_a_report_can_be_narrowed_to_what_matches(bench_with_run, mannequin):
    assert bench_with_run.run(method=mannequin).status == 0

    def methods(*filters):
        outcome = bench_with_run("report", "--runs", bench_with_run.runs, *filters)
        return [name for name in ("inpainthuman", "mannequin") if f"| {name}" in outcome.out]

    assert methods() == ["inpainthuman", "mannequin"]
    assert methods("--method", "mannequin") == ["mannequin"]
    assert methods("--protocol", "zju_occ", "--scene", "standin-1") == ["inpainthuman", "mannequin"]
    outcome = bench_with_run("report", "--runs", bench_with_run.runs, "--scene", "nobody")
    assert outcome.status == 2
    assert "no run folders under" in outcome.err


def test_a_report_has_three_formats_and_draws_its_figures(bench_with_run, tmp_path):
    figures, out = tmp_path / "figures", tmp_path / "report.tex"
    words = ("report", "--runs", bench_with_run.runs, "--target", "psnr=5", "flip/hidden=0.9")
    assert bench_with_run(*words, "--format", "tex", "--out", out, "--figures", figures).status == 0
    names = {file.name for file in figures.iterdir() if not file.name.startswith(".")}
    assert names == {f"{kind}_zju_occ@1_quick.{end}" for kind in ("work-precision", "quality-time")
                     for end in ("png", "svg", "csv")}  # fmt: skip
    assert r"\detokenize{figures/work-precision_zju_occ@1_quick.png}" in out.read_text()
    page = bench_with_run(*words, "--format", "html").out
    assert page.startswith("<!DOCTYPE html>")
    assert page.count("data:image/png") == 3  # two diagrams and the contact sheet
    table = bench_with_run(*words, "--figures", figures).out
    assert "| method | PSNR ≥ 5 dB | FLIP hidden ≤ 0.9 |" in table
    assert "work-precision_zju_occ@1_quick.png>)" in table
    refused = bench_with_run("report", "--runs", bench_with_run.runs, "--target", "speed=3")
    assert refused.status == 2
    assert "--target speed=3: expected METRIC=NUMBER" in refused.err


def test_a_damaged_run_does_not_take_the_others_with_it(bench_with_run, finished):
    damaged = bench_with_run.runs / "damaged"
    for name, spoil in {
        "cut": lambda folder: (folder / "run.json").write_text('{"schema_version": 1, "sta'),
        "foreign": lambda folder: (folder / "run.json").write_text('{"schema_version": 1}'),
        "lost": lambda folder: (folder / "scores.jsonl").unlink(),
    }.items():
        folder = damaged.with_name(name)
        shutil.copytree(finished.folder, folder)
        spoil(folder)
    outcome = bench_with_run("report", "--runs", bench_with_run.runs)
    assert outcome.status == 0
    assert outcome.out.split("### Error against run time")[0].count("| inpainthuman") == 3  # PSNR, SSIM, FLIP
    assert table_row(outcome.out, "inpainthuman")["scenes"] == "1"
    lines = outcome.err.splitlines()
    assert [line.startswith("ihbench: left out: ") for line in lines] == [True] * 3
    assert all(any(f"/{name}" in line for line in lines) for name in ("cut", "foreign", "lost"))


# -------------------------------------------------------------------------------------------------------- data


def test_a_stand_in_written_on_request_passes_the_check_and_runs(bench, tmp_path, mannequin):
    protocol = tiny_protocol(tmp_path / "two.toml", ("step = 8", "step = 16"), ("step = 100", "step = 250"))
    words = ["--profile", "quick", "--protocol", protocol]
    outcome = bench("data", "standin", "--out", tmp_path / "cast", "--seed", 3, *words)
    assert outcome.status == 0
    assert outcome.out.splitlines() == [
        f"standin-1 (seed 3) written to {tmp_path / 'cast'}; run with --data {tmp_path / 'cast'}"
    ]
    words_of_check = ["data", "check", tmp_path / "cast", "--overlays", tmp_path / "seen"]
    check = bench(*words_of_check, "--json")
    told = json.loads(check.out)
    assert (check.status, told["ok"], told["standin"]) == (0, True, "stand-in v2 seed 3")
    assert "standin: stand-in v2 seed 3" in bench(*words_of_check).out
    run = bench.run(*words, "--data", tmp_path / "cast", method=mannequin)
    assert run.status == 0
    assert "**stand-in v2 seed 3**" in run.out


def copy_of_one_person(bench, folder: Path) -> Path:
    """The stand-in without its first person: a check takes half as long."""
    with bench.in_its_world():
        root = standin_root("zju_mocap")
    return shutil.copytree(root, folder, ignore=shutil.ignore_patterns("CoreView_standin-[!2]"))


def test_data_check_names_what_is_wrong_and_returns_1(bench, tmp_path):
    copy = copy_of_one_person(bench, tmp_path / "copy")
    picture = copy / "CoreView_standin-2" / "Camera_B1" / "000000.jpg"
    picture.write_bytes(picture.read_bytes()[:3000])
    before = contents(copy)
    outcome = bench("data", "check", copy, "--overlays", tmp_path / "seen")
    assert outcome.status == 1
    assert f"{picture}: damaged or cut short" in outcome.out
    assert contents(copy) == before


def test_data_check_does_without_a_picture_where_none_may_be_written(bench, tmp_path, monkeypatch):
    copy = copy_of_one_person(bench, tmp_path / "copy")
    before = contents(copy)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "data_check").touch()
    for place, reason in (("copy", "the current folder is in the data folder"), ("elsewhere", "a file stands where")):
        monkeypatch.chdir(tmp_path / place)
        outcome = bench("data", "check", copy)
        assert outcome.status == 0, outcome
        assert f"overlay: none: {reason}" in outcome.out
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    outcome = bench("data", "check", copy)
    assert (outcome.status, "overlay: none: the current folder is gone" in outcome.out) == (0, True), outcome
    outcome = bench("data", "check", ".")
    assert (outcome.status, outcome.err.count("\n")) == (2, 1)
    monkeypatch.chdir(tmp_path)
    assert contents(copy) == before
    monkeypatch.setenv("SOMEWHERE", str(tmp_path))
    assert bench("data", "check", "$SOMEWHERE/copy/", "--overlays", tmp_path / "seen").status == 0
    for named in ("$SOMEWHERE/none", "~nobody_of_that_name", "$NOT_SET_AT_ALL/x"):
        outcome = bench("data", "check", named)
        assert (outcome.status, outcome.out) == (2, "")
        assert len(outcome.err.splitlines()) == 1


def test_data_check_names_the_folder_that_was_meant(bench, tmp_path):
    copy = copy_of_one_person(bench, tmp_path / "data" / "copy")
    for named in (tmp_path / "data", tmp_path, copy / "CoreView_standin-2" / "Camera_B1"):
        outcome = bench("data", "check", named)
        assert (outcome.status, outcome.out) == (2, "")
        (meant,) = re.findall(r"did you mean (.+)\?$", outcome.err.strip())
        assert bench("data", "check", meant, "--overlays", tmp_path / "seen").status == 0
        outcome = bench("plan", "--protocol", bench.protocol, "--data", named)
        assert outcome.status == 2
        assert f"did you mean {meant}?" in outcome.err or f"there is one in {meant}, give that folder" in outcome.err


def test_data_check_of_a_folder_without_a_known_layout(bench, tmp_path):
    (tmp_path / "empty").mkdir()
    outcome = bench("data", "check", tmp_path / "empty")
    assert (outcome.status, outcome.out) == (2, "")
    assert "no known layout" in outcome.err


# ----------------------------------------------------------------------------------------- list, protocol, help


def test_everything_listed_can_be_named_in_a_run(bench, mannequin):
    told = json.loads(bench("list", "--json").out)
    assert {"inpainthuman", mannequin} <= set(told["methods"])
    assert "zju_mocap" in told["datasets"]
    assert {"zju_occ@1", "zju_occ_occnerf@1"} <= set(told["protocols"])
    plain = bench("list").out
    assert all(name in plain for kind in told.values() for name in kind)


def test_protocol_show_prints_every_choice_and_diff_only_the_different_ones(bench):
    shown = json.loads(bench("protocol", "show", bench.protocol, "--profile", "quick", "--json").out)
    assert shown["image"]["size"] == 64
    assert shown["digest"]
    same = bench("protocol", "diff", "zju_occ", "zju_occ")
    assert (same.status, same.out) == (0, "")
    told = json.loads(bench("protocol", "diff", "zju_occ", "zju_occ_occnerf", "--json").out)
    assert all(row["zju_occ"] != row["zju_occ_occnerf"] for row in told)
    assert "occlusion.covers.of" in {row["key"] for row in told}


def test_help_is_no_error_and_no_words_are_help(bench):
    for words in ([], ["--help"]):
        outcome = bench(*words)
        assert outcome.status == 0
        assert "usage: ihbench COMMAND" in outcome.out
    outcome = bench("run", "--help")
    assert (outcome.status, "usage: ihbench run" in outcome.out) == (0, True)


def test_reports_and_runs_show_the_same_numbers(bench_with_run, finished):
    cells = table_row(bench_with_run("report", "--runs", bench_with_run.runs).out, "inpainthuman")
    assert cells == table_row(finished.outcome.out, "inpainthuman")
    assert cells["**body**"] == f"{read_result(finished.folder).own[Identity.parse(BODY_PSNR)].value:.2f}"
