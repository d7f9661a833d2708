"""The index says what the folders say, whatever the folders hold."""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace

import pytest

from ihbench.errors import BadInput
from ihbench.index import Index
from ihbench.store import RunFolder
from tests.bench.test_store import IDENTITY

PSNR = "psnr/pooled/range1/body/v1"
HIDDEN = "psnr/pooled/range1/hidden/v1"


def finished(runs, values=(20.0, 30.0), **changes) -> RunFolder:
    run = RunFolder.create(runs, replace(IDENTITY, **changes))
    run.write_scores(
        [
            {"row": "inpainthuman", "camera": "1", "frame": i, "scores": {PSNR: value, HIDDEN: math.nan},
             "absent": {HIDDEN: "no truth"}}
            for i, value in enumerate(values)
        ]
    )  # fmt: skip
    run.set_status("done")
    return run


def test_runs_and_mean_scores(tmp_path):
    run = finished(tmp_path, values=(20.0, math.inf, 30.0))
    (row,) = Index(tmp_path).query()
    assert (row["id"], row["path"]) == (run.path.name, run.path.name)
    assert [row[key] for key in ("protocol", "scene", "method", "profile", "seed", "status")] == [
        "zju_occ@1", "377", "inpainthuman", "quick", 0, "done",
    ]  # fmt: skip
    scores = {score["identity"]: score for score in Index(tmp_path).scores()}
    assert (scores[PSNR]["value"], scores[PSNR]["n"], scores[PSNR]["row"]) == (25.0, 2, "inpainthuman")
    assert (scores[HIDDEN]["value"], scores[HIDDEN]["reason"]) == (None, "no truth")


def test_filters(tmp_path):
    for scene in ("377", "386"):
        finished(tmp_path, scene=scene)
    finished(tmp_path, protocol="zju_occ_occnerf@1", seed=3)
    index = Index(tmp_path)
    assert len(index.query()) == 3
    assert len(index.query(protocol="zju_occ")) == len(index.query(protocol="zju_occ@1")) == 2
    assert len(index.query(protocol="zju%")) == 0
    assert [row["scene"] for row in index.query(protocol="zju_occ", scene="386")] == ["386"]
    assert [row["seed"] for row in index.query(seed=3)] == [3]
    assert len(index.scores(scene="386")) == 2
    with pytest.raises(ValueError, match="colour"):
        index.query(colour="red")


def test_changes_are_seen_without_asking(tmp_path):
    run = finished(tmp_path)
    index = Index(tmp_path)
    assert len(index.query()) == 1
    finished(tmp_path, scene="386")
    assert len(index.query()) == 2
    run.write_scores([])
    assert len(index.scores(scene="377")) == 0
    run.set_status("failed", "x")
    assert [row["scene"] for row in index.query(status="failed")] == ["377"]


def test_the_index_is_used_while_nothing_changed_and_made_again_when_damaged(tmp_path, monkeypatch):
    finished(tmp_path)
    index = Index(tmp_path)
    first = index.query()
    for damage in (b"", b"no database", None):
        if damage is None:
            index.file.unlink()
        else:
            index.file.write_bytes(damage)
        assert index.query() == first
    monkeypatch.setattr(index, "rebuild", lambda: pytest.fail("made again for nothing"))
    assert index.query() == first


def test_hostile_folders_are_listed_and_break_nothing(tmp_path):
    good = finished(tmp_path)
    deep = "[" * 100_000
    contents = [
        "", "{", "[]", "null", deep, '{"schema_version": 1}', '{"schema_version": 99}', '{"schema_version": 1e999}',
    ]  # fmt: skip
    for number, content in enumerate(contents):
        (tmp_path / f"bad{number}").mkdir()
        (tmp_path / f"bad{number}" / "run.json").write_text(content)
    changes = [
        {"identity": {}}, {"identity": {**good.identity, "seed": 10**30}},
        {"identity": {**good.identity, "scene": {}}},
    ]  # fmt: skip
    for number, change in enumerate(changes):
        (tmp_path / f"worse{number}").mkdir()
        (tmp_path / f"worse{number}" / "run.json").write_text(json.dumps({**good.record, **change}))
    for number, lines in enumerate(
        ["{", "[1]\n", '{"row": 1}\n', '{"scores": {"a": "x"}, "row": "m", "absent": {}}\n']
    ):
        (tmp_path / f"scores{number}").mkdir()
        (tmp_path / f"scores{number}" / "run.json").write_text(json.dumps(good.record))
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

    index = Index(tmp_path)
    assert index.rebuild() == 1 + len(contents) + len(changes) + 4 + 3 + 1
    bad = index.query(status="unreadable")
    assert len(bad) == len(index.query()) - 1
    assert all(row["reason"] for row in bad)
    assert [row["id"] for row in index.query(status="done")] == [good.path.name]
    assert {score["run"] for score in index.scores()} == {good.path.name}


def test_odd_texts_in_a_record_are_kept_as_text(tmp_path):
    run = finished(tmp_path)
    run.set_status("failed", "\ud800 '; DROP TABLE runs; --")
    (row,) = Index(tmp_path).query(status="failed")
    assert row["reason"] == "? '; DROP TABLE runs; --"


def test_no_folder_of_runs_is_bad_input(tmp_path):
    with pytest.raises(BadInput, match="no folder of runs"):
        Index(tmp_path / "nothing").query()


def test_an_empty_folder_has_no_runs(tmp_path):
    assert Index(tmp_path).query() == []
    assert [entry.name for entry in tmp_path.iterdir()] == ["runs.sqlite"]
