"""The report's sections on run time, and its figures: what they say, and that nothing odd brings them down."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import replace

import pytest

from ihbench.document.markdown import write as markdown
from ihbench.metrics import Identity
from ihbench.metrics.statistics import Interval
from ihbench.record.quality_time import Target
from ihbench.reports.general.clock import three_digits
from ihbench.reports.general.configurations import configurations, sweeps
from ihbench.reports.general.figures import ROOM, _shown, draw
from ihbench.reports.general.headline import write as headline
from ihbench.reports.general.report import HTML, LATEX
from ihbench.reports.general.report import MARKDOWN as write
from ihbench.reports.general.run_time import across_sizes_section, run_time_section, seconds_interval, work_points
from ihbench.reports.site.tables import site_tables
from tests.reports.fake_runs import with_about
from tests.reports.made_up_runs import FLIP, PSNR, made_up, sweep

IDENTITIES = [Identity.parse(PSNR.format("body")), Identity.parse(FLIP.format("body"))]


def section(runs, *targets):
    return markdown(run_time_section(runs, IDENTITIES, "body", targets))


def cells(text, label, title="Error against run time"):
    """The row's cells by column head, in the table below a title."""
    part = text.split(f"### {title}", 1)[1].split("###", 1)[0]
    lines = [[c.strip() for c in line.split("|")[1:-1]] for line in part.splitlines() if line[:1] == "|"]
    (found,) = [row for row in lines if row[0] == label]
    return dict(zip(lines[0], found, strict=True))


# --------------------------------------------------------------------------------------------------------- the costs


@pytest.mark.parametrize(
    ("cost", "text"), [(0.01524, "0.0152"), (65.83, "65.8"), (999.4, "999"), (999.6, "1000"), (1061.2, "1061")]
)
def test_costs_have_three_digits_and_no_exponent(cost, text):
    assert three_digits(cost) == text


def test_seconds_are_means_over_scenes_with_an_interval_and_one_scene_takes_its_repeats(tmp_path):
    two = [
        made_up(tmp_path, s, fit=f, seed=k) for s, fits in (("a", (10, 20)), ("b", (30,))) for k, f in enumerate(fits)
    ]
    found = cells(section(two), "ours")
    assert found["fit s [95%]"].startswith("22.5 [")  # (15 + 30) / 2
    assert found["runs"] == "3"
    repeats = [made_up(tmp_path, fit=f, seed=k) for k, f in enumerate((38, 40, 42))]
    assert re.fullmatch(r"40 \[35(\.\d)?, 45(\.\d)?\]", cells(section(repeats), "ours")["fit s [95%]"])
    assert cells(section(repeats[:1]), "ours")["fit s"] == "38"


def test_no_interval_of_seconds_goes_below_zero(tmp_path):
    runs = [made_up(tmp_path, scene, fit=fit) for scene, fit in (("a", 50), ("b", 60), ("c", 845))]
    interval = seconds_interval(runs)
    assert 0 < interval.low < interval.value < interval.high
    assert interval.value == pytest.approx(955 / 3)
    assert "Student's t over 3 subjects, in log time" in section(runs)
    near = seconds_interval(
        [made_up(tmp_path, scene, fit=fit) for scene, fit in (("a", 50.0), ("b", 50.1), ("c", 50.2))]
    )
    assert (near.low, near.high) == pytest.approx((49.85, 50.35), abs=0.01)  # as Student's t has it


def test_render_ms_is_the_mean_over_scenes_of_those_that_say(tmp_path):
    runs = [made_up(tmp_path, "a", render_ms=10.0, seed=0), made_up(tmp_path, "a", render_ms=14.0, seed=1)]
    runs += [made_up(tmp_path, "b", render_ms=20.0), *(made_up(tmp_path, s, "theirs") for s in "ab")]
    text = section(runs)
    assert cells(text, "ours")["render ms"] == "16"
    assert cells(text, "theirs")["render ms"] == "—"


def test_the_pareto_marks_are_those_of_the_numbers_in_the_table(tmp_path):
    text = section(sweep(tmp_path))
    marks = {
        label: cells(text, label)["Pareto"]
        for label in ("ours (steps=50)", "ours", "ours (steps=200)", "ours (texels=8)", "ours (texels=32)", "theirs")
    }
    assert marks == {
        "ours (steps=50)": "PSNR, FLIP",
        "ours": "PSNR, FLIP",
        "ours (steps=200)": "PSNR, FLIP",
        "ours (texels=8)": "—",
        "ours (texels=32)": "—",
        "theirs": "—",
    }


