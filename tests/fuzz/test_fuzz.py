"""A sample of the fuzz; `python -m tests.fuzz` does as much of it as one likes."""

import pytest

from tests.fuzz import options
from tests.fuzz.__main__ import faults

SAMPLE = {"readers": 330, "options": 120}  # for run folders see tests/record/test_damaged_runs.py


@pytest.mark.parametrize("kind", SAMPLE)
def test_a_sample_has_no_fault(kind, tmp_path):
    assert list(faults(kind, tmp_path, SAMPLE[kind], seed=0)) == []


def test_every_command_is_attacked_by_its_options():
    found = options.options()
    assert {option.command[0] for option in found} == {command[0] for command in options.commands()}
    assert {"--seed", "--method.steps", "--method.inpaint.on", "--occlusion.fraction", ""} <= {o.flag for o in found}
    assert ("report", "lint") in {option.command for option in found}


def test_the_fuzz_sees_what_is_wrong(tmp_path, monkeypatch):
    """A command that removes a file and ends in a traceback, and one that leaves something behind a refusal."""
    world = options.World.make(tmp_path)

    def remove(_argv):
        (tmp_path / "file.txt").unlink()
        raise KeyError("a fault")

    def leave(_argv):
        from ihbench.errors import BadInput

        (tmp_path / "folder" / "left").write_text("x")
        raise BadInput("no")

    with world.entered():
        for main, faults_found in ((remove, ["status 3", "file.txt was removed"]), (leave, ["left folder/left"])):
            monkeypatch.setattr("ihbench.commands.list.main", main)
            told = list(options.attack(world, ["list"], "x"))
            assert len(told) == len(faults_found)
            assert all(word in line for word, line in zip(faults_found, told, strict=True))
    assert (tmp_path / "file.txt").read_text() == "nor this"
