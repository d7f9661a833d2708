"""What the commands print and write, against files beside this: see `expected` for what counts as the same."""

from __future__ import annotations

import json

import pytest

from ihbench import registry
from tests.conftest import tiny_protocol
from tests.golden.expected import check, stop_clock, structure_text
from tests.reports.fake_runs import write_run
from tests.reports.made_up_runs import sweep

FORMATS = ("md", "tex", "html")


@pytest.fixture
def stopped(bench_with_run, tmp_path, monkeypatch):
    """A finished run whose clock is stopped, in an empty current folder; and what paths and names read as."""
    monkeypatch.chdir(tmp_path)
    (folder,) = bench_with_run.folders()
    cpu = stop_clock(folder)
    home = bench_with_run.protocol.parent
    return bench_with_run, {"TMP": tmp_path, "HOME": home, "CPU": cpu}


def stdout_of(outcome, status=0):
    assert outcome.status == status, outcome.err
    return outcome.out


def test_run(stopped):
    bench, words = stopped
    full = bench.run_words()
    check("run.txt", stdout_of(bench(*(word for word in full if word != "--full"))), **words)
    check("run_full.md", stdout_of(bench(*full)), **words)
    assert len(bench.folders()) == 1  # not run again


def test_the_record(finished):
    check("run_json.txt", structure_text(json.loads((finished.folder / "run.json").read_text(encoding="utf-8"))))
    for name in ("scores", "calibration", "curve"):
        lines = (finished.folder / f"{name}.jsonl").read_text(encoding="utf-8").splitlines()
        check(f"{name}_jsonl.txt", structure_text([json.loads(line) for line in lines]))


def test_reports_of_a_run(stopped):
    bench, words = stopped
    for kind in FORMATS:
        check(f"report.{kind}", stdout_of(bench("report", "--runs", bench.runs, "--format", kind)), **words)


def test_reports_of_many_runs(tmp_path):
    runs = sweep(tmp_path, seeds=(0, 1))
    for kind in FORMATS:
        check(f"report_many.{kind}", registry.load("report", kind)(runs), TMP=tmp_path)


@pytest.mark.parametrize("table", ["table1", "table2"])
def test_the_papers_tables(bench, tmp_path, monkeypatch, table):
    monkeypatch.chdir(tmp_path)
    for k, scene in enumerate("abc"):
        write_run(bench.runs, scene, "mine", 20.0 + k, 0.9)
        write_run(bench.runs, scene, "other", 19.0 + k - 0.01 * k, 0.8)
    write_run(bench.runs, "a", "mine", 35.0, 0.99, protocol="people_snapshot_occ@1")
    for kind in ("md", "tex", "html", "csv", "json"):
        check(
            f"{table}.{kind}", stdout_of(bench("report", table, "--runs", bench.runs, "--format", kind)), TMP=tmp_path
        )


def test_ablate(bench, mannequin, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["ablate", "--protocol", bench.protocol, "--runs", bench.runs, "--method", mannequin, "--workers", "0"]
    words += ["--scene", "standin-1", "--seed", "0", "--vary", "brightness=0.1:0.4"]
    stdout_of(bench(*words))
    cpu, _ = map(stop_clock, bench.folders())
    names = {"TMP": tmp_path, "CPU": cpu}
    printed = stdout_of(bench(*words, "--out", "out"))
    files = {path.name: path.read_text(encoding="utf-8") for path in (tmp_path / "out").iterdir()}
    assert sorted(files) == [".ihbench-written.json", "ablation.json", "ablation.md"]
    assert files["ablation.md"].strip() == printed.strip()
    for name in ("ablation.md", "ablation.json"):
        check(name, files[name], **names)


def test_data_check(bench, tmp_path):
    folder = next(bench.cache.rglob("CoreView_standin-1"))
    for more, name in (((), "data_check.txt"), (("--json",), "data_check.json")):
        outcome = bench("data", "check", folder, "--overlays", tmp_path, *more)
        check(name, stdout_of(outcome), TMP=tmp_path, HOME=bench.protocol.parent)


def test_plan(stopped):
    bench, words = stopped
    plan = ("plan", "--protocol", bench.protocol, "--runs", bench.runs, "--scene", "standin-1")
    check("plan.txt", stdout_of(bench(*plan)), **words)
    check("plan.json", stdout_of(bench(*plan, "--json")), **words)


def test_runs_list(stopped):
    bench, words = stopped
    check("runs_list.txt", stdout_of(bench("runs", "list", "--runs", bench.runs)), **words)
    check("runs_list.json", stdout_of(bench("runs", "list", "--runs", bench.runs, "--json")), **words)


def test_protocols_and_what_is_registered(bench, tmp_path):
    tiny = tiny_protocol(tmp_path / "tiny.toml")
    check("protocol_show.txt", stdout_of(bench("protocol", "show", "zju_occ")), TMP=tmp_path)
    check("protocol_show.json", stdout_of(bench("protocol", "show", tiny, "--json")), TMP=tmp_path)
    check("protocol_diff.txt", stdout_of(bench("protocol", "diff", "zju_occ", "zju_occ_occnerf")), TMP=tmp_path)
    check("list.txt", stdout_of(bench("list")))
