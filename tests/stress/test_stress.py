"""The stress set: what a case is, what becomes of it, and that a broken kernel makes a named one fail."""

from __future__ import annotations

import json
import math
import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from ihbench.cli import main
from ihbench.clock.events import RolledBack
from ihbench.clock.ledger import Ledger
from ihbench.errors import BadInput, Diverged
from ihbench.metrics import ssim as ssim_function
from ihbench.render.splats import Preset
from ihbench.scene.method_spec import usable_specs
from ihbench.stress import run
from ihbench.stress.case import Answer, Case, error_of, words_of
from ihbench.stress.ranking import flips
from ihbench.stress.run import all_cases, chosen_cases, run_case, run_cases
from ihbench.stress.table import failures, summary
from ihbench.stress.training import story_of_fit

OK = Case("fine", "a law", lambda: Answer(1.2, 1.0), "absolute", 0.5, "it is so", "metrics")


@pytest.fixture(scope="module")
def cases():
    return {case.name: case for case in all_cases()}


# ------------------------------------------------------------------------------------------------ the set


def test_the_set_is_large_named_versioned_and_reasoned(cases):
    listed = all_cases()
    assert len(listed) == len(cases) >= 80, "two cases of one name"
    groups = [case.group for case in listed]
    assert set(groups) == set(run.GROUPS)
    assert all(groups.count(group) >= 10 for group in run.GROUPS)
    assert groups == sorted(groups, key=run.GROUPS.index)
    for case in listed:
        assert case.version >= 1
        assert case.what
        assert case.why
        assert case.tolerance >= 0
        assert case.unit != "words" or case.tolerance == 0


def test_a_method_brings_its_own_cases(cases):
    own = [case for spec in usable_specs() for case in spec.load(spec.stress, list)]
    assert {case.name for case in own} <= set(cases)
    assert {f"inpainthuman-rate-{factor}" for factor in (0.1, 1, 10, 100)} <= {case.name for case in own}


QUICK_GROUPS = ("geometry", "splat")


def test_the_quick_groups_hold(cases):
    """Every case of them passes, or fails as its list of known failures says."""
    outcomes = run_cases(chosen_cases(QUICK_GROUPS))
    assert [f"{o.case.name}: {o.reason}" for o in failures(outcomes)] == []
    assert {o.case.name for o in outcomes if o.verdict == "known"} == {"rotation-sine-1e-300"}
    assert all(o.condition is None or o.condition >= 0 for o in outcomes)
    assert sum(o.condition is not None for o in outcomes) > 20


# ------------------------------------------------------------------------------------------------ mutations


def _verdicts(cases, *names):
    return [outcome.verdict for outcome in run_cases([cases[name] for name in names])]


def _unclamped(argument):
    return replace(argument, alpha_max=1.0) if isinstance(argument, Preset) else argument


def test_dropping_the_alpha_clamp_fails_a_named_case(cases, monkeypatch):
    """In either back end; the other cases of the clamp's kind fail with it, those of other kinds do not."""
    from ihbench.render import splat_numba, splat_reference

    for kernel, name in ((splat_numba, "draw_isotropic"), (splat_reference, "composite")):
        original = getattr(kernel, name)
        with monkeypatch.context() as patch:
            patch.setattr(kernel, name, lambda *a, draw=original: draw(*map(_unclamped, a)))
            assert _verdicts(cases, "splat-alpha-ceiling", "splat-huge", "splat-none") == [
                "failed",
                "failed",
                "passed",
            ]
    assert _verdicts(cases, "splat-alpha-ceiling") == ["passed"]


@pytest.mark.parametrize(
    ("field", "value", "case"), [("near", -math.inf, "splat-behind-near"), ("low_pass", 0.0, "splat-sub-pixel")]
)
def test_a_changed_preset_fails_a_named_case(cases, monkeypatch, field, value, case):
    from ihbench.render.splats import PRESETS

    monkeypatch.setitem(PRESETS, "opaque", replace(PRESETS["opaque"], **{field: value}))
    assert _verdicts(cases, case) == ["failed"]


