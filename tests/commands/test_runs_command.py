"""`ihbench runs list|rm`: every run in a line; what is removed is a run of ours, nobody's work, and asked for."""

from __future__ import annotations

import json
import os
import shutil

import pandas
import pytest

from ihbench import frame
from ihbench.record.store import RunFolder
from tests.conftest import contents
from tests.reports.fake_runs import about, identity, write_run
from tests.reports.test_report_verbs import ihbench  # noqa: F401 (a fixture)


@pytest.fixture
def runs(tmp_path):
    folder = tmp_path / "runs"
    write_run(folder, "a", "mine", 20.0, 0.9)
    write_run(folder, "b", "mine", 21.0, 0.9, seed=3)
    write_run(folder, "a", "other", 22.0, 0.9)
    RunFolder.create(folder, identity("c", "mine"), about()).set_status("failed", "no memory")
    RunFolder.create(folder, identity("d", "mine"), about())  # its process has died
    (write_run(folder, "e", "mine", 1.0, 0.1) / "scores.jsonl").write_text("cut")
    (folder / "notes").mkdir()
    (folder / "notes" / "run.json").write_text('{"lr": 0.1}')  # of another tool
    return folder


def test_every_run_has_a_line(ihbench, runs):  # noqa: F811
    rows = {row["folder"].split("/")[-1]: row for row in json.loads(ihbench("runs", "list", "--json").out)["runs"]}
    told = {(row["scene"], row["method"], row["seed"], row["status"], row["value"]) for row in rows.values()}
    assert told == {
        ("a", "mine", 0, "done", 20.0), ("b", "mine", 3, "done", 21.0), ("a", "other", 0, "done", 22.0),
        ("c", "mine", 0, "failed", None), ("d", "mine", 0, "interrupted", None), (None, None, None, "damaged", None),
    }  # fmt: skip
    damaged = [row["reason"] for row in rows.values() if row["status"] == "damaged"]
    assert len(damaged) == 2
    assert any("not valid JSON" in reason for reason in damaged)
    done = next(row for row in rows.values() if row["value"] == 20.0)
    assert done["bytes"] == sum(len(data) for data in contents(runs / done["folder"].split("/")[-1]).values())
    lines = ihbench("runs", "list", "--scene", "a").out.splitlines()
    assert [line.split()[0] for line in lines] == ["status", "done", "done"]
    assert "20.00" in lines[1]
    assert lines[1].endswith(done["folder"])


@pytest.mark.parametrize(
    ("words", "gone"),
    [
        (["--method", "mine", "--status", "done"], ["a__mine", "b__mine"]),
        (["--seed", "3"], ["b__mine"]),
        (["--status", "interrupted"], ["d__mine"]),
        (["--protocol", "zju_occ", "--scene", "a"], ["a__mine", "a__other"]),
    ],
)
def test_what_the_filters_choose_goes_and_nothing_else(ihbench, runs, words, gone):  # noqa: F811
    before = contents(runs)
    asked = ihbench("runs", "rm", *words)
    assert asked.status == 2
    assert f"would remove {len(gone)} run" in asked.err
    assert {k: v for k, v in contents(runs).items() if k != "runs.sqlite"} == before
    outcome = ihbench("runs", "rm", *words, "--yes", "--json")
    assert outcome.status == 0, outcome.err
    assert len(json.loads(outcome.out)["removed"]) == len(gone)
    left = {k: v for k, v in before.items() if not any(f"__{name}__" in k for name in gone)}
    assert {k: v for k, v in contents(runs).items() if k != "runs.sqlite"} == left
    assert len(list(runs.glob("zju_occ*"))) == 6 - len(gone)


def test_named_runs_go_damaged_ones_too_and_files_of_the_users_stay(ihbench, runs):  # noqa: F811
    (damaged,), (mine,) = runs.glob("*__e__*"), runs.glob("*__a__mine__*")
    (mine / "notes.txt").write_text("precious")
    (mine / "renders").symlink_to(runs / "notes")
    outcome = ihbench("runs", "rm", damaged, mine.name, mine, "--yes")
    assert (outcome.status, outcome.out.startswith("removed 2 runs, ")) == (0, True)
    assert not damaged.exists()
    assert sorted(os.listdir(mine)) == ["notes.txt", "renders"]
    assert "notes.txt" in outcome.err
    assert (runs / "notes" / "run.json").exists()
    assert ihbench("report").err.count("left out") == 1  # the other tool's; what was kept is no run any more


