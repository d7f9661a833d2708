"""`ihbench ablate`: the runs that a suite means, what they share, what a failed one leaves of the others."""

from __future__ import annotations

import json
import os
import signal
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ihbench.clock.events import RolledBack, Warned
from ihbench.clock.ledger import Ledger
from ihbench.clock.machine import Machine
from ihbench.clock.progress import Progress
from ihbench.commands import ablate as ablate_command
from ihbench.commands.ablate import AblateOptions
from ihbench.config_fields import flat
from ihbench.errors import BadInput
from ihbench.files.atomic import read_json
from ihbench.methods.inpainthuman.config import PROFILES, QUICK
from ihbench.methods.inpainthuman.method import InpaintHuman
from ihbench.methods.inpainthuman.spec import SPEC, STAGE1
from ihbench.methods.inpainthuman.studies.ablations import SUITES
from ihbench.metrics import Identity
from ihbench.record.results import read_result
from ihbench.record.schema import CurvePoint
from ihbench.record.store import RunFolder
from ihbench.runner import executor as cells_module
from ihbench.runner.ablation import (
    AblationSuite,
    Comparison,
    Variant,
    configured,
    grid,
    kept,
    set_on_all,
    shared_part,
)
from ihbench.runner.executor import Cell, run_cells
from ihbench.runner.run_loop import RunRequest, _planned
from ihbench.runner.shared_states import reusable_run, reuse_state
from ihbench.scene.data_source import DataSource
from ihbench.scene.plan import LEAST_TEXELS, SceneMeasure
from ihbench.scene.protocol import load_protocol
from tests.conftest import SCENES
from tests.reports.fake_runs import about, identity, record

TINY = ["texels=32", "levels=16", "decoder_width=32", "position_map=16"]


@pytest.fixture
def moving():
    return SceneMeasure(1, 0, 1, 0, 1, 0.1, 0, motion_deg=50, turn_deg=0, pixel_mm=3, surface_mm=1500, occlusion={})


def ablate(bench, *words, on=("inpaint.on=off",)):
    return bench(
        *("ablate", "--protocol", bench.protocol, "--runs", bench.runs, "--workers", "0"),
        *("--set", *TINY, *on), *words,
    )  # fmt: skip


# ----------------------------------------------------------------------------------------------------- ladders


def test_a_grid_is_every_combination_and_compares_with_the_first():
    suite = grid(QUICK, {"levels": [(64,), (64, 128)], "inpaint.on": [True, False]})
    assert [dict(variant.switches) for variant in suite.variants] == [
        {"levels": levels, "inpaint.on": on} for levels in ((64,), (64, 128)) for on in (True, False)
    ]
    assert {c.without for c in suite.comparisons} == {"levels=64, inpaint.on=True"}
    assert len(suite.comparisons) == 3
    with pytest.raises(BadInput, match="no such switch"):
        grid(QUICK, {"level": [1]})


def test_a_grid_names_every_combination_apart():
    assert [variant.name for variant in grid(QUICK, {"steps": [100, 200]}).variants] == ["steps=100", "steps=200"]
    with pytest.raises(BadInput, match="stands there twice"):
        grid(QUICK, {"steps": [100, 200, 100]})
    many = {"inpaint.sampler_steps": [6, 12], "inpaint.key_views": [20], "refine.warm_up": [0.1, 0.2]}
    names = [variant.name for variant in grid(QUICK, many).variants]
    assert len(set(names)) == 4
    assert names[0] == "inpaint.sampler_steps=6, refine.warm_up=0.1"  # what does not vary is no name
    long = {f"inpaint.{name}": [3e-4, 1.23456789e-4] for name in ("ti_lr", "lora_lr", "control_lr")}
    names = [variant.name for variant in grid(QUICK, long).variants]
    assert len(set(names)) == 8
    assert max(map(len, names)) < 70


def test_what_is_compared_is_kept_from_the_plan():
    """A variant has what it says, also where it says what the profile has anyway."""
    suite = grid(QUICK, {"texels": [QUICK.texels, 2 * QUICK.texels], "inpaint.on": [True]})
    assert [kept(suite, variant, QUICK) for variant in suite.variants] == [("inpaint.on", "texels"), ("inpaint.on",)]
    suite = SUITES["table2"]
    full = suite.variants[-1]
    assert set(kept(suite, full, QUICK)) == {"levels", "one_fit", "inpaint.on", "inpaint.ti", "inpaint.sg"}
    plan = SUITES["plan"]
    assert [kept(plan, variant, QUICK) for variant in plan.variants] == [("all",), ()]