def test_rows_are_compared_only_over_scenes_that_all_have(tmp_path):
    runs = [made_up(tmp_path, s, psnr=p) for s, p in (("a", 20.0), ("b", 30.0))]
    runs.append(made_up(tmp_path, "a", "theirs", psnr=21.0))
    text = section(runs)
    assert cells(text, "ours")["PSNR ↑"] == "20.00"
    assert "1 scene that all these rows have" in text


def test_one_odd_row_does_not_take_the_comparison_of_the_others(tmp_path):
    runs = [made_up(tmp_path, s, m, psnr=20.0) for s in ("a", "b", "c") for m in ("ours", "theirs")]
    runs.append(made_up(tmp_path, "z", "trial", psnr=21.0))
    text = section(runs)
    assert cells(text, "ours")["runs"] == cells(text, "theirs")["runs"] == "3"
    assert "Not here, because they lack some of these scenes: trial." in text
    assert "| trial" not in text


def test_seconds_of_two_machines_are_never_one_mean(tmp_path):
    runs = [made_up(tmp_path, "a", fit=10), made_up(tmp_path, "a", seed=1, fit=90, machine={"cpu": "a slower one"})]
    text = section(runs)
    assert cells(text, "ours on A")["fit s"] == "10"
    assert cells(text, "ours on B")["fit s"] == "90"
    assert "machine B: a slower one, 4 cores" in text


def test_another_number_of_threads_is_another_clock(tmp_path):
    runs = [
        made_up(tmp_path, "a", seed=k, fit=f, machine={"torch_threads": t}) for k, f, t in ((0, 10, 4), (1, 40, 1))
    ]
    text = section(runs)
    assert cells(text, "ours on A")["fit s"] == "10"
    assert "4 cores, 4 threads" in text
    assert "4 cores, 1 thread;" in text


def test_unstable_is_said_when_repeats_or_the_load_say_so_and_only_then(tmp_path):
    calm = [made_up(tmp_path, seed=k, fit=f) for k, f in enumerate((40, 44))]
    assert "unstable" not in section(calm)
    apart = [made_up(tmp_path, seed=k, fit=f) for k, f in enumerate((40, 60))]
    assert "unstable seconds: repeats 40% of their median apart: ours" in section(apart)
    for when in ("load_average", "load_average_end"):  # also what came while it ran
        busy = [made_up(tmp_path, machine={when: (9.0, 1.0, 1.0)})]
        assert "unstable seconds: 1 of 1 runs on a busy machine (load up to 2.2 per core): ours" in section(busy)
    pinned = [made_up(tmp_path, machine={"load_average_end": (4.0, 1.0, 1.0), "cores_usable": 1})]
    assert "unstable" not in section(pinned)  # the load is the whole machine's


def test_a_fit_that_waited_is_told_and_its_processor_seconds_stand_beside_it(tmp_path):
    runs = [made_up(tmp_path, scene, fit=fit, cpu=40) for scene, fit in (("a", 44), ("b", 840), ("c", 70))]
    text = section(runs)
    assert cells(text, "ours")["fit CPU s"] == "40"
    told = "2 of 3 fits waited: up to 840 s, of which the process ran 40 s"
    assert f"unstable seconds: {told}: ours" in text
    assert f"{told}. Their seconds of the wall clock count in Pareto sets" in text
    assert all(f"{told}: drawn by the wall clock." in caption for _, caption in draw(runs, tmp_path / "figures"))
    assert told in " ".join(headline(runs).split())
    (row,) = site_tables(runs)["groups"][0]["rows"]
    assert (row["cpu"], row["unstable"]) == (40, [told])


def test_threads_and_accelerators_do_not_wait(tmp_path):
    """Several threads together have more processor seconds than the clock; on a GPU these say nothing."""
    for cpu, device in ((150, "cpu"), (1, "cuda"), (None, "cpu")):
        text = section([made_up(tmp_path, scene, fit=44, cpu=cpu, device=device) for scene in "abc"])
        assert "waited" not in text
        assert ("fit CPU s" in text) == (cpu == 150)