@pytest.mark.parametrize(
    ("module", "name", "value", "case"),
    [
        ("ihbench.render.splat_numba", "T_STOP", 0.5, "splat-stack-thin"),
        ("ihbench.metrics.ssim", "K1", 0.02, "ssim-constant-uint8"),
        ("ihbench.render.zbuffer", "NEAR", -1.0, "triangle-behind-near"),
        ("ihbench.fit.optimisation", "MOST_ROLL_BACKS", 0, "inpainthuman-nan-loss-once"),
        ("ihbench.fit.optimisation", "EXPLODED", math.inf, "inpainthuman-rate-1000"),
    ],
)
def test_a_changed_constant_fails_a_named_case(cases, monkeypatch, module, name, value, case):
    monkeypatch.setattr(import_module(module), name, value)
    assert _verdicts(cases, case) == ["failed"]


def test_a_lost_series_fails_a_named_case(cases, monkeypatch):
    from ihbench.body import skinning

    monkeypatch.setattr(skinning, "SERIES_BELOW", -1.0)
    assert _verdicts(cases, "rotation-gradient-zero", "rotation-gradient-pi") == ["failed", "passed"]


def test_leaking_windows_fail_a_named_case(cases, monkeypatch):
    from ihbench.stress import metrics

    monkeypatch.setitem(metrics.METRICS, "ssim", lambda x, y, mask: ssim_function(x, y, mask, background=None))
    assert _verdicts(cases, "ssim-nan-outside", "psnr-nan-outside") == ["failed", "passed"]


# ------------------------------------------------------------------------------------------------ errors and verdicts


@pytest.mark.parametrize(
    ("unit", "answer", "error"),
    [
        ("absolute", Answer([1.0, 5.0], [1.0, 2.0]), 3.0),
        ("absolute", Answer(math.nan, math.nan), 0.0),
        ("absolute", Answer(math.inf, math.inf), 0.0),
        ("absolute", Answer(math.inf, -math.inf), math.inf),
        ("absolute", Answer(math.nan, 1.0), math.inf),
        ("absolute", Answer(1.0, math.nan), math.inf),
        ("relative", Answer(11.0, 10.0), 0.1),
        ("relative", Answer(1e-9, 0.0), math.inf),
        ("relative", Answer(0.0, 0.0), 0.0),
        ("relative", Answer(3.0, 1.0, scale=4.0), 0.5),
        ("ulp", Answer(1 + 3 * 2.0**-52, 1.0), 3.0),
        ("ulp", Answer(1 + 2.0**-23, 1.0, precision=np.float32), 1.0),
        ("ulp", Answer(2.0**-60, 0.0, scale=1.0), 2.0**-8),
        ("at most", Answer(0.5, 1.0), 0.0),
        ("at most", Answer(1.5, 1.0), 0.5),
        ("at most", Answer(math.nan, 1.0), math.inf),
        ("words", Answer("it was refused, so", "was refused"), 0.0),
        ("words", Answer("it was taken", "was refused"), math.inf),
        ("absolute", Answer(np.zeros((2, 3)), np.zeros(4)), math.inf),
        ("absolute", Answer(np.zeros(0), 1.0), 0.0),
    ],
    ids=str,
)
def test_errors(unit, answer, error):
    assert error_of(answer, unit)[0] == pytest.approx(error, rel=1e-12)


def test_the_value_shown_is_the_worst_one():
    assert error_of(Answer([1.0, 9.0, 3.0], [1.0, 2.0, 3.5]), "absolute") == (7.0, 9.0, 2.0)


def test_a_case_beyond_its_tolerance_fails_or_is_known():
    assert (run_case(OK).verdict, run_case(OK).error) == ("passed", pytest.approx(0.2))
    beyond = replace(OK, tolerance=0.1)
    assert (run_case(beyond).verdict, run_case(beyond).reason) == ("failed", "error 0.2 beyond 0.1 (absolute)")
    known = replace(beyond, known="nobody minds")
    assert run_case(known).verdict == "known"
    assert run_case(known).reason.startswith("nobody minds [error 0.2")
    passes = replace(OK, known="nobody minds")
    assert (run_case(passes).verdict, run_case(passes).note) == ("passed", "listed as known to fail, but passes")


def test_exceptions_and_warnings_are_failures():
    crash = replace(OK, function=lambda: 1 / 0)  # pyright: ignore
    assert run_case(crash).reason == "raised ZeroDivisionError: division by zero"
    assert run_case(replace(crash, known="nobody minds")).verdict == "failed"  # what is known is an answer, no crash

    def warns():
        warnings.warn("0/0", RuntimeWarning, stacklevel=1)
        return Answer(1.0, 1.0)

    assert run_case(replace(OK, function=warns)).reason == "raised RuntimeWarning: 0/0"
    assert run_case(replace(OK, function=warns, known="overflows")).verdict == "known"
    assert words_of(BadInput, lambda: None) == "was not refused"
    with pytest.raises(ZeroDivisionError):
        words_of(BadInput, lambda: 1 / 0)


