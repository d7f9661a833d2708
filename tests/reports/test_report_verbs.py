"""`ihbench report table1`, `table2` and `lint` from the command line."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stderr, redirect_stdout

import pytest

from ihbench import registry
from ihbench.cli import main
from tests.conftest import Outcome
from tests.reports.fake_runs import write_run


@pytest.fixture
def ihbench(tmp_path, monkeypatch):
    """The command line, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            status = main([str(word) for word in words])
        return Outcome(status, out.getvalue(), err.getvalue())

    return run


def test_the_verbs_are_registered_and_can_be_found(ihbench):
    assert registry.names("report verb") == ["lint", "table1", "table2"]
    assert ihbench("report", "lint", "--help").status == 0


def test_a_table_is_there_without_any_run(ihbench):
    outcome = ihbench("report", "table1")
    assert outcome.status == 0
    assert "| InpaintHuman | reported | **24.65** |" in outcome.out
    assert "no finished run under zju_occ" in outcome.out


def test_run_folders_become_measured_rows(ihbench, tmp_path):
    for k, scene in enumerate("abc"):
        write_run(tmp_path / "runs", scene, "mine", 20.0 + k, 0.9)
        write_run(tmp_path / "runs", scene, "other", 19.0 + k - 0.01 * k, 0.8)
    write_run(tmp_path / "runs", "a", "mine", 35.0, 0.99, protocol="people_snapshot_occ@1")
    outcome = ihbench("report", "table1")
    assert outcome.status == 0
    (row,) = [line for line in outcome.out.splitlines() if line.startswith("| mine |")]
    assert row.startswith("| mine | stand-in | **21.00** [18.52, 23.48] |")
    assert "35.00" not in outcome.out
    assert "| mine |" not in ihbench("report", "table1", "--method", "other").out
    assert "35.00" in ihbench("report", "table2").out


@pytest.mark.parametrize("format", ["md", "tex", "html", "csv", "json"])
def test_every_format_goes_to_a_file(ihbench, tmp_path, format):
    file = tmp_path / f"t.{format}"
    assert ihbench("report", "table2", "--format", format, "--out", file).out == ""
    assert "24.31" in file.read_text(encoding="utf-8")


@pytest.mark.parametrize("ending", ["md", "tex"])
def test_the_papers_table_as_printed_does_not_pass_the_linter_and_ours_does(ihbench, ending):
    ihbench("report", "table1", "--as-printed", "--format", ending, "--out", f"printed.{ending}")
    ihbench("report", "table1", "--format", ending, "--out", f"computed.{ending}")
    outcome = ihbench("report", "lint", f"printed.{ending}")
    assert outcome.status == 1
    (line,) = outcome.out.splitlines()
    assert line.startswith(f"printed.{ending}:")
    assert "OccFusion, ZJU-MoCap SSIM ↑: wrong second-best mark" in line
    assert ihbench("report", "lint", f"computed.{ending}").status == 0
    found = ihbench("report", "lint", "--json", f"computed.{ending}", f"printed.{ending}")
    assert found.status == 1
    (finding,) = json.loads(found.out)["findings"]
    assert finding["file"] == f"printed.{ending}"


def test_what_the_linter_does_not_understand_goes_to_stderr(ihbench, tmp_path):
    (tmp_path / "t.tex").write_text(
        "\\begin{tabular}{lcc} M & Zing & PSNR $\\uparrow$ \\\\ \\hline\n"
        "A & \\textbf{1} & \\wow{2} \\\\ \\end{tabular}"
    )
    outcome = ihbench("report", "lint", "t.tex")
    assert outcome.status == 0
    assert outcome.out == "nothing found in 1 table\n"
    assert "t.tex:2: note: \\wow is not known" in outcome.err
    assert "t.tex:1: note: column Zing has marks, but neither a known metric nor an arrow" in outcome.err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["lint"], "which file?"),
        (["lint", "nowhere.tex"], "nowhere.tex: cannot be opened"),
        (["lint", "empty.md"], "empty.md: no table in it"),
        (["lint", "table.pdf"], "table.pdf: expected a .tex or .md file"),
        (["table1", "--runs", "nowhere"], "--runs nowhere: no such folder"),
        (["table1", "--format", "pdf"], "--format"),
        (["table2", "--regin", "full"], "--region"),
        (["table1", "--region", "hiden"], "--region hiden: there is none here: did you mean 'hidden'?"),
        (["table3"], "table3: not a run folder"),
    ],
)
def test_bad_input_is_one_line_and_status_2(ihbench, tmp_path, words, told):
    (tmp_path / "empty.md").write_text("# nothing\n")
    outcome = ihbench("report", *words)
    assert outcome.status == 2
    assert told in outcome.err
    assert outcome.err.count("\n") == 1
    assert outcome.out == ""


