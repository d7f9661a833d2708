"""The tutorial page as a newcomer follows it: its files make a package that runs, resumes, stands in the table."""

import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from ihbench import registry
from ihbench.clock.ledger import Ledger

PAGE = (Path(__file__).parent / "own_method.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"^```\w+\n# file: (\S+)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))


@pytest.fixture
def tutorial(tmp_path, monkeypatch):
    """The page's files, registered as installing them would."""
    for name, text in FILES.items():
        (tmp_path / "package" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "package" / name).write_text(text, encoding="utf-8")
    (tmp_path / "package/vertex_colours/__init__.py").touch()
    (name, value) = re.search(r'^(vertex-colours) = "(.*)"', FILES["pyproject.toml"], re.MULTILINE).groups()
    monkeypatch.syspath_prepend(tmp_path / "package")
    registered, point = registry._found, EntryPoint(name, value, registry.GROUPS["method"])
    monkeypatch.setattr(
        registry, "_found", lambda kind: registered(kind) | ({name: point} if kind == "method" else {})
    )
    return name


def scores(folder):
    return [json.loads(line) for line in (folder / "scores.jsonl").read_text(encoding="utf-8").splitlines()]


def test_the_page_runs_resumes_and_stands_in_the_table(bench, tutorial, monkeypatch):
    words = ("run", "--protocol", bench.protocol, "--scene", "standin-1", "--method", tutorial)
    whole = bench(*words, "--runs", bench.runs / "whole")
    assert whole.status == 0, whole.err
    assert tutorial in whole.out

    monkeypatch.setattr(Ledger, "due_to_save", lambda ledger: True)
    offer, offered = Ledger.offer, []

    def killed(ledger, step, *avatar, **more):
        offered.append(step)
        if offered == [1, 2, 3]:
            raise KeyboardInterrupt
        return offer(ledger, step, *avatar, **more)

    monkeypatch.setattr(Ledger, "offer", killed)
    assert bench(*words, "--runs", bench.runs / "killed").status == 130
    assert bench(*words, "--runs", bench.runs / "killed").status == 0
    assert offered[3:5] == [3, 4]  # the third step was done again, the first two were not
    (left_alone,), (continued,) = ((bench.runs / kind).glob("*vertex-colours*") for kind in ("whole", "killed"))
    assert scores(continued) == scores(left_alone)
    key = "psnr/pooled/range1/visible/v1"
    ours = [line["scores"][key] for line in scores(left_alone)]
    assert min(ours) > 12
