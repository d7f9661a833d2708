"""`ihbench run --method NAME NAME` and `--method all`: one row a method, whatever befalls one of them."""

import json
import re
from importlib.metadata import EntryPoint

import pytest

from ihbench import registry
from ihbench.files.atomic import read_json
from ihbench.runner.several_methods import alone
from tests.conftest import OWN_METHOD

SPECS = """
from dataclasses import dataclass
from ihbench.scene.method_spec import MethodSpec

@dataclass(frozen=True)
class Nothing:
    size: int = 1
    '''Of nothing.'''

def spec(name, profiles=("quick", "paper")):
    return MethodSpec(
        name=name, title=name, summary=name, method=f"unlucky.method:{name.title()}",
        profiles={profile: Nothing() for profile in profiles},
    )

PICKY, CLUMSY, PAPERONLY = spec("picky"), spec("clumsy"), spec("paperonly", ["paper"])
"""
METHODS = """
from ihbench.errors import BadInput, Diverged

class Picky:
    def __init__(self, config): pass
    def fit(self, training, **more): raise BadInput(f"scene {training.name}: wears no hat; picky fits hats")

class Clumsy(Picky):
    def fit(self, training, **more): raise Diverged(7, "the loss is nan")
"""


@pytest.fixture
def four(monkeypatch, tmp_path):
    """Four methods and no more: one that works, one that refuses every scene, one that diverges, one without the
    profile."""
    package = tmp_path / "unlucky"
    package.mkdir()
    for name, text in (("__init__", ""), ("spec", SPECS), ("method", METHODS)):
        (package / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.syspath_prepend(OWN_METHOD)
    values = {name: f"unlucky.spec:{name.upper()}" for name in ("clumsy", "paperonly", "picky")}
    values["mannequin"] = "own_method.spec:SPEC"
    points = {name: EntryPoint(name, value, registry.GROUPS["method"]) for name, value in values.items()}
    registered = registry._found
    monkeypatch.setattr(registry, "_found", lambda kind: points if kind == "method" else registered(kind))


def words(bench, *methods):
    return ["run", "--protocol", bench.protocol, "--runs", bench.runs, "--scene", "standin-1", "--method", *methods]


def test_every_method_has_a_row_and_none_takes_the_others_along(bench, four):
    outcome = bench(*words(bench, "all"))
    assert outcome.status == 1  # one diverged
    rows = [line.split()[0] for line in outcome.out.splitlines() if re.match(r"\S+( +(\d\S*|—|∞))+$", line)]
    assert rows[:5] == ["mannequin", "clumsy", "picky", "paperonly", "truth"], outcome.out
    numbers = {line.split()[0]: line.split()[1:] for line in outcome.out.splitlines() if line.split()[:1]}
    assert set(numbers["picky"]) == {"—"}
    assert 5 < float(numbers["mannequin"][0]) < 40
    told = " ".join(outcome.out.split())
    assert "not done: picky on standin-1: failed (scene standin-1: wears no hat; picky fits hats)" in told
    assert "not done: clumsy on standin-1: diverged" in told
    assert "the loss is nan" in told
    assert "not run: paperonly on standin-1: method 'paperonly': unknown profile 'quick'" in told
    records = {read_json(folder / "run.json")["identity"]["method"] for folder in bench.folders()}
    assert records == {"mannequin", "clumsy", "picky"}  # those that could be begun are on record


def test_named_methods_are_run_in_their_order_each_as_if_alone(bench, four):
    outcome = bench(*words(bench, "picky", "mannequin"), "--json")
    told = json.loads(outcome.out)
    assert [run["method"] for run in told["runs"]] == ["picky", "mannequin"]
    assert "not_run" not in told
    assert (outcome.status, told["status"]) == (1, "not done")
    (together,) = [folder for folder in bench.folders() if "mannequin" in folder.name]
    before = read_json(together / "run.json")
    again = json.loads(bench(*words(bench, "mannequin"), "--json").out)
    assert again["runs"][0]["folder"] == str(together)  # the same run: found, not repeated
    assert read_json(together / "run.json") == before


def test_what_is_not_run_is_in_the_json(bench, four):
    told = json.loads(bench(*words(bench, "mannequin", "paperonly"), "--seed", 0, 1, "--json").out)
    assert [(run["method"], run["seed"]) for run in told["runs"]] == [("mannequin", 0), ("mannequin", 1)]
    assert [(missing["method"], missing["seed"]) for missing in told["not_run"]] == [
        ("paperonly", 0),
        ("paperonly", 1),
    ]
    assert told["status"] == "not done"


@pytest.mark.parametrize(
    ("more", "line"),
    [
        (("mannequin", "picky", "--method.brightness", "0.1"), "--method.brightness: a switch of one method"),
        (("all", "--method.brightness=0.1"), "--method.brightness: a switch of one method"),
        (("all", "picky"), "all is every method; name it alone"),
        (("picky", "picky"), "--method"),
        (("picky", "manequin"), "did you mean 'mannequin'?"),
        (("picky", "mannequin", "--keep", "size"), "with several only --keep all"),
        (("picky", "mannequin", "--scene", "nobody"), "nobody"),
    ],
)
def test_what_cannot_be_meant_is_one_line_and_runs_nothing(bench, four, more, line):
    outcome = bench(*words(bench, *more))
    assert (outcome.status, outcome.out) == (2, "")
    assert line in outcome.err
    assert len(outcome.err.splitlines()) == 1
    assert not bench.folders()


def test_a_scene_that_no_method_can_have_is_bad_input(bench, four):
    """The reason is the protocol's, not the methods'."""
    outcome = bench(*words(bench, "mannequin", "picky"), "--train-frames", "0:2:1", "--test-frames", "9000:9001:1")
    assert outcome.status == 2
    assert "9000" in outcome.err
    assert len(outcome.err.splitlines()) <= 3  # what is being run, and one line


def test_help_of_run_says_what_all_is(bench, four):
    text = " ".join(bench("run", "--method", "mannequin", "--help").out.replace("│", " ").split())
    assert '"all": every registered one, a variant that is registered under a name of its own' in text


def test_the_record_names_the_command_of_its_own_method():
    line = ["run", "--protocol", "p", "--method", "a", "b", "--seed", "1"]
    assert alone(line, "b") == ("run", "--protocol", "p", "--method", "b", "--seed", "1")
    assert alone(["run", "--method=all", "--protocol=p"], "c") == ("run", "--method", "c", "--protocol=p")
    assert alone(["run", "--protocol", "p"], "c") == ("run", "--protocol", "p")