def test_runs_without_a_fit_time_have_no_section(tmp_path):
    scored = with_about(made_up(tmp_path), fit_seconds=None)
    assert section([scored]) == "\n"


# ---------------------------------------------------------------------------------------------------- time to quality


def test_times_are_medians_over_scenes_and_never_is_an_outcome(tmp_path):
    quick, slow = ((2.0, 10.0), (8.0, 30.0)), ((2.0, 10.0), (8.0, 14.0))
    runs = [made_up(tmp_path, s, curve=c) for s, c in (("a", quick), ("b", quick), ("c", slow))]
    text = section(runs, Target("psnr", 20.0), Target("psnr", 31.0), Target("psnr", 12.0, "hidden"))
    found = cells(text, "ours", "Time to quality")
    assert found["PSNR ≥ 20 dB"] == "4 s [4, never], 2 of 3 <sup>(1)</sup>"
    assert "\n<sup>(1)</sup> on 3 of 4 views; the table has it in 3 of 3 scenes.\n" in text
    assert found["PSNR ≥ 31 dB"] == "never (best 30.00)"
    assert found["PSNR hidden ≥ 12 dB"].startswith("2.3 s [2.3, 4]")


def test_a_time_to_a_quality_that_the_table_lacks_says_on_which_views_it_was_reached(tmp_path):
    runs = [made_up(tmp_path, psnr=17.8), made_up(tmp_path, method="theirs", psnr=23.0)]
    for write_in in (write, LATEX, HTML):
        text = write_in(runs, targets=[Target("psnr", 18.0), Target("psnr", 24.0), Target("psnr", 16.0)])
        assert text.count("on 3 of 4 views; the table has 17.80") == 1
        assert not any("the table has" in line for line in text.splitlines() if "4 s" in line)  # of a row
        assert text.count("on 3 of 4 test views") >= 3  # the titles of times and areas, and what is below
        assert "never (best 23.00)" in text
    found = cells(
        section(runs, Target("psnr", 18.0), Target("psnr", 16.0)), "ours", "Time to quality, on 3 of 4 test views"
    )
    assert found["PSNR ≥ 16 dB"] == "2.52 s"  # which all views have, too
    late = made_up(tmp_path, "b", psnr=25.0)
    text = section([late], Target("psnr", 24.0))
    assert cells(text, "ours", "Time to quality")["PSNR ≥ 24 dB"] == "never (best 23.00) <sup>(1)</sup>"
    assert "<sup>(1)</sup> on 3 of 4 views; the table has 25.00." in text
    several = section([*runs[:1], made_up(tmp_path, "c", psnr=25.0)], Target("psnr", 18.0))
    assert "| 4 s [4, 4] <sup>(1)</sup> |" in several
    assert "<sup>(1)</sup> on 3 of 4 views; the table has it in 1 of 2 scenes." in several


def test_where_the_curve_ends_is_said_beside_the_table(tmp_path):
    title = "Where the curves end, and what the table has"
    found = cells(section([made_up(tmp_path, psnr=17.8)]), "ours", title)
    assert found["PSNR body ↑"] == "23.00, in the table 17.80 (+5.20)"
    assert title not in section([made_up(tmp_path, psnr=23.0)])
    assert "on all 4 test views" in section([made_up(tmp_path, views=4)])
    assert "on 3 of 55 or all 4 test views" in section(
        [made_up(tmp_path, "a", views=4), made_up(tmp_path, "b", of=55)]
    )


def test_round_targets_are_such_as_the_table_has(tmp_path):
    head = section([made_up(tmp_path, psnr=17.8)]).split("### Time to quality")[1].splitlines()[2]
    assert all(15 <= float(x) <= 17.8 for x in re.findall(r"PSNR ≥ ([\d.]+) dB", head))
    assert section([made_up(tmp_path, psnr=12.0)]).count("<sup>(1)</sup>") == 3 + 1  # none is: then any


def test_a_metric_that_is_not_on_the_curve_is_named(tmp_path):
    assert "no curve of lpips in body" in section([made_up(tmp_path)], Target("lpips", 0.1))


def test_curves_that_lack_what_is_shown_are_told_from_no_curves(tmp_path):
    run = made_up(tmp_path)
    without = replace(run, curve=[replace(point, scores={}) for point in run.curve])  # as --metrics lpips leaves them
    assert "The quality-time curves (curve.jsonl) hold none of the metrics and regions shown here." in section(
        [without]
    )
    assert "No run has a quality-time curve" not in section([without])
    assert "No run has a quality-time curve (curve.jsonl)." in section([made_up(tmp_path, "b", curve=None)])


