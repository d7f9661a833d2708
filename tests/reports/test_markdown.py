"""The Markdown tables: which runs share one, what a cell is the mean of, what is said beside the numbers."""

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from ihbench.clock.events import LeftOut, RolledBack, Warned
from ihbench.clock.machine import Machine
from ihbench.record.quality_time import Target
from ihbench.record.results import RunResult
from ihbench.record.schema import CurvePoint, PredictionFiles
from ihbench.reports.general.headline import write as headline
from ihbench.reports.general.report import MARKDOWN as write
from ihbench.reports.site.tables import site_tables
from ihbench.scene.plan import Omission
from tests.reports.fake_runs import about, identity, mean, record, with_events

PSNR, SSIM = "psnr/pooled/range1/{}/v1", "ssim/gauss11-1.5/range1/{}/v1"
REGIONS = ("full", "body", "hidden")


def run(scene="a", method="ours", seed=0, psnr=20.0, ssim=0.5, truth=True, **changes):
    """A finished run whose every region has the same PSNR and SSIM."""
    means, perfect = {}, {}
    for region in REGIONS:
        for name, value, best in ((PSNR, psnr, math.inf), (SSIM, ssim, 1.0)):
            means |= mean(name.format(region), value, "nothing is hidden" if math.isnan(value) else "")
            perfect |= mean(name.format(region), best)
    who = {name: changes.pop(name) for name in ("profile",) if name in changes}
    who |= {
        "protocol": changes.pop("protocol", "p@1"),
        "protocol_digest": changes.pop("digest", "abc"),
        "code": changes.pop("code", "1+old"),
    }
    status, reason = changes.pop("status", "done"), changes.pop("reason", "")
    told = record(identity(scene, method, seed=seed, **who), about(**changes), status, reason)
    rows = {method: means} | ({"truth": perfect} if truth else {})
    return RunResult(Path("runs") / scene, told, rows if status == "done" else {})


def titles(text):
    """How many protocols, profiles or kinds of data have tables of their own."""
    return len(re.findall(r"^## ", text, re.M))


def tables(text):
    """Title -> rows of the table below it, each a dictionary of cells by column head."""
    found = {}
    for part in text.split("### ")[1:]:
        lines = [re.split(r"(?<!\\) ?\| ?", line)[1:-1] for line in part.splitlines() if line[:1] == "|"]
        head, rows = (lines[0], lines[2:]) if lines else ([], [])
        found[part.splitlines()[0]] = [dict(zip(head, row, strict=True)) for row in rows]
    return found


def row(text, label, metric="PSNR ↑ (dB)"):
    (found,) = [cells for cells in tables(text)[metric] if cells["method"] == label]
    return found


# ----------------------------------------------------------------------------------------------- which table


@pytest.mark.parametrize(
    "change", [{"protocol": "p@2"}, {"digest": "abd"}, {"profile": "paper"}, {"standin": ""}, {"standin": "other"}]
)
def test_runs_that_cannot_be_compared_never_share_a_table(change):
    text = write([run(), run(scene="b", psnr=30.0, **change)])
    assert titles(text) == 2
    assert text.count("| ours | 1 | 0 | 20.00") == text.count("| ours | 1 | 0 | 30.00") == 1


def test_runs_of_one_protocol_share_a_table_whatever_their_order():
    runs = [run("a", psnr=10.0), run("a", "theirs", psnr=11.0), run("b", psnr=20.0), run("b", "theirs", psnr=21.0)]
    for order in (runs, runs[::-1]):
        text = write(order)
        assert titles(text) == 1
        assert row(text, "ours")["full"] == "15.00"
        assert row(text, "theirs")["full"] == "16.00"


def test_stand_ins_are_named_as_such_and_real_data_too():
    assert "Data: **stand-in v1 seed 0**: made by the bench, not real data." in write([run()])
    assert "Data: real data (original)." in write([run(standin="")])


# ---------------------------------------------------------------------------------------- what a cell means


def test_every_scene_counts_once_however_many_seeds_it_has():
    runs = [run("a", seed=seed, psnr=10.0 + 4 * seed) for seed in (0, 1, 2)]
    cells = row(write([*runs, run("b", psnr=20.0)]), "ours")
    assert cells["full"] == "17.00"  # (14 + 20) / 2, not the mean of the four runs, 15.5
    assert (cells["scenes"], cells["seeds"]) == ("2", "0, 1, 2")


