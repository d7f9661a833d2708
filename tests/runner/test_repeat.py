"""`ihbench run --like RUN`: a colleague's run from its record."""

from __future__ import annotations

import shutil

import pytest

from ihbench import registry
from ihbench.files.atomic import read_json, write_json
from ihbench.record import provenance
from ihbench.record.store import RunIdentity
from tests.conftest import contents


@pytest.fixture(scope="module")
def run_once(tmp_path_factory):
    """Where the run of `theirs` is kept: every test spoils a copy."""
    return tmp_path_factory.mktemp("theirs")


@pytest.fixture
def theirs(bench, mannequin, tmp_path, run_once):
    """A finished run of somebody else, with nothing left as the profile has it, and that alone."""
    if not any(run_once.iterdir()):
        words = ("--method.brightness", "0.3", "--seed", "5", "--occlusion.rule", "central-band",
                 "--occlusion.fraction", "0.3", "--train-frames", "0:300:100", "--image-size", "48",
                 "--keep", "brightness")  # fmt: skip
        assert bench.run(*words, method=mannequin).status == 0
        (folder,) = bench.folders()
        shutil.move(folder, run_once / folder.name)
    (folder,) = run_once.iterdir()
    return shutil.copytree(folder, tmp_path / "theirs" / folder.name)


SCORED = {"missing": [], "surplus": [], "notes": []}


def edit(folder, change):
    """Change a run's record, as a run of that identity would have written it."""
    record = read_json(folder / "run.json")
    change(record)
    record["digest"] = RunIdentity(**record["identity"]).digest
    write_json(folder / "run.json", record)


def like(bench, folder, *words):
    return bench("run", "--like", folder, "--runs", bench.runs, *words)


def test_a_run_is_repeated_from_its_record_alone(bench, theirs, tmp_path):
    before = contents(theirs)
    outcome = like(bench, theirs)
    assert outcome.status == 0, outcome.err
    (again,) = bench.folders()
    assert again.name == theirs.name
    assert (again / "scores.jsonl").read_bytes() == before["scores.jsonl"]
    assert "the same scores to the last bit" in outcome.err
    assert "\nmannequin " in outcome.out
    assert contents(theirs) == before
    (tmp_path / "theirs").rename(bench.runs / "moved")


def test_what_differs_is_said(bench, theirs):
    edit(theirs, lambda record: record["identity"].update(code="0.1.0+old", data="another copy"))
    edit(theirs, lambda record: record["provenance"]["packages"].update(numpy="1.0", magic="3"))
    (theirs / "scores.jsonl").write_text(
        (theirs / "scores.jsonl")
        .read_text()
        .replace('"psnr/pooled/range1/full/v1": ', '"psnr/pooled/range1/full/v1": 1')
    )
    outcome = like(bench, theirs)
    assert outcome.status == 0, outcome.err
    for line in (
        "code: 0.1.0+old there",
        "data: another copy there",
        "numpy: 1.0 there",
        "magic: 3 there, None here",
    ):
        assert f"repeated: {line}" in outcome.err
    assert "repeated: psnr/pooled/range1/full/v1: 1" in outcome.err


def test_a_run_that_lies_in_the_same_folder_is_found_and_said_to_be(bench, mannequin):
    assert bench.run(method=mannequin).status == 0
    (folder,) = bench.folders()
    outcome = like(bench, folder)
    assert (outcome.status, bench.folders()) == (0, [folder])
    assert "is that run itself" in outcome.err


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda record: record["identity"]["config"].update(colour=1),
            "--method.colour, which mannequin does not have",
        ),
        (lambda record: record["identity"]["config"].update(brightness="x"), "--method.brightness 'x'"),
        (lambda record: record["identity"].update(method="gone"), "unknown method 'gone'"),
        (lambda record: record["identity"].update(seed=2**70), "a whole number of more than 64 bits"),
        (lambda record: record["identity"].update(scene="nobody"), "unknown scene 'nobody'"),
        (lambda record: record["about"].update(protocol={}), "recorded protocol"),
        (
            lambda record: record["about"].update(predictions={"missing": [], "surplus": [], "notes": []}),
            "ihbench score",
        ),
    ],
)
def test_a_record_that_cannot_be_repeated_is_refused(bench, theirs, spoil, said):
    edit(theirs, spoil)
    outcome = like(bench, theirs)
    assert outcome.status == 2
    assert said in outcome.err
    assert not bench.folders()


@pytest.mark.parametrize("words", [("--seed", "1"), ("--method.brightness", "1"), ("--protocol", "zju_occ")])
def test_what_the_record_says_cannot_be_said_beside_it(bench, theirs, words):
    assert like(bench, theirs, *words).status == 2
    assert bench("run", "--like", theirs.parent).status == 2
    assert not bench.folders()


def test_the_record_has_the_command_without_folders_and_the_versions_of_others(
    bench, mannequin, monkeypatch, tmp_path
):
    monkeypatch.setattr(registry, "other_packages", lambda: {"pytest": "pytest"})
    assert bench.run("--seed", "1", method=mannequin).status == 0
    record = read_json(bench.folders()[0] / "run.json")
    command = record["about"]["command"]
    assert command[:2] == ["run", "--protocol"]
    assert command[-5:] == ["--method", mannequin, "--full", "--seed", "1"]
    assert str(tmp_path) not in " ".join(command)
    assert "…/runs" in command
    assert record["provenance"]["packages"]["pytest"] == pytest.__version__
    provenance.note_command(["run", "--data=/home/me/zju", "--out", "a/b/", "--method.inpaint.on"])
    assert provenance.command() == ("run", "--data=…/zju", "--out", "…/b", "--method.inpaint.on")


def test_the_version_says_what_computes(bench):
    out = bench("--version").out
    assert out.startswith(provenance.__version__)
    assert f"torch {provenance.package_versions()['torch']}" in out