def test_without_targets_round_ones_are_taken_that_the_curves_pass(tmp_path):
    head = section([made_up(tmp_path)]).split("### Time to quality")[1].splitlines()[2]
    targets = [float(x) for x in re.findall(r"PSNR ≥ ([\d.]+) dB", head)]
    assert len(targets) == 3
    assert all(15 <= t <= 23 for t in targets)


def test_the_area_is_over_one_window_for_all_rows(tmp_path):
    level = [made_up(tmp_path, curve=((2.0, 20.0), (32.0, 20.0)))]
    level.append(made_up(tmp_path, "a", "theirs", curve=((4.0, 10.0), (16.0, 20.0))))
    text = section(level)
    title = "Area under the quality-time curve"
    assert cells(text, "ours", title)["PSNR body ↑"] == "20.00"
    assert (
        cells(text, "theirs", title)["PSNR body ↑"] == "16.67"
    )  # from 4 s to 32 s: 10 → 20 over two octaves, then 20
    assert "from 4 s to 32 s" in text


# ----------------------------------------------------------------------------------------------------- what is odd


ODD = [
    {"curve": None},
    {"curve": ()},
    {"curve": ((5.0, math.nan),)},
    {"curve": ((5.0, math.inf), (9.0, 20.0))},
    {"curve": ((0.0, 20.0),)},
    {"psnr": math.nan},
    {"psnr": math.inf},
    {"fit": 0.0},
    {"machine": {"load_average": None, "cores_usable": None, "cpu": None}},
]


@pytest.mark.parametrize("odd", ODD, ids=str)
def test_one_odd_run_alone_or_among_others_is_reported(tmp_path, odd):
    alone = made_up(tmp_path / "odd", **odd)
    for runs in ([alone], [made_up(tmp_path / "fine", "a", "theirs"), alone]):
        text = write(runs)
        assert "| ours" in text
        assert "nan" not in text.lower()


def test_odd_runs_are_drawn_as_far_as_they_have_numbers(tmp_path):
    runs = [made_up(tmp_path, "a", f"method{k}", **odd) for k, odd in enumerate(ODD)]
    drawn = dict(zip(("work-precision", "quality-time"), _without_systems(draw(runs, tmp_path / "all")), strict=True))
    rows = list(csv.DictReader(drawn["work-precision"][0].with_suffix(".csv").open()))
    assert {row["method"] for row in rows} == {f"method{k}" for k in (0, 1, 2, 3, 4, 8)}
    rows = list(csv.DictReader(drawn["quality-time"][0].with_suffix(".csv").open()))
    assert {row["configuration"].split()[0] for row in rows} == {f"method{k}" for k in (3, 5, 6, 7, 8)}
    assert [png.name.split("_")[0] for png, _ in draw(runs[:1], tmp_path / "no-curve")] == ["work-precision"]
    assert [png.name.split("_")[0] for png, _ in draw(runs[5:6], tmp_path / "no-score")] == ["quality-time"]


def test_a_damaged_curve_is_named(tmp_path):
    runs = [made_up(tmp_path), replace(made_up(tmp_path, seed=1), curve=[], damage=("curve.jsonl: cut",))]
    assert f"without a readable curve.jsonl: {runs[1].folder.name}" in section(runs)


def _without_systems(drawn):
    """`test_systems.py` looks at these."""
    return [(png, caption) for png, caption in drawn if not png.name.startswith("systems")]


def test_no_runs_no_figures(tmp_path):
    assert draw([], tmp_path) == []
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------------- sweeps and figures


def test_a_sweep_is_every_chain_of_rows_that_differ_in_one_number(tmp_path):
    found = {s.axis: [value for value, _ in s.members] for s in sweeps(configurations(sweep(tmp_path)))}
    assert found == {"steps": [50, 100, 200], "texels": [8, 16, 32]}


