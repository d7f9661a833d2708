"""The index says what the folders say, whatever the folders hold."""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import sqlite3
import subprocess
import sys
from dataclasses import replace

import pytest

from ihbench.errors import BadInput
from ihbench.metrics import Identity
from ihbench.record import index
from ihbench.record.index import Index
from ihbench.record.results import read_result
from ihbench.record.schema import ScoreLine
from ihbench.record.store import RunFolder
from tests.record.test_store import IDENTITY
from tests.reports.fake_runs import about

PSNR = Identity.parse("psnr/pooled/range1/body/v1")
HIDDEN = Identity.parse("psnr/pooled/range1/hidden/v1")


def finished(runs, values=(20.0, 30.0), **changes) -> RunFolder:
    run = RunFolder.create(runs, replace(IDENTITY, **changes), about())
    run.write_scores(
        [
            ScoreLine("inpainthuman", "1", i, {PSNR: value, HIDDEN: math.nan}, {str(HIDDEN): "no truth"})
            for i, value in enumerate(values)
        ]
    )
    run.set_status("done")
    return run


@pytest.fixture(autouse=True)
def old_files(monkeypatch):
    """Files are taken for old at once: else what was written a moment ago is read again."""
    monkeypatch.setattr(index, "FRESH", 0)


def means(runs, **filters) -> dict:
    """(scene, identity) -> mean of the method's own row."""
    results, _ = Index(runs).results(**filters)
    return {(run.scene, identity): mean for run in results for identity, mean in run.rows[run.method].items()}


def test_runs_and_mean_scores(tmp_path):
    run = finished(tmp_path, values=(20.0, math.inf, 30.0))
    (row,) = Index(tmp_path).query()
    assert row.name == run.path.name
    assert (row.protocol, row.scene, row.method, row.profile, row.seed, row.status) == (
        "zju_occ@1", "377", "inpainthuman", "quick", 0, "done",
    )  # fmt: skip
    for _ in range(2):  # read from the folder, then from the index
        (result,), left_out = Index(tmp_path).results()
        assert left_out == []
        assert result.folder == run.path
        mean = result.rows["inpainthuman"][PSNR]
        assert (mean.value, mean.n, mean.infinite) == (25.0, 2, 1)
        assert (result.rows["inpainthuman"][HIDDEN].reason) == "no truth"
        assert result.record == RunFolder.open(run.path).record


def test_filters(tmp_path):
    for scene in ("377", "386"):
        finished(tmp_path, scene=scene)
    finished(tmp_path, protocol="zju_occ_occnerf@1", seed=3)
    index = Index(tmp_path)
    assert len(index.query()) == 3
    assert len(index.query(protocol="zju_occ")) == len(index.query(protocol="zju_occ@1")) == 2
    assert len(index.query(protocol="zju%")) == 0
    assert [row.scene for row in index.query(protocol="zju_occ", scene="386")] == ["386"]
    assert [row.seed for row in index.query(seed=3)] == [3]
    assert len(means(tmp_path, scene="386")) == 2


def test_changes_are_seen_without_asking_and_nothing_else_is_read(tmp_path, monkeypatch):
    run = finished(tmp_path)
    assert means(tmp_path)["377", PSNR].value == 25.0
    other = finished(tmp_path, scene="386")
    read = []
    monkeypatch.setattr(index, "read_result", lambda folder: read.append(folder) or read_result(folder))
    assert len(means(tmp_path)) == 4
    assert read == [other.path]
    scores = run.path / "scores.jsonl"
    before = scores.stat()
    scores.write_text(scores.read_text().replace("20.0", "40.0"))
    os.utime(scores, ns=(before.st_atime_ns, before.st_mtime_ns))  # as a copy may
    assert means(tmp_path, scene="377")["377", PSNR].value == 35.0
    assert read == [other.path, run.path]
    run.set_status("failed", "x")
    assert [row.scene for row in Index(tmp_path).query(status="failed")] == ["377"]
    shutil.rmtree(run.path)
    assert [row.scene for row in Index(tmp_path).query()] == ["386"]
    assert read == [other.path, run.path, run.path]