def test_other_switches_make_another_row():
    text = write([run(psnr=10.0), run(psnr=30.0, changed={"steps": 5})])
    assert row(text, "ours")["full"] == "10.00"
    assert row(text, "ours (steps=5)")["full"] == "30.00"


def test_runs_of_another_version_of_the_code_are_never_averaged_with_these():
    text = write([run(psnr=10.0), run(psnr=30.0, code="1+new")])
    assert row(text, "ours (code 1+old)")["full"] == "10.00"
    assert row(text, "ours (code 1+new)")["full"] == "30.00"
    assert "code" not in write([run(code="1+new"), run("b", code="1+new"), run("b", "theirs")])


def test_a_scene_without_the_number_is_left_out_of_the_mean_and_noted():
    text = write([run("a", psnr=10.0), run("b", psnr=math.nan)])
    assert row(text, "ours")["full"] == "10.00"
    assert "- absent: PSNR, full, body, hidden: nothing is hidden" in text


def test_absent_and_infinite_numbers_are_no_numbers():
    text = write([run(psnr=math.nan), run("b", "theirs")])
    assert row(text, "ours")["full"] == "—"
    assert row(text, "*truth*")["full"] == "∞"
    assert row(text, "*truth*", "SSIM ↑")["full"] == "1.0000"


def test_decimals_follow_the_metric():
    text = write([run(psnr=12.3456, ssim=0.123456)])
    assert row(text, "ours")["full"] == "12.35"
    assert row(text, "ours", "SSIM ↑")["full"] == "0.1235"


def test_calibration_rows_count_every_scene_once_and_stand_below_the_methods():
    text = write([run("a"), run("a", seed=1), run("a", "theirs"), run("b")])
    rows = tables(text)["PSNR ↑ (dB)"]
    assert [cells["method"] for cells in rows] == ["ours", "theirs", "*truth*"]
    assert row(text, "*truth*")["scenes"] == "2"
    assert "- truth: the truth as prediction" in text


def test_every_scene_counts_once_in_the_costs_too():
    """In every table: two seeds of one scene are one scene."""
    costs = (("a", 0, 10, 1), ("a", 1, 30, 3), ("b", 0, 60, 6))
    runs = [
        run(scene, seed=seed, fit_seconds=fit, total_seconds=2 * fit, render_ms=ms) for scene, seed, fit, ms in costs
    ]
    rows = [cells for table in tables(write(runs)).values() for cells in table if cells.get("method") == "ours"]
    found = [cells for cells in rows if "render ms" in cells]
    assert len(found) == 2
    for cells in found:
        (fit,) = [text for head, text in cells.items() if head.startswith("fit s")]
        assert (fit.split(" [")[0], cells["total s"], cells["render ms"]) == ("40", "80", "4")
    (ours, *_) = site_tables(runs)["groups"][0]["rows"]
    assert (ours["fit"], ours["total"]) == (40, 80)
    assert re.search(r"^ours .* 40 +4$", headline(runs), re.M)


def test_seconds_are_means_and_memory_is_the_largest():
    cells = row(write([run(fit_seconds=10, peak_mb=100), run("b", fit_seconds=30, peak_mb=300)]), "ours")
    assert (cells["fit s"], cells["total s"], cells["peak MB"]) == ("20", "20", "300")
    assert cells["render ms"] == "—"  # of runs whose records do not say
    cells = row(write([run(render_ms=12.04), run("b", render_ms=16.0), run("c")]), "ours")
    assert cells["render ms"] == "14"


# ------------------------------------------------------------------------------------------- what is said


def test_every_metric_has_a_table_of_regions_with_the_headline_in_bold():
    found = tables(write([run()]))
    assert list(found) == ["PSNR ↑ (dB)", "SSIM ↑", "Error against run time"]
    for rows in list(found.values())[:2]:
        assert [head for head in rows[0] if head.strip("*") in REGIONS] == ["full", "**body**", "hidden"]


def test_a_metric_that_no_method_has_is_said_once_and_has_no_table():
    text = write([run(psnr=math.nan)])
    assert "PSNR ↑ (dB)" not in tables(text)
    assert "- absent: PSNR, full, body, hidden: nothing is hidden" in text


def test_what_a_number_is_stands_below_the_table():
    text = write([run()])
    assert "`psnr/pooled/range1/REGION/v1`" in text
    assert "`ssim/gauss11-1.5/range1/REGION/v1`" in text
    assert "Protocol digest `abc`" in text


