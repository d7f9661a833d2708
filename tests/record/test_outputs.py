"""What commands write where their user says: what somebody else put there stays."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from ihbench.cli import main
from ihbench.document import diagram
from ihbench.errors import BadInput
from ihbench.files import atomic
from ihbench.record import outputs
from tests.conftest import contents


def test_a_file_is_written_again_until_somebody_edits_it(tmp_path):
    path = tmp_path / "new" / "table.md"
    for text in ("one", "two", "two"):
        outputs.write_text(path, text)
    assert path.read_text() == "two"
    path.write_text("edited")
    with pytest.raises(BadInput, match=r"table\.md: is there already and not as ihbench wrote it; move it away"):
        outputs.write_text(path, "three")
    assert path.read_text() == "edited"
    outputs.write_text(path, "edited")  # what is there already is no loss
    path.unlink()
    outputs.write_text(path, "three")
    assert path.read_text() == "three"


def test_two_commands_in_one_folder_lose_nothing_of_each_others_list(tmp_path):
    code = (
        "import sys; from pathlib import Path; from ihbench.record import outputs\n"
        "for k in range(40): outputs.write_text(Path(sys.argv[1], f'{sys.argv[2]}-{k}'), sys.argv[2])"
    )
    both = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path), name]) for name in ("a", "b")]
    assert [process.wait(60) for process in both] == [0, 0]
    assert len(json.loads((tmp_path / outputs.LIST).read_text())) == 80


@pytest.mark.parametrize("words", ["", "{", "[]", '{"table.md": 3}', '{"table.md": ["0"]}'])
def test_a_damaged_list_vouches_for_nothing(tmp_path, words):
    outputs.write_text(tmp_path / "table.md", "one")
    (tmp_path / outputs.LIST).write_text(words)
    with pytest.raises(BadInput, match="not as ihbench wrote it"):
        outputs.write_text(tmp_path / "table.md", "two")
    outputs.write_text(tmp_path / "other.md", "x")


def test_a_kill_between_list_and_file_makes_a_stranger_of_neither(tmp_path, monkeypatch):
    path = tmp_path / "table.md"
    outputs.write_text(path, "one")
    write = atomic.write_bytes
    for failing in (path, tmp_path / outputs.LIST):
        calls = []

        def killed(target, data, durable=True, failing=failing, calls=calls):
            calls.append(target)
            if target == failing and calls.count(target) == (1 if failing == path else 2):
                raise KeyboardInterrupt
            write(target, data, durable=durable)

        monkeypatch.setattr(atomic, "write_bytes", killed)
        with pytest.raises(KeyboardInterrupt):
            outputs.write_text(path, "two")
        monkeypatch.undo()
        outputs.write_text(path, "three")
        assert path.read_text() == "three"


def test_links_and_streams(tmp_path):
    (tmp_path / "mine").write_text("x")
    (tmp_path / "table.md").symlink_to("mine")
    (tmp_path / "gone.md").symlink_to("nothing")
    os.mkdir(tmp_path / "folder.md")
    for name in ("table.md", "folder.md"):
        with pytest.raises(BadInput, match="not as ihbench wrote it"):
            outputs.write_text(tmp_path / name, "y")
    outputs.write_text(tmp_path / "gone.md", "y")
    (tmp_path / "null").symlink_to("/dev/null")
    outputs.write_text(tmp_path / "null", "y")
    assert (tmp_path / "mine").read_text() == "x"
    assert (tmp_path / "nothing").read_text() == "y"


def test_a_figure_of_the_users_stays(tmp_path):
    (tmp_path / "kernels.svg").write_text("drawn by hand")
    drawn, _ = diagram.figure()
    with pytest.raises(BadInput, match=r"kernels\.svg: is there already"):
        outputs.write_files(tmp_path / "kernels", diagram.files(drawn, [{"a": 1}]))
    assert (tmp_path / "kernels.svg").read_text() == "drawn by hand"
    for _ in range(2):
        outputs.write_files(tmp_path / "other" / "kernels", diagram.files(drawn, [{"a": 1}]))


@pytest.mark.parametrize(
    ("command", "file"),
    [
        (["ablate", "--protocol", "zju_occ", "--scene", "standin-1", "--vary", "steps=1:2"], "ablation.md"),
        (["paint", "--protocol", "zju_occ", "--scene", "standin-1"], "standin-1.png"),
        (["train-mini"], "README.md"),
        (["train-mini"], "unet/config.json"),
        (["train-mini"], "training/curve.jsonl.old"),
    ],
)
def test_long_work_does_not_begin_where_it_could_not_be_written(tmp_path, monkeypatch, capsys, command, file):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("IHBENCH_CACHE", str(tmp_path / "cache"))
    (tmp_path / "out" / file).parent.mkdir(parents=True)
    (tmp_path / "out" / file).write_text("mine")
    assert main([*command, "--out", "out"]) == 2
    assert "another folder" in capsys.readouterr().err
    assert contents(tmp_path) == {f"out/{file}": b"mine"}


def test_a_report_does_not_take_the_place_of_what_it_reads(bench_with_run, tmp_path):
    (run,) = bench_with_run.folders()
    before = contents(run)
    parts = ["run.json", "scores.jsonl", "avatar/avatar.safetensors", "contact_sheet.png", "lock", "../runs.sqlite"]
    assert bench_with_run("runs", "list", "--runs", bench_with_run.runs).status == 0
    (tmp_path / "link").symlink_to(run / "run.json")
    for path in (*(run / part for part in parts), tmp_path / "link"):
        for words in (["report", run], ["report", "table1", "--runs", bench_with_run.runs], ["export", run]):
            outcome = bench_with_run(*words, "--out", path)
            assert outcome.status == 2
            assert "is a part of" in outcome.err
    assert contents(run) == before
    assert bench_with_run("report", run, "--out", run / "report.md").status == 0
    assert bench_with_run("report", run, "--out", run / "report.md", "--format", "tex").status == 0


def test_parts_of_training_sets_and_stand_ins(tmp_path):
    (tmp_path / "set" / "images").mkdir(parents=True)
    (tmp_path / "set" / "images" / "a.png").touch()
    (tmp_path / "set" / "mine.md").touch()
    (tmp_path / "set" / "manifest.json").write_text(
        json.dumps({"made_by": "ihbench 1", "files": {"images/a.png": ""}})
    )
    (tmp_path / "cast" / "x").mkdir(parents=True)
    (tmp_path / "cast" / "x" / "y.png").touch()
    (tmp_path / "cast" / "STANDIN.json").write_text(json.dumps({"generator": "ihbench"}))
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "manifest.json").write_text(json.dumps({"files": ["report.md"]}))
    (tmp_path / "site" / "report.md").touch()
    for name in ("set/images/a.png", "cast/x/y.png"):
        with pytest.raises(BadInput, match="is a part of"):
            outputs.check_file(tmp_path / name)
    for name in ("set/mine.md", "site/report.md", "site/new.md", "none/new.md"):
        outputs.check_file(tmp_path / name)
    outputs.check_file(None)
    with pytest.raises(BadInput, match="which is only read"):
        outputs.check_file(tmp_path / "site" / "report.md", None, tmp_path / "site")