@pytest.mark.parametrize("named", ["notes", ".", "link", "nothing", "file", "replaced"])
def test_what_is_no_run_of_ours_is_refused(ihbench, runs, named, tmp_path):  # noqa: F811
    (runs / "link").symlink_to(next(runs.glob("*__a__mine__*")))
    (runs / "file").write_text("x")
    (runs / "replaced").mkdir()
    before = contents(tmp_path)
    outcome = ihbench("runs", "rm", next(runs.glob("*__b__*")), runs / named, "--yes")
    assert (outcome.status, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert contents(tmp_path) == before


def test_a_run_that_is_being_written_stays(ihbench, runs):  # noqa: F811
    (folder,) = runs.glob("*__d__*")
    with RunFolder.open(folder).lock():
        assert ihbench("runs", "rm", folder, "--yes").status == 2
        outcome = ihbench("runs", "rm", "--method", "mine", "--status", "running", "--yes")
        assert (outcome.status, "is being written" in outcome.err) == (2, True)
        assert (folder / "run.json").exists()
    assert ihbench("runs", "rm", folder, "--yes").status == 0
    assert not folder.exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["rm", "--yes"], "either name run folders, or choose"),
        (["rm", "x", "--scene", "a", "--yes"], "either name run folders, or choose"),
        (["rm", "--scene", "nowhere", "--yes"], "no run under runs matches"),
        (["list", "--status", "faild"], "did you mean 'failed'?"),
        (["list", "--runs", "nowhere"], "nowhere: no folder of runs"),
    ],
)
def test_bad_words_are_one_line(ihbench, runs, words, told):  # noqa: F811
    outcome = ihbench("runs", *words)
    assert (outcome.status, outcome.out) == (2, "")
    assert told in outcome.err


def test_an_empty_folder_has_no_runs(ihbench, runs):  # noqa: F811
    shutil.rmtree(runs)
    runs.mkdir()
    assert json.loads(ihbench("runs", "list", "--json").out) == {"runs": []}


def test_every_number_of_every_view_becomes_one_table(ihbench, runs, monkeypatch):  # noqa: F811
    write_run(runs, "a", "=1+1", 23.0, 0.9)
    table = frame(runs)
    assert table.groupby(["method", "scene"]).size().to_dict() == {
        ("mine", "a"): 6, ("mine", "b"): 6, ("other", "a"): 6, ("=1+1", "a"): 6,
    }  # fmt: skip
    assert len(table.attrs["left_out"]) == 2
    psnr = table[(table.metric == "psnr") & (table.row == table.method)]
    assert sorted(psnr.value) == [20.0, 21.0, 22.0, 23.0]
    assert set(psnr.absent) == {""}
    assert set(table[table.value.isna()].absent) == {"weights are not there"}
    assert frame(psnr.folder[:2]).equals(table[table.folder.isin(psnr.folder[:2])].reset_index(drop=True))
    assert set(frame(psnr.folder.iloc[0]).folder) == {psnr.folder.iloc[0]}
    file = runs / "scores.csv"
    ihbench("runs", "export", "--out", str(file))
    back = pandas.read_csv(
        file, dtype={"camera": str, "digest": str}, keep_default_na=False, na_values={"value": [""]}
    )
    unmarked = back.assign(method=back.method.str.lstrip("'"), row=back.row.str.lstrip("'"), folder=table.folder)
    assert unmarked.equals(table)
    assert set(back.method) == {"mine", "other", "'=1+1"}  # no formula
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install pyarrow" in ihbench("runs", "export", "--out", "scores.parquet").err
    record = next(runs.glob("*/run.json"))
    assert "part of" in ihbench("runs", "export", "--out", str(record)).err
