"""The ablation table: what is paired, what can be significant, what seconds may be compared."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from ihbench.clock.events import LeftOut
from ihbench.document.markdown import write as markdown
from ihbench.reports.general.ablation import write
from ihbench.runner.ablation import AblationSuite, Comparison, Variant
from ihbench.scene.plan import Omission
from tests.reports.fake_runs import with_about, with_events
from tests.reports.made_up_runs import made_up

SCENES = tuple("abcdef")
IDENTITY = "psnr/pooled/range1/hidden/v1"


def told(runs, comparisons=(("step", "low", "high"),)):
    """The text and numbers of made-up runs by variant."""
    variants = tuple(Variant(name) for name in runs)
    suite = AblationSuite("made up", variants, tuple(Comparison(*c) for c in comparisons))
    request = SimpleNamespace(protocol=SimpleNamespace(name="p@1", profile="quick"), method="ours")
    cell = SimpleNamespace(request=request, name="a cell")
    found = [
        (variant, SimpleNamespace(cell=cell, result=run, done=run is not None, problem="lost"))
        for variant, having in runs.items()
        for run in having
    ]
    blocks, numbers = write(suite, found)  # pyright: ignore
    return markdown(blocks), numbers["tables"][0]


def variant(tmp_path, psnr, scenes=SCENES, seeds=(0,), **more):
    return [made_up(tmp_path, s, psnr=psnr + k + n, seed=n, **more) for k, s in enumerate(scenes) for n in seeds]


def test_a_difference_beyond_doubt_is_marked(tmp_path):
    text, table = told({"low": variant(tmp_path, 20), "high": variant(tmp_path, 22)})
    (row,) = table["comparisons"]
    assert row["scores"][IDENTITY]["mean"] == pytest.approx(2)
    assert "| step | 6 | +2.00\\* [" in text
    assert "nothing can be marked" not in text


def test_with_too_many_comparisons_for_the_scenes_it_says_so(tmp_path):
    runs = {name: variant(tmp_path, 20 + k) for k, name in enumerate(("low", "mid", "high"))}
    text, _ = told(runs, (("first", "low", "mid"), ("both", "low", "high")))
    assert "*" not in text.partition("What each component")[2].partition("[95%")[0]
    assert "no adjusted p can be below 0.062, so nothing can be marked" in text
    runs = {name: variant(tmp_path / "two", 20 + k, "ab") for k, name in enumerate(("low", "mid", "high"))}
    text, _ = told(runs, (("first", "low", "mid"), ("second", "mid", "high"), ("both", "low", "high")))
    assert "no adjusted p can be below 1, so nothing can be marked" in text


def test_what_one_rung_lost_is_not_compared(tmp_path):
    """Seed 1 is a decibel better in every scene; a variant that lost it in one scene is not worse for that."""
    high = variant(tmp_path, 20, seeds=(0, 1))
    low = [run for run in variant(tmp_path, 20, seeds=(0, 1)) if (run.scene, run.seed) != ("a", 1)]
    _, table = told({"low": [*low, None], "high": high})
    score = table["comparisons"][0]["scores"][IDENTITY]
    assert (score["mean"], score["low"], score["high"]) == pytest.approx((0, 0, 0))
    assert table["rungs"]["low"]["runs"] == 11


def test_one_scene_has_a_difference_without_interval(tmp_path):
    text, table = told({"low": variant(tmp_path, 20, "a", (0, 1)), "high": variant(tmp_path, 21.5, "a", (0, 1))})
    assert "| step | 1 | +1.50 |" in text
    assert "One scene: differences have no interval and no test." in text
    assert table["comparisons"][0]["scores"][IDENTITY]["p"] is None
    assert table["comparisons"][0]["fit_seconds"]["mean"] == 0


def test_seconds_are_compared_with_an_interval_and_as_a_share(tmp_path):
    low = [made_up(tmp_path, s, psnr=20, fit=200 + k) for k, s in enumerate(SCENES)]
    high = [made_up(tmp_path, s, psnr=20, fit=100 + 2 * k, seed=0) for k, s in enumerate(SCENES)]
    text, table = told({"low": low, "high": high})
    seconds = table["comparisons"][0]["fit_seconds"]
    assert seconds["mean"] == pytest.approx(-97.5)
    assert seconds["share"] == pytest.approx(-97.5 / 202.5)
    assert seconds["low"] < -97.5 < seconds["high"] < -90
    assert f"| -98 [{seconds['low']:+.0f}, {seconds['high']:+.0f}], -48% |" in text
    nothing = {"low": [made_up(tmp_path, "a", psnr=20, fit=0)], "high": [made_up(tmp_path, "a", psnr=20, fit=5)]}
    assert "| +5 |" in told(nothing)[0]
    a_little_less = {
        "low": [made_up(tmp_path, "a", psnr=20, fit=9.3)],
        "high": [made_up(tmp_path, "a", psnr=20, fit=9)],
    }
    assert "| +0, -3% |" in told(a_little_less)[0]


def test_seconds_of_two_clocks_are_not_compared(tmp_path):
    other = {"cpu": "a slower one", "load_average": (40.0, 1.0, 1.0)}
    text, table = told({"low": variant(tmp_path, 20, fit=100), "high": variant(tmp_path, 22, fit=400, machine=other)})
    assert table["comparisons"][0]["fit_seconds"] is None
    assert (table["rungs"]["low"]["fit_seconds"]["mean"], table["rungs"]["high"]["fit_seconds"]["mean"]) == (100, 400)
    assert "- machine B: a slower one, 4 cores; load average at the start 40.0 to 40.0" in text
    assert "unstable seconds: 6 of 6 runs on a busy machine (load up to 10.0 per core): high" in text
    mixed = variant(tmp_path, 20, "abc") + variant(tmp_path, 20, "def", machine=other)
    assert told({"low": mixed, "high": mixed})[1]["rungs"]["low"]["fit_seconds"] is None


def test_what_the_plan_left_out_of_a_rung_is_said(tmp_path):
    left_out = Omission("levels", [64, 128], "small"), Omission("never_seen", None, "no such surface")
    high = variant(tmp_path, 22)
    high[:2] = [with_about(run, left_out=left_out) for run in high[:2]]
    text, table = told({"low": variant(tmp_path, 20), "high": high})
    assert "- left out by the plan, high: levels → 64+128 in 2 of 6 runs\n" in text
    assert table["rungs"]["high"]["left_out"] == {"levels → 64+128": 2}


def test_what_a_fit_left_out_of_a_rung_is_said(tmp_path):
    high = [with_events(run, LeftOut("a term", "no weights")) for run in variant(tmp_path, 22)]
    text, _ = told({"low": variant(tmp_path, 20), "high": high})
    assert "- high: Left out by the fit: a term: no weights (all runs).\n" in text
