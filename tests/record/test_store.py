"""What makes a run the same run, and a folder that survives kills, rivals and damage."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.clock.ledger import Ledger
from ihbench.config_fields import as_json
from ihbench.errors import BadInput
from ihbench.files import locks
from ihbench.metrics import Identity
from ihbench.record import schema, store
from ihbench.record.schema import About, CurvePoint, PresetHead, RunRecord, ScoreLine, score_lines
from ihbench.record.store import RunFolder, RunIdentity

IDENTITY = RunIdentity(
    protocol="zju_occ@1", protocol_digest="0123456789abcdef", dataset="zju_mocap", scene="377",
    data="stand-in v1 seed 0", method="inpainthuman", config={"steps": 300, "rate": 1e-3, "levels": (64, 128)},
    profile="quick", seed=0, body="b0d7", code="1",
)  # fmt: skip

LINE = ScoreLine("inpainthuman", "1", 0, {}, {})


def test_the_folder_is_named_by_what_the_run_is():
    assert IDENTITY.folder_name == f"zju_occ@1__377__inpainthuman__quick__s0__{IDENTITY.digest}"
    assert len(IDENTITY.digest) == 10


def test_the_digest_is_the_same_in_any_process():
    # made by: hashlib.sha256(json.dumps({...the eleven fields...}, sort_keys=True, separators=(",", ":")).encode())
    assert IDENTITY.digest == "01dfcb82a7"
    reordered = replace(IDENTITY, config=dict(reversed(IDENTITY.config.items())))
    assert reordered.digest == IDENTITY.digest


@pytest.mark.parametrize("field", [field.name for field in fields(RunIdentity)])
def test_every_field_makes_another_run(field):
    other = {"config": {**IDENTITY.config, "steps": 301}, "seed": 1, "more": {"x": 1}}.get(field, "other")
    assert replace(IDENTITY, **{field: other}).digest != IDENTITY.digest


@given(st.text(max_size=300), st.text(max_size=300))
@settings(deadline=None, derandomize=True, max_examples=200)
def test_no_name_leaves_its_folder(scene, method):
    name = replace(IDENTITY, scene=scene, method=method).folder_name
    assert Path(name).name == name
    assert name not in (".", "..")
    assert not name.startswith(".")
    assert name.isascii()
    assert name.isprintable()
    assert len(name) < 250


def test_names_that_become_equal_are_still_two_folders():
    assert replace(IDENTITY, scene="a/b").folder_name != replace(IDENTITY, scene="a b").folder_name


def test_a_new_run_is_running_and_says_where_it_came_from(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY, about=About(standin="stand-in v1"))
    record = json.loads((tmp_path / IDENTITY.folder_name / "run.json").read_text())
    assert RunFolder.open(run.path).record == run.record
    assert record["schema_version"] == 2
    assert record["outcome"]["status"] == "running"
    assert record["identity"]["config"]["levels"] == [64, 128]
    assert record["about"] == {"standin": "stand-in v1", "device": "cpu", "command": []}
    assert record["machine"]["cores"] >= 1
    assert {"ihbench", "git", "packages"} <= record["provenance"].keys()
    assert not run.finished


@pytest.mark.parametrize(
    "change", [{"method": "nan"}, {"scene": "'inf"}, {"config": {"clip": math.inf, "x": math.nan}}], ids=str
)
def test_names_and_values_that_json_lacks_come_back(tmp_path, change):
    made = RunFolder.create(tmp_path, replace(IDENTITY, **change))
    assert RunFolder.open(made.path).record.digest == made.record.digest


def test_a_finished_run_is_found_not_made_again(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    ledger = Ledger()
    with ledger.stage("fit"):
        pass
    run.write_scores([LINE])
    run.set_status("done", ledger=ledger)
    again = RunFolder.create(tmp_path, IDENTITY)
    assert again.finished
    assert score_lines(again.path / "scores.jsonl") != []
    assert Ledger(state=again.record.ledger).seconds >= ledger.state().stages["fit"].seconds


@pytest.mark.parametrize("status", store.STATUSES)
def test_outcomes_keep_their_reason(tmp_path, status):
    run = RunFolder.create(tmp_path, IDENTITY)
    run.set_status(status, "because")
    again = RunFolder.open(run.path)
    assert (again.status, again.reason) == (status, "because")
    assert again.finished == (status in ("done", "diverged", "skipped"))


def test_an_unknown_status_is_refused(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    with pytest.raises(ValueError, match="finished"):
        run.set_status("finished")


def test_force_begins_again_but_follows_no_links(tmp_path):
    run = RunFolder.create(tmp_path / "runs", IDENTITY)
    run.set_status("done")
    run.write_scores([LINE])
    run.renders.mkdir()
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "file").write_text("x")
    (run.path / "link").symlink_to(tmp_path / "precious")
    fresh = RunFolder.create(tmp_path / "runs", IDENTITY, force=True)
    assert fresh.status == "running"
    assert sorted(entry.name for entry in fresh.path.iterdir()) == ["link", "lock", "run.json"]
    assert (fresh.path / "link" / "file").read_text() == "x"


@pytest.mark.parametrize("keep_new", [True, False])
def test_a_forced_run_takes_the_old_ones_place_only_when_it_ends(tmp_path, keep_new):
    old = RunFolder.create(tmp_path, IDENTITY)
    (old.path / "scores.jsonl").write_text("old\n")
    old.set_status("done")
    new = RunFolder.create(tmp_path, IDENTITY, force=True)
    assert new.path == old.path
    assert new.status == "running"
    assert not (new.path / "scores.jsonl").exists()
    with new.lock():
        new.settle(keep_new)
    after = RunFolder.open(old.path)
    assert after.status == ("running" if keep_new else "done")
    assert (old.path / "scores.jsonl").exists() is not keep_new
    assert not list((tmp_path / "replaced").iterdir())


def test_a_run_cut_short_twice_under_force_still_finds_the_finished_one(tmp_path):
    RunFolder.create(tmp_path, IDENTITY).set_status("done", "the first")
    RunFolder.create(tmp_path, IDENTITY, force=True)  # killed
    again = RunFolder.create(tmp_path, IDENTITY, force=True)
    with again.lock():
        again.settle(keep_new=False)
    assert RunFolder.open(again.path).reason == "the first"


def test_a_runs_folder_that_is_a_file_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="--runs"):
        RunFolder.create(tmp_path / "file", IDENTITY, force=True)


def test_force_does_not_empty_a_run_in_use(tmp_path, monkeypatch):
    run = RunFolder.create(tmp_path, IDENTITY)
    run.write_scores([LINE])
    monkeypatch.setattr(locks, "WAIT", 0.0)
    with run.lock(), pytest.raises(BadInput, match=f"being written by process {os.getpid()};"):
        RunFolder.create(tmp_path, IDENTITY, force=True)
    assert score_lines(run.path / "scores.jsonl") == [LINE]


@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"schema_version": 1}', '{"schema_version": "1"}'])
def test_a_damaged_record_is_said_on_reading_and_started_again_on_writing(tmp_path, content):
    run = RunFolder.create(tmp_path, IDENTITY)
    run.checkpoints.mkdir()
    (run.path / "run.json").write_text(content)
    with pytest.raises(BadInput, match=r"run\.json") as caught:
        RunFolder.open(run.path)
    assert "\n" not in str(caught.value)
    again = RunFolder.create(tmp_path, IDENTITY)
    assert again.status == "running"
    assert "damaged" in again.record.warnings[0]
    assert (run.path / "run.json.damaged").read_text() == content
    assert run.checkpoints.is_dir()


def edit(run: RunFolder, **parts) -> None:
    file = run.path / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | parts))


def test_a_record_of_a_newer_version_is_left_alone(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    edit(run, schema_version=99)
    before = (run.path / "run.json").read_bytes()
    for attempt in (lambda: RunFolder.open(run.path), lambda: RunFolder.create(tmp_path, IDENTITY)):
        with pytest.raises(BadInput, match="newer"):
            attempt()
    assert (run.path / "run.json").read_bytes() == before


def test_a_record_of_schema_1_is_read_as_what_it_said_and_written_as_schema_2(tmp_path):
    (tmp_path / "run.json").write_bytes((Path(__file__).parent / "schema_1.json").read_bytes())
    run = RunFolder.open(tmp_path)
    record = run.record
    assert (record.outcome.status, record.digest, record.identity.digest) == ("done", "549e535312", "549e535312")
    assert record.about.changed == {"levels": [16, 64], "grid.on": True, "keep": ["steps"]}
    assert record.about.differences == ["levels=(16, 64)", "grid.on=True", "keep=steps"]
    assert [(o.field, o.value, o.spares) for o in record.about.left_out] == [
        ("steps", 5, {"fit/stage1": 0.5}), ("hidden", None, {}),
    ]  # fmt: skip
    assert (record.about.predictions.notes, record.about.subjects.names) == (("odd",), ("a", "b", "c", "d"))
    assert [event.kind for event in record.events] == ["inpainted", "resumed"]
    assert (record.ledger.stages["fit"].entered, record.machine.load_average_end) == (1, (0.7, 0.5))
    run.save()
    assert json.loads((tmp_path / "run.json").read_text())["schema_version"] == 2
    assert RunFolder.open(tmp_path).record == run.record


def test_what_another_version_says_besides_stays(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    edit(run, mood="good", about={"device": "cpu", "weather": {"rain": 1}})
    again = RunFolder.open(run.path)
    again.warn("x")
    record = json.loads((run.path / "run.json").read_text())
    assert (record["mood"], record["about"]["weather"]) == ("good", {"rain": 1})


def test_another_run_under_the_same_name_is_not_overwritten(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    other = replace(IDENTITY, config={"steps": 999})
    edit(run, identity=as_json(other), digest=other.digest)
    with pytest.raises(BadInput, match="another run"):
        RunFolder.create(tmp_path, IDENTITY)
    edit(run, identity=as_json(replace(other, config={"steps": 998})))
    with pytest.raises(BadInput, match="not the one of its digest"):
        RunFolder.create(tmp_path, IDENTITY)


def test_a_folder_without_a_record_is_no_run(tmp_path):
    with pytest.raises(BadInput, match="not a run folder"):
        RunFolder.open(tmp_path)


def test_the_curve_grows_and_can_be_rewound(tmp_path):
    run, psnr = RunFolder.create(tmp_path, IDENTITY), Identity.parse("psnr/pooled/range1/body/v1")
    assert run.curve() == []
    for seconds in (2.0, 4.0, 8.0):
        run.add_curve_point(CurvePoint(int(seconds), seconds, {psnr: float("inf")}))
    run.add_curve_point(CurvePoint(4, 5.0, {}))  # a resumed fit comes by again
    assert [(point.step, point.seconds) for point in run.curve()] == [(2, 2.0), (4, 5.0)]
    assert run.curve()[0].scores[psnr] == float("inf")
    (run.path / "curve.jsonl").write_text("{}\n")
    run.add_curve_point(CurvePoint(9, 9.0, {}))  # the fit goes on beside a damaged file
    assert [point.step for point in run.curve()] == [9]
    assert "'step' is missing" in run.record.warnings[0]


def test_warnings_are_kept_once(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)
    run.warn("slow")
    run.warn("slow")
    assert RunFolder.open(run.path).record.warnings == ("slow",)


# --- locks ---

HOLD = (
    "import sys, time; from pathlib import Path; from ihbench.record.store import RunFolder\n"
    "with RunFolder.open(Path(sys.argv[1])).lock():\n"
    "    print('held', flush=True); time.sleep(60)"
)


def test_two_processes_cannot_write_one_run_and_a_dead_one_is_not_in_the_way(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "WAIT", 0.0)
    run = RunFolder.create(tmp_path, IDENTITY)
    with subprocess.Popen([sys.executable, "-c", HOLD, str(run.path)], stdout=subprocess.PIPE) as rival:
        assert rival.stdout is not None
        assert rival.stdout.readline() == b"held\n"
        with pytest.raises(BadInput, match=f"process {rival.pid}"), run.lock():
            pass
        rival.send_signal(signal.SIGKILL)
        rival.wait()
    assert str(rival.pid) in (run.path / "lock.owner").read_text()  # what the dead one left
    with run.lock():
        assert str(os.getpid()) in (run.path / "lock.owner").read_text()
    assert not (run.path / "lock.owner").exists()


def test_a_lock_is_released_by_an_error_too(tmp_path):
    run = RunFolder.create(tmp_path, IDENTITY)

    def fails():
        with run.lock():
            raise RuntimeError

    for _ in range(2):
        with pytest.raises(RuntimeError):
            fails()


def test_the_lock_shows_what_a_rival_finished_meanwhile_and_clears_its_strays(tmp_path):
    ours, rival = RunFolder.create(tmp_path, IDENTITY), RunFolder.create(tmp_path, IDENTITY)
    rival.set_status("done")
    strays = [".scores.jsonl.1.0123abcd.tmp", "renders/1/.000000.png.17.89abcdef.tmp"]
    others = [".notes.tmp", ".a.1.xyz.tmp", "renders/1/.vim.tmp"]
    for name in (*strays, *others):
        (ours.path / name).parent.mkdir(parents=True, exist_ok=True)
        (ours.path / name).write_text("half")
    (ours.path / ".folder.1.0123abcd.tmp").mkdir()
    assert not ours.finished
    with ours.lock():
        assert ours.finished
        assert [name for name in (*strays, *others) if (ours.path / name).exists()] == others


def test_importing_the_store_is_cheap():
    heavy = "{'torch', 'cv2', 'rich', 'numba', 'pandas'}"
    code = f"import sys; import ihbench.metrics, ihbench.record.index; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_page_on_the_run_folder_names_every_file_and_field():
    def names(kind):
        own = get_type_hints(kind) if is_dataclass(kind) and not hasattr(kind, "parse") else {}
        parts = own.values() if own else get_args(kind)
        return {*own}.union(*map(names, parts)) - {"more"}

    page = Path(schema.__file__).parents[1].joinpath("RECORD.md").read_text(encoding="utf-8")
    stored = names(RunRecord | ScoreLine | PresetHead | CurvePoint) | store.WRITTEN[""]
    assert [name for name in sorted(stored) if f"`{name}`" not in page] == []
    assert len(stored) > 80