@pytest.mark.parametrize("damage", ["gone", "empty", "header", "cut", "scrambled"])
def test_a_damaged_index_changes_no_answer_and_is_made_again(tmp_path, monkeypatch, damage):
    finished(tmp_path)
    first, file = str(means(tmp_path)), Index(tmp_path).file
    data = file.read_bytes()
    file.unlink()
    changed = {
        "empty": b"", "header": data[:16] + bytes(40) + data[56:], "cut": data[: len(data) // 2],
        "scrambled": data[:4096] + bytes(b ^ 1 for b in data[4096:]),
    }  # fmt: skip
    if damage in changed:
        file.write_bytes(changed[damage])
    assert str(means(tmp_path)) == first
    assert str(means(tmp_path)) == first
    monkeypatch.setattr(index, "read_result", lambda folder: pytest.fail("read again for nothing"))
    assert str(means(tmp_path)) == first


def test_what_is_not_an_index_is_left_alone(tmp_path):
    finished(tmp_path)
    file, first = Index(tmp_path).file, str(means(tmp_path))
    file.unlink()
    file.write_bytes(b"somebody's notes")
    assert str(means(tmp_path)) == first
    assert file.read_bytes() == b"somebody's notes"
    file.unlink()
    with sqlite3.connect(file) as database:
        database.execute("CREATE TABLE runs (distance REAL)")
        database.execute("INSERT INTO runs VALUES (42.2)")
    assert str(means(tmp_path)) == first
    with sqlite3.connect(file) as database:
        assert database.execute("SELECT * FROM runs").fetchall() == [(42.2,)]
    for elsewhere in (tmp_path / "elsewhere.sqlite", tmp_path / "pipe"):
        file.unlink()
        file.symlink_to(elsewhere)
        assert str(means(tmp_path)) == first
        assert not elsewhere.exists()
    file.unlink()
    os.mkfifo(file)
    assert str(means(tmp_path)) == first


@pytest.mark.parametrize("error", [sqlite3.OperationalError("disk I/O error"), OSError(errno.EROFS, "read-only")])
def test_where_it_cannot_be_written_the_answer_is_the_same(tmp_path, monkeypatch, error):
    finished(tmp_path)

    def refused(*_args, **_more):
        raise error

    monkeypatch.setattr(index.sqlite3, "connect", refused)
    assert means(tmp_path)["377", PSNR].value == 25.0
    assert [entry.name for entry in tmp_path.iterdir() if entry.is_file()] == []


def test_processes_that_write_the_index_at_once_do_not_mind(tmp_path):
    for seed in range(4):
        finished(tmp_path, seed=seed)
    code = (
        "import sys; from pathlib import Path; from ihbench.record import index; index.FRESH = 10**12\n"
        "for _ in range(20): assert len(index.Index(Path(sys.argv[1])).results()[0]) == 4"
    )
    rivals = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]
    assert [rival.wait() for rival in rivals] == [0, 0, 0]
    assert len(means(tmp_path)) == 2


def test_a_copy_of_a_run_counts_once(tmp_path):
    run = finished(tmp_path)
    shutil.copytree(run.path, tmp_path / "a-copy")
    for _ in range(2):
        results, left_out = Index(tmp_path).results()
        assert [result.folder for result in results] == [run.path]
        assert left_out == [f"{tmp_path / 'a-copy'}: is a copy of {run.path}"]
    shutil.rmtree(run.path)
    assert [result.folder.name for result in Index(tmp_path).results()[0]] == ["a-copy"]


def test_hostile_folders_are_listed_and_break_nothing(tmp_path):
    good = finished(tmp_path)
    deep = "[" * 100_000
    contents = [
        "", "{", "[]", "null", deep, '{"schema_version": 1}', '{"schema_version": 99}', '{"schema_version": 1e999}',
    ]  # fmt: skip
    for number, content in enumerate(contents):
        (tmp_path / f"bad{number}").mkdir()
        (tmp_path / f"bad{number}" / "run.json").write_text(content)
    record = json.loads((good.path / "run.json").read_text())
    named = record["identity"]
    changes = [{"identity": {}}, {"identity": {**named, "seed": 10**30}}, {"identity": {**named, "scene": {}}}]
    for number, change in enumerate(changes):
        (tmp_path / f"worse{number}").mkdir()
        (tmp_path / f"worse{number}" / "run.json").write_text(json.dumps({**record, **change}))
    for number, lines in enumerate(
        ["{", "[1]\n", '{"row": 1}\n', '{"scores": {"a": "x"}, "row": "m", "absent": {}}\n']
    ):
        (tmp_path / f"scores{number}").mkdir()
        (tmp_path / f"scores{number}" / "run.json").write_text(json.dumps(record))
        (tmp_path / f"scores{number}" / "scores.jsonl").write_text(lines)
    for name in ("pipe", "link", "folder"):
        (tmp_path / name).mkdir()
    os.mkfifo(tmp_path / "pipe" / "run.json")
    (tmp_path / "link" / "run.json").symlink_to(good.path / "run.json")
    (tmp_path / "folder" / "run.json").mkdir()
    os.mkdir(os.fsencode(tmp_path) + b"/\xff")
    with open(os.fsencode(tmp_path) + b"/\xff/run.json", "w") as file:
        file.write("{")
    (tmp_path / "outside").symlink_to(good.path)  # a link to a run is not a run
    (tmp_path / "notes").mkdir()  # nor is a folder without a record
    (tmp_path / "notes.txt").write_text("x")

    bad = Index(tmp_path).query(status="unreadable")
    assert len(bad) == len(contents) + len(changes) + 4 + 3 + 1
    assert len(bad) == len(Index(tmp_path).query()) - 1
    assert all(row.reason for row in bad)
    results, left_out = Index(tmp_path).results(scene="377")
    assert [result.folder for result in results] == [good.path]
    assert len(left_out) == len(bad)


def test_odd_texts_in_a_record_are_kept_as_text(tmp_path):
    run = finished(tmp_path)
    run.set_status("failed", "\ud800 '; DROP TABLE runs; --")
    (row,) = Index(tmp_path).query(status="failed")
    assert row.reason == "? '; DROP TABLE runs; --"


def test_no_folder_of_runs_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match="no folder of runs"):
        Index(tmp_path / "nothing").query()


def test_an_empty_folder_has_no_runs(tmp_path):
    assert Index(tmp_path).query() == []
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.sqlite"]