def test_switches_without_order_make_no_sweep_and_lists_are_ordered_by_length(tmp_path):
    runs = [
        made_up(tmp_path, config={"levels": [64, 128], "on": True}),
        made_up(tmp_path, config={"levels": [64], "on": True}, changed={"levels": [64]}),
        made_up(tmp_path, config={"levels": [64, 128], "on": False}, changed={"on": False}),
    ]
    (found,) = sweeps(configurations(runs))
    assert (found.axis, [value for value, _ in found.members]) == ("levels", [(64,), (64, 128)])


def test_the_csv_holds_what_the_figure_shows(tmp_path):
    runs = sweep(tmp_path / "runs", seeds=(0, 1))
    drawn = [png for png, _ in _without_systems(draw(runs, tmp_path / "out"))]
    assert [png.name for png in drawn] == ["work-precision_p@1_quick.png", "quality-time_p@1_quick.png"]
    for png in drawn:
        assert png.with_suffix(".svg").read_text().startswith("<?xml")
    rows = list(csv.DictReader(drawn[0].with_suffix(".csv").open()))
    points = work_points(configurations(runs), IDENTITIES[0])
    shown = {row["configuration"]: row for row in rows if row["identity"] == PSNR.format("body")}
    assert len(points) == len(shown) == 6
    for p in points:
        row = shown[p.configuration.label]
        assert float(row["fit_seconds"]) == p.seconds.value
        assert float(row["fit_seconds_low"]) == p.seconds.low
        assert float(row["error"]) == p.error.value == pytest.approx(10 ** (-p.value.value / 20))
        assert p.error.low <= p.error.value <= p.error.high
    assert {row["configuration"] for row in shown.values() if row["pareto"] == "True"} == {
        "ours (steps=50)", "ours", "ours (steps=200)"
    }  # fmt: skip
    curves = list(csv.DictReader(drawn[1].with_suffix(".csv").open()))
    assert {row["kind"] for row in curves} == {"mean"}  # six configurations are a crowd
    assert {row["test_views"] for row in curves} == {"3 of 4"}
    assert "on 3 of 4 test views" in drawn[1].with_suffix(".svg").read_text()
    assert {row["identity"] for row in curves} == {x.format(r) for x in (PSNR, FLIP) for r in ("body", "hidden")}


def test_an_axis_holds_all_points_and_of_their_bars_what_lies_near():
    """Over two scenes an interval may span decades, and the points would fall into one."""
    wide, narrow = (Interval(v, low, high, 0.95, 2, "t") for v, low, high in ((0.1, 0.001, 20.0), (0.2, 0.19, 0.21)))
    assert sorted(_shown([wide, narrow])) == pytest.approx([0.1 / ROOM, 0.1, 0.19, 0.2, 0.21, 0.2 * ROOM])
    alone = Interval(0.1, math.nan, math.nan, 0.95, 1, "")
    assert _shown([alone]) == [0.1]
    assert _shown([Interval(math.nan, math.nan, math.nan, 0.95, 0, "")]) == []


def test_few_configurations_show_their_checkpoints_too(tmp_path):
    (_, (png, caption)) = draw([made_up(tmp_path)], tmp_path / "out")
    assert "on 3 of 4 test views" in caption
    rows = list(csv.DictReader(png.with_suffix(".csv").open()))
    dots = [
        (float(r["seconds"]), float(r["value"]))
        for r in rows
        if r["kind"] == "checkpoint" and "psnr" in r["identity"]
    ]
    assert dots[:4] == [(2.0, 15.0), (4.0, 18.0), (8.0, 21.0), (16.0, 23.0)]


def test_profiles_and_sizes_of_one_protocol_stand_side_by_side_with_a_warning(tmp_path):
    runs = [made_up(tmp_path, curve=None)]
    runs.append(made_up(tmp_path, profile="paper", size=512, fit=900, psnr=28.0, curve=None))
    runs.append(made_up(tmp_path, protocol="p@1+size=32", size=32, fit=10, psnr=20.0, curve=None))
    text = markdown(across_sizes_section(runs))
    assert "their errors only with care" in text
    for label in ("ours [quick, 64 px]", "ours [paper, 512 px]", "ours [quick, 32 px]"):
        assert f"| {label} |" in text
    names = [png.name for png, _ in draw(runs, tmp_path / "out")]
    assert "work-precision_p@1_profiles-and-sizes.png" in names
    assert across_sizes_section(runs[:1]) == []
    other = made_up(tmp_path, protocol="p@1+occlusion=none")
    assert across_sizes_section([runs[0], other]) == []  # another occlusion is another question