@pytest.mark.parametrize(("keep", "texels"), [((), 32), (("texels",), QUICK.texels)])
def test_the_plan_changes_only_what_nobody_has_set(moving, keep, texels):
    far = replace(moving, pixel_mm=1000.0)
    own = replace(QUICK, levels=(128, 256))
    request = RunRequest(load_protocol("zju_occ"), "inpainthuman", own, keep=keep)
    config, left_out, withheld = _planned(request, far)
    assert withheld == list(keep)
    assert _planned(replace(request, keep=("channels",)), far)[2] == []  # nothing wanted to change it
    assert config.levels == (128, 256)
    assert config.texels == (LEAST_TEXELS if texels == 32 else texels)
    assert "levels" not in [o.field for o in left_out]


def test_a_ladder_compares_its_own_rungs_only():
    with pytest.raises(ValueError, match="does not have"):
        AblationSuite("x", (Variant("a"),), (Comparison("what", "a", "b"),))
    with pytest.raises(ValueError, match="different names"):
        AblationSuite("x", (Variant("a"), Variant("a")), ())


def test_what_is_set_on_all_does_not_overrule_a_rung():
    suite = set_on_all(AblationSuite("x", (Variant("a"), Variant("b", {"steps": 7})), ()), {"steps": 3, "texels": 32})
    assert [configured(variant, QUICK).steps for variant in suite.variants] == [3, 7]
    assert {configured(variant, QUICK).texels for variant in suite.variants} == {32}


@pytest.mark.parametrize("name", SUITES)
@pytest.mark.parametrize("profile", PROFILES)
def test_every_rung_of_the_method_is_a_configuration_of_its_own(name, profile):
    suite = SUITES[name]
    found = [configured(variant, PROFILES[profile]) for variant in suite.variants]
    keys = {(tuple(flat(config).items()), one.keep) for config, one in zip(found, suite.variants, strict=True)}
    assert len(keys) == len(found)


def test_the_papers_rungs_share_their_first_stage_by_the_maps_they_have():
    suite = SUITES["table2"]
    free = SPEC.shared_states[STAGE1]
    keys = {variant.name: shared_part(configured(variant, QUICK), free) for variant in suite.variants}
    assert len(set(keys.values())) == 3  # the one fit is another stage 1
    assert keys["one level"] == keys["one level, diffusion"] != keys["MS"] == keys["MS + TI + SG"]


# ----------------------------------------------------------------------------------------------------- the command


def test_two_rungs_on_two_scenes_from_the_runs_to_the_table(bench, tmp_path, monkeypatch):
    """One test, because its four runs are dear: the numbers, the JSON, the second call, a cell that fails."""
    out = tmp_path / "out"
    words = ("--vary", "steps=2:6", "--seed", "0", "--scene", *SCENES, "--out", out)
    outcome = ablate(bench, *words)
    assert outcome.status == 0, outcome.err
    the_table_holds_the_means_of_its_runs(bench, outcome, out)
    assert json.loads(ablate(bench, *words, "--json").out) == read_json(out / "ablation.json")
    what_is_finished_is_not_done_again(bench, words, outcome, monkeypatch)
    a_failed_cell_does_not_take_the_others_along(bench, monkeypatch)


def the_table_holds_the_means_of_its_runs(bench, outcome, out):
    numbers = read_json(out / "ablation.json")
    (table,) = numbers["tables"]
    assert list(table["rungs"]) == ["steps=2", "steps=6"]
    runs = [read_result(folder) for folder in bench.folders()]
    assert len(runs) == 4
    for steps in (2, 6):
        own = [run for run in runs if run.identity.config["steps"] == steps]
        assert {run.scene for run in own} == set(SCENES)
        for name, score in table["rungs"][f"steps={steps}"]["scores"].items():
            expected = sum(run.own[Identity.parse(name)].value for run in own) / 2
            assert score["mean"] == pytest.approx(expected)
    (comparison,) = table["comparisons"]
    first = next(iter(comparison["scores"]))
    before, after = (table["rungs"][f"steps={s}"]["scores"][first]["mean"] for s in (2, 6))
    assert comparison["scores"][first]["mean"] == pytest.approx(after - before)
    assert outcome.out == (out / "ablation.md").read_text(encoding="utf-8")
    assert "stand-in" in outcome.out