def test_a_run_that_is_not_done_is_named_with_its_reason_and_never_averaged():
    bad = run("b", status="diverged", reason="diverged at step 3: loss is nan")
    text = write([run("a", psnr=10.0), bad])
    assert "Not done: ours on b: diverged (diverged at step 3: loss is nan)." in text
    assert row(text, "ours")["scenes"] == "1"
    alone = write([bad])
    assert "Not done: ours on b" in alone
    assert "|" not in alone


def test_views_that_a_mean_does_not_run_over_are_counted():
    result = run()
    for name in (PSNR, SSIM):
        result.rows["ours"].update(mean(name.format("full"), 20.0, "region is empty", n=3, absent_count=1))
    result.rows["ours"].update(mean(PSNR.format("body"), 20.0, n=2, infinite=2))
    text = write([result])
    assert text.count("- full of a (PSNR, SSIM): 1 of 4 absent: region is empty") == 1
    assert "- body of a (PSNR): 2 of 4 without any error (inf) left out" in text


def test_a_remark_on_some_rows_names_them():
    runs = [run(method=name) for name in ("ours", "theirs", "third")]
    for own in runs[:2]:
        own.rows[own.method].update(mean(PSNR.format("body"), 20.0, n=9, infinite=1))
    runs[2].rows["third"].update(mean(SSIM.format("full"), math.nan, "no such file"))
    text = write(runs)
    assert "- body of a (PSNR), ours, theirs: 1 of 10 without any error (inf) left out\n" in text
    assert "- absent: SSIM, full, third: no such file\n" in text


def test_a_row_says_which_scenes_and_seeds_it_lacks():
    runs = [run(scene, seed=seed) for scene in "abc" for seed in (0, 1)]
    runs += [run("a", "few"), run("c", "few", seed=1), run("a", "few", seed=1)]
    text = write(runs)
    assert "- few: over 2 of 3 scenes, without b; without seed 0 on c\n" in text
    assert "- ours: " not in text


def test_what_was_left_out_is_said_once():
    left_out = (Omission("levels", [16], "too fine"),)
    text = write([run("a", left_out=left_out), run("b", left_out=left_out)])
    assert text.count("- left out by the plan, ours on a, b: levels → [16]: too fine") == 1


def test_what_a_fit_left_out_went_back_from_and_warned_of_is_said_by_row():
    lacks = LeftOut("lpips term", "no weights")
    back = RolledBack("stage1", 20, "loss is nan at step 31; went back to step 20", 31)
    runs = [with_events(run("a"), lacks), with_events(run("b"), lacks, lacks), with_events(run("a", "theirs"), lacks)]
    runs.append(with_events(run("c"), back, Warned("out of memory")))
    runs[2] = replace(runs[2], record=replace(runs[2].record, warnings=("started again",)))
    text = write(runs)
    assert text.count("- left out by the fit, ours on a, b, 2 of 3 runs: lpips term: no weights\n") == 1
    assert "- left out by the fit, theirs on a: lpips term: no weights\n" in text
    assert f"- rolled back, ours on c, 1 of 3 runs: stage1: {back.what}\n" in text
    assert "- warning, ours on c, 1 of 3 runs: out of memory\n" in text
    assert "- warning, theirs on a: started again\n" in text


def test_words_from_elsewhere_cannot_break_the_table():
    odd = run("b", status="failed", reason="no\n| such | thing <script>")
    text = write([run(method="a|b", changed={"path": "x|y\nz"}), odd])
    rows = tables(text)["PSNR ↑ (dB)"]
    assert [cells["method"] for cells in rows] == [r"a\|b (path=x\|y z)", "*truth*"]
    assert r"failed (no \| such \| thing &lt;script>)." in text


# ---------------------------------------------------------------------------------- intervals and other presets


def test_scenes_give_intervals_and_a_paired_test_with_what_it_could_have_found():
    runs = [run(f"s{k}", psnr=20.0 + k, ssim=0.5) for k in range(6)]
    runs += [run(f"s{k}", "theirs", psnr=18.0 + k + 0.1 * (k % 2), ssim=0.5) for k in range(6)]
    text = write(runs)
    cells = row(text, "ours", "body: mean over scenes and 95% interval")
    assert cells["PSNR ↑"].startswith("22.50 [20.5")
    line = next(line for line in text.splitlines() if line.startswith("- PSNR: ours against theirs"))
    assert "+1.95" in line
    assert "p = 0.031" in line
    assert "significant;" in line
    assert "would be found 80% of the time" in line