def test_flips_are_pairs_whose_order_is_reversed():
    before = {"a": 3.0, "b": 2.0, "c": 1.0}
    assert [str(f) for f in flips(before, {"a": 3.0, "b": 1.0, "c": 2.0}, "psnr")] == [
        "psnr: b (2 → 1) and c (1 → 2)"
    ]
    assert len(flips(before, {"a": 1.0, "b": 2.0, "c": 3.0}, "flip")) == 3
    assert flips(before, {"a": 9.0, "b": 9.0, "c": 0.0}, "psnr") == []
    assert flips({"a": 1.0, "b": 1.0}, {"a": 2.0, "b": 1.0}, "psnr") == []
    assert [f.before[0][0] for f in flips(before, {"a": 1.0, "b": 1.5, "c": 1.2}, "flip")] == ["b", "c"]


def test_the_story_of_a_fit():
    ledger = Ledger()
    assert story_of_fit(lambda: 7, ledger) == (7, "no step rejected")
    ledger.event(RolledBack("s", 0, "…", 9))

    def diverges():
        raise Diverged(12, "loss is nan")

    assert story_of_fit(diverges, ledger) == (
        None,
        "step 9 rejected, back to 0; diverged, first bad step 12: loss is nan",
    )


# ------------------------------------------------------------------------------------------------ the command


@pytest.fixture
def two_cases(monkeypatch):
    """The set, for once, is one case that passes and one that is known to fail."""
    found = [OK, replace(OK, name="off", group="data", tolerance=0.1, known="nobody minds")]
    monkeypatch.setattr(run, "all_cases", lambda: list(found))
    return found


def test_the_command_prints_every_case_and_ends_well(two_cases, capsys):
    assert main(["stress"]) == 0
    out = capsys.readouterr().out
    assert "2 cases (metrics 1, data 1): 1 passed, 1 known to fail, 0 failed, in " in out
    assert "known: off: nobody minds [error 0.2 beyond 0.1 (absolute)]" in out
    assert "allowed up to 0.5 abs: it is so" in out
    assert "KNOWN" in out


def test_workers_bring_outcomes_in_the_cases_order(two_cases, monkeypatch, capsys):
    """CI has real ones; here a process is a thread."""
    monkeypatch.setattr(run, "ProcessPoolExecutor", lambda workers, context, initializer: ThreadPoolExecutor(workers))
    run._by_name.cache_clear()
    one, told = [{**o.row(), "seconds": 0} for o in run_cases(two_cases)], []
    several = run_cases(two_cases, told.append, workers=2)
    assert [{**o.row(), "seconds": 0} for o in several] == one
    assert [o.case for o in several] == two_cases, "with their functions"
    assert told == several
    assert main(["stress", "--workers", "2"]) == 0
    assert "2 cases (metrics 1, data 1): 1 passed, 1 known to fail" in capsys.readouterr().out
    run._by_name.cache_clear()
    assert pickle.dumps(run._run_named("fine")), "what comes back has no function of a method"
    run._by_name.cache_clear()


def test_the_command_ends_with_1_when_a_case_fails(two_cases, capsys):
    two_cases[1] = replace(two_cases[1], known="")
    assert main(["stress", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert told["ok"] is False
    assert [case["verdict"] for case in told["cases"]] == ["passed", "failed"]
    expected = {"name", "version", "group", "value", "expected", "error", "unit", "condition", "tolerance", "why"}
    assert expected <= set(told["cases"][0])
    assert main(["stress", "metrics"]) == 0
    assert main(["stress", "--case", "fine"]) == 0


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["metric"], "stress group 'metric': did you mean 'metrics'?"),
        (["--case", "offf"], "stress case 'offf': did you mean 'off'?"),
        (["metrics", "--case", "off"], "stress case 'off': known: fine"),
    ],
)
def test_unknown_names_are_refused(two_cases, capsys, argv, words):
    assert main(["stress", *argv]) == 2
    assert words in capsys.readouterr().err


def test_the_summary_counts():
    outcomes = [run_case(OK), run_case(replace(OK, tolerance=0.0)), run_case(replace(OK, tolerance=0.0, known="x"))]
    assert summary(outcomes) == "3 cases (metrics 3): 1 passed, 1 known to fail, 1 failed"