def what_is_finished_is_not_done_again(bench, words, before, monkeypatch):
    with monkeypatch.context() as planted:
        planted.setattr(InpaintHuman, "fit", lambda *_, **__: pytest.fail("fitted again"))
        again = ablate(bench, *words)
    assert again.status == 0
    assert again.out == before.out


def a_failed_cell_does_not_take_the_others_along(bench, monkeypatch):
    honest = InpaintHuman.fit

    def fit(self, training, **more):
        if training.name == SCENES[0]:
            raise RuntimeError("a planted fault")
        return honest(self, training, **more)

    monkeypatch.setattr(InpaintHuman, "fit", fit)
    outcome = ablate(bench, "--vary", "steps=2:3", "--seed", "0", "--scene", *SCENES)
    assert outcome.status == 1
    assert "| steps=3 | 1 | 1 of 2 |" in outcome.out
    assert f"{SCENES[0]} seed 0, steps=3: failed: RuntimeError: a planted fault (see {bench.runs}" in outcome.out
    assert "| steps=2 | 2 | 2 |" in outcome.out


def test_a_scene_that_cannot_be_opened_does_not_take_the_others_along(bench, monkeypatch):
    honest = DataSource.open

    def opened(self, scene, *more):
        if scene == SCENES[0]:
            raise BadInput(f"{scene}: a planted fault")
        return honest(self, scene, *more)

    monkeypatch.setattr(DataSource, "open", opened)
    outcome = ablate(bench, "--vary", "steps=2", "--seed", "0", "--scene", *SCENES)
    assert outcome.status == 1
    assert "| steps=2 | 1 | 1 of 2 |" in outcome.out
    assert f"{SCENES[0]}: a planted fault" in outcome.out


def test_a_rung_can_keep_what_the_plan_would_leave_out(bench):
    """And shares nothing with one that does not keep it."""
    suite = SUITES["plan"]
    chosen = AblateOptions(protocol=str(bench.protocol), scene=(SCENES[0],), seed=(0, 1), runs=bench.runs)
    with bench.in_its_world():
        cells = ablate_command._cells(chosen, suite, Progress.silent())
    assert [variant for variant, _ in cells] == ["everything", "planned"] * 2
    assert [cell.request.keep for _, cell in cells] == [("all",), ()] * 2
    assert [(c.request.config.cull, c.request.config.crop) for _, c in cells] == [(False, False), (True, True)] * 2
    assert [cell.request.seed for _, cell in cells] == [0, 0, 1, 1]
    assert all(cell.request.share and cell.after is None for _, cell in cells)


def test_rungs_that_begin_alike_share_their_first_stage_and_its_seconds(bench):
    """With and without sharing the scores are the same to the last bit."""
    words = ("--vary", "refine.steps=0:4", "--seed", "0", "--scene", SCENES[0])
    painted = ("steps=6", "inpaint.filler=mirror", "inpaint.key_views=2")
    apart = replace(bench, runs=bench.runs.parent / "apart")
    assert ablate(bench, *words, on=painted).status == 0
    alone = ("--vary", "refine.steps=4", *words[2:])
    assert ablate(apart, *alone, "--no-share", on=painted).status == 0
    mine, other = bench.folders()[1], apart.folders()[0]
    assert (mine / "scores.jsonl").read_bytes() == (other / "scores.jsonl").read_bytes()
    steps = [[point.step for point in RunFolder.open(folder).curve()] for folder in (mine, other)]
    assert steps[0][-1] == steps[1][-1]
    events = [{e["kind"]: e["data"] for e in read_json(f / "run.json")["ledger"]["events"]} for f in bench.folders()]
    assert "shared" not in events[0]
    assert events[1]["shared"] == {"state": "stage1", "run": read_json(bench.folders()[0] / "run.json")["digest"]}
    stages = [read_json(folder / "run.json")["ledger"]["stages"] for folder in bench.folders()]
    assert stages[1]["fit/stage1"]["seconds"] >= 0.5 * stages[0]["fit/stage1"]["seconds"]