def test_filters_choose_among_the_run_folders_that_are_named(ihbench, tmp_path):
    runs = [
        write_run(tmp_path / "runs", scene, method, 20.0, 0.9, profile=profile, protocol=protocol)
        for scene, method, profile, protocol in (
            ("a", "mine", "quick", "zju_occ@1"),
            ("b", "other", "quick", "zju_occ@1"),
            ("b", "mine", "paper", "ocmotion@1"),
        )
    ]
    whole = ihbench("report", *runs, "--format", "md").out
    for words in (
        ("--method", "mine"),
        ("--scene", "b"),
        ("--profile", "paper"),
        ("--protocol", "zju_occ"),
        ("--protocol", "ocmotion@1"),
    ):
        outcome = ihbench("report", *runs, *words, "--format", "md")
        assert outcome.status == 0
        named, found = (
            sorted(text.splitlines()) for text in (outcome.out, ihbench("report", *words, "--format", "md").out)
        )
        assert named == found != sorted(whole.splitlines())
    outcome = ihbench("report", *runs, "--scene", "nobody")
    assert outcome.status == 2
    assert "none of the run folders that are named matches" in outcome.err


def test_a_damaged_run_is_named_and_left_out(ihbench, tmp_path):
    folder = write_run(tmp_path / "runs", "a", "mine", 20.0, 0.9)
    write_run(tmp_path / "runs", "b", "mine", 22.0, 0.9)
    (folder / "scores.jsonl").write_text("{}\n")
    outcome = ihbench("report", "table1")
    assert outcome.status == 0
    assert "left out" in outcome.err
    assert "| mine | stand-in | 22.00 |" in outcome.out


@pytest.mark.parametrize("format", ["md", "tex", "html"])
def test_what_is_written_is_chosen_on_the_command_line(ihbench, tmp_path, format):
    for scene in "abc":
        write_run(tmp_path / "runs", scene, "mine", 20.0, 0.9)
        write_run(tmp_path / "runs", scene, "other", 19.0, 0.8)
    choice = ("--rows", "other", "mine", "--metrics", "psnr", "--regions", "body", "--names", "mine=Our own")
    for words in (("report",), ("report", "table1")):
        outcome = ihbench(*words, *choice, "--fragment", "--format", format)
        assert outcome.status == 0, outcome.err
        assert outcome.out.index("other") < outcome.out.index("Our own")
        assert "SSIM" not in outcome.out
        assert not any(word in outcome.out for word in ("documentclass", "<html", "# ", "HumanNeRF", "truth"))
        if format != "html":
            (tmp_path / f"own.{format}").write_text(outcome.out)
            assert ihbench("report", "lint", f"own.{format}").status == 0
        for bad, near in (
            (("--rows", "mien"), "did you mean 'mine'"),
            (("--metrics", "pnsr"), "did you mean 'psnr'"),
        ):
            refused = ihbench(*words, *bad, "--format", format)
            assert (refused.status, refused.err.count("\n")) == (2, 1)
            assert near in refused.err


def test_what_has_no_document_around_it_has_no_fragment(ihbench, tmp_path):
    outcome = ihbench("report", "table1", "--format", "csv", "--fragment")
    assert outcome.status == 2
    assert "--fragment: csv" in outcome.err
    assert ihbench("report", "table1", "--region", "body", "--regions", "hidden").status == 2
    write_run(tmp_path / "runs", "a", "mine", 20.0, 0.9)
    assert (
        "no run that is done has a number"
        in ihbench("report", "--regions", "body", "--metrics", "lpips", "--fragment").err
    )