def test_too_few_scenes_cannot_be_significant_and_one_has_no_interval():
    runs = [
        run(f"s{k}", name, psnr=value + k) for k in range(3) for name, value in (("ours", 30.0), ("theirs", 10.0))
    ]
    assert "cannot be significant: 3 scenes allow no adjusted p below 0.25" in write(runs)
    # six scenes would do for one comparison, but not for two
    six = [run(f"s{k}", name, psnr=v + k) for k in range(6) for name, v in (("a", 30.0), ("b", 20.0), ("c", 10.0))]
    text = write(six)
    assert "cannot be significant: 6 scenes allow no adjusted p below 0.062" in text
    assert "would be found" not in text
    assert "interval" not in write([run()])


def test_fewer_scenes_of_one_comparison_can_be_significant_beside_more_of_another():
    """Holm multiplies only the smallest p by the number of tests: ten scenes leave six theirs."""
    scores = {"a": (10, 30.0, 0.1), "b": (10, 25.0, 0.13), "c": (6, 24.0, 0.07)}
    runs = [run(f"s{k}", name, psnr=v + d * k) for name, (n, v, d) in scores.items() for k in range(n)]
    line = next(line for line in write(runs).splitlines() if line.startswith("- PSNR: a against c"))
    assert "p = 0.031 (sign-flip test over 6 scenes, Holm over 2), significant" in line


def test_two_definitions_of_a_metric_are_told_apart_wherever_they_stand():
    other, runs = "psnr/occnerf-pooled/range1/body/v1", []
    for k in range(3):
        for name, psnr in (("ours", 20.0 + k), ("theirs", 19.0 + 2 * k)):
            one = run(f"s{k}", name, psnr=psnr, fit_seconds=10.0 + psnr)
            one.rows[name].update(mean(other, 30.0 + psnr))
            point = CurvePoint(1, 5.0, {i: m.value for i, m in one.own.items()})
            runs.append(replace(one, curve=[point, replace(point, seconds=9.0)]))
    text = write(runs, targets=[Target("psnr", 15.0)])
    assert "PSNR (pooled) ≥ 15 dB" in text
    assert re.search(r"- PSNR \(occnerf-pooled\): \w+ against", text)
    for head in re.findall(r"^\| (?:method|region) .*\|$", text + "\n".join(headline(runs).splitlines()), re.M):
        cells = head.split(" | ")
        assert len(set(cells)) == len(cells)
    assert "PSNR (pooled), SSIM, PSNR (occnerf-pooled)" in text  # of the Pareto set
    for title, there in (("Error against run time", "21.00"), ("body: mean over scenes and 95% interval", "21.00 [")):
        cells = row(text, "ours", title)  # under the right head
        assert cells["PSNR (pooled) ↑"].startswith(there)
        assert cells["PSNR (occnerf-pooled) ↑"].startswith(there.replace("2", "5", 1))
    (shown,) = [line.split() for line in headline(runs).splitlines() if line.startswith("ours ")]
    assert shown[1:4] == ["21.00", "0.5000", "51.00"]
    (titles,) = [line for line in headline(runs).splitlines() if line.startswith("region ")]
    assert titles.index("(pooled)") < titles.index("SSIM") < titles.index("(occnerf-pooled)")
    assert all(name in headline(runs) for name in ("PSNR (pooled) ↑", "PSNR (occnerf-pooled) ↑"))
    assert site_tables(runs)["variants"] == {PSNR.format("body"): "(pooled)", other: "(occnerf-pooled)"}


def test_a_preset_scored_later_has_a_table_of_its_own():
    legacy = "psnr/gauhuman-channels/range1/full/v1"
    result = run()
    result.presets["gauhuman"] = {
        "ours": mean(legacy, 31.5),
        "truth": mean(legacy, math.inf),
    }
    text = write([result], ["gauhuman"])
    assert row(text, "ours", "preset gauhuman")["PSNR↑ full"] == "31.50"
    assert row(text, "*truth*", "preset gauhuman")["PSNR↑ full"] == "∞"
    assert legacy not in write([result])


def test_predictions_are_labelled_and_have_no_fit_time():
    result = run(fit_seconds=None, predictions=PredictionFiles((), (), ()))
    assert row(write([result]), "ours (predictions)")["fit s"] == "—"


def test_seconds_of_two_machines_have_no_mean_in_the_main_table():
    made = [(run(seed=seed), Machine(cpu=cpu, cores_usable=4)) for seed, cpu in enumerate(("fast", "slow"))]
    cells = row(write([replace(r, record=replace(r.record, machine=machine)) for r, machine in made]), "ours")
    assert (cells["fit s"], cells["total s"]) == ("—", "—")