def test_nothing_is_lent_across_clocks_or_other_beginnings(tmp_path):
    """A state brings its seconds along: they must be of such a machine, with as many threads."""
    here = Machine(cpu="one", torch_threads=1)

    def run(name, machine=here, status="done", **config):
        own = identity("a", "m", config={"steps": 3, "inpaint": {"on": True}, "keep": [], **config})
        return RunFolder(tmp_path / name, record(own, about(), status, machine=machine))

    def found(lending):
        Ledger(tmp_path / "lends").save_state("stage1", {"x": np.zeros(3)}, {"step": 600})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(RunFolder, "open", lambda path: lending)
            return reusable_run(tmp_path, run("borrows", keep=["inpaint.on"]), "stage1", ("inpaint.",), here)

    good = run("lends", inpaint={"on": False})
    assert found(good) is good
    for change in ({"torch_threads": 2}, {"cpu": "two"}, {"gpu": "some"}):
        assert found(run("lends", replace(here, **change))) is None
    assert found(run("lends", steps=4)) is None
    assert found(run("lends", keep=["levels"])) is None
    assert found(run("lends", status="failed")) is None


def test_what_happened_in_a_lent_stage_is_told_of_the_borrower_too(tmp_path):
    """And nothing that happened later in the lender."""
    lender, borrower = tmp_path / "lender", tmp_path / "borrower"
    ledger = Ledger(lender)
    ledger.event(RolledBack("stage1", 25, "…", 30))
    ledger.save_state("stage1", {"x": np.zeros(3)}, {"step": 600})
    ledger.event(RolledBack("stage3", 650, "…", 651))
    ledger.event(Warned("it rains"))
    points = [CurvePoint(step, 1.0, {}) for step in (300, 600, 700)]
    other = SimpleNamespace(path=lender, record=SimpleNamespace(events=ledger.events), curve=lambda: points)
    borrower.mkdir()
    events = reuse_state(other, SimpleNamespace(path=borrower), "stage1")  # pyright: ignore
    assert [(event.kind, event.data["step"]) for event in events] == [("rolled_back", 25)]
    assert Ledger(borrower).load_state("stage1")[1] == {"step": 600}  # pyright: ignore
    assert len((borrower / "curve.jsonl").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--vary", "levls=64"), "levls=64: no such switch of inpainthuman: did you mean 'levels'"),
        (("--vary", "steps=many"), "steps"),
        (("--vary", "inpaint.on=perhaps"), "inpaint.on=perhaps: expected on or off"),
        (("--vary", "steps=1,2"), "steps=1,2: expected one value; --vary steps=1:2 is several"),
        (("--vary", "steps"), "--vary steps: expected NAME=VALUE"),
        (("--vary", "steps=1", "--ladder", "levels"), "--ladder levels with --vary: expected one of the two"),
        (("--ladder", "tabel2"), "--ladder tabel2: did you mean 'table2'"),
        (("--ladder", "levels", "--seed", "-1"), "--seed -1"),
        (("--ladder", "levels", "--workers", "-1"), "--workers -1: expected 0 to 1024"),
    ],
)
def test_bad_words_are_refused_in_one_line(bench, words, said):
    outcome = bench("ablate", "--protocol", bench.protocol, "--runs", bench.runs, *words)
    assert outcome.status == 2
    assert said in outcome.err
    assert not bench.runs.exists()


# ----------------------------------------------------------------------------------------------------- processes


def a_child(connection, request, source, scene, threads):
    """What a process does in these tests: `scene` says it."""
    assert os.environ["OMP_NUM_THREADS"] == str(threads)
    if scene == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if scene == "silent":
        os._exit(3)
    connection.send((None, f"said {scene} {request}"))


def test_every_process_has_an_outcome_and_cells_wait_for_those_they_follow(monkeypatch):
    monkeypatch.setattr(cells_module, "_child", a_child)
    asked = [("killed", None), ("silent", None), ("b", 0)]
    made = [Cell(scene, k, None, scene, after) for k, (scene, after) in enumerate(asked)]  # pyright: ignore
    order = []
    progress = SimpleNamespace(task=Progress.silent().task, say=order.append)
    outcomes = run_cells(made, 2, 3, progress)  # pyright: ignore
    assert [o.problem for o in outcomes] == [
        "its process was killed by signal 9", "its process ended with status 3", "said b 2",
    ]  # fmt: skip
    assert not any(o.done for o in outcomes)
    names = [line.partition(":")[0] for line in order]
    assert names.index("b") > names.index("killed")


def test_a_cell_cannot_wait_for_a_later_one():
    with pytest.raises(ValueError, match="earlier cell"):
        run_cells([Cell("a", None, None, "a", 0)], 1, 1, Progress.silent())  # pyright: ignore
