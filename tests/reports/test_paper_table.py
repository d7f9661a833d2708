"""The frame: quoted and measured rows, what keeps them apart, and what is said of every cell."""

from __future__ import annotations

import math

import pytest

from ihbench.clock.events import LeftOut
from ihbench.document import csv
from ihbench.document.document import spans
from ihbench.reports.paper.paper_numbers import PaperRow, paper_table
from ihbench.reports.paper.paper_table import build_frame
from ihbench.scene.plan import Omission
from tests.reports.fake_runs import LPIPS, PSNR, SUBJECTS, fake_run, with_events

TABLE1, TABLE2 = paper_table("table1"), paper_table("table2")


def block(frame, kind):
    (found,) = [table for table in frame.tables if table.kind == kind]
    return found


def names(table, bound=False):
    return [label.name for label in table.labels if label.bound == bound]


def numbers(table):
    return [number for k in range(len(table.rows)) for number in table.numbers(k)]


def cell(table, name, group, key):
    (row,) = [row for label, row in zip(table.labels, table.rows, strict=True) if label.name == name]
    (k,) = [k for k, column in enumerate(table.head) if getattr(column, "group", "") == group and column.key == key]
    return row[k]


def on_all(method, psnr, **changes):
    """Runs on four scenes whose scores differ between scenes far more than between methods."""
    return [fake_run(s, method, psnr + 5 * k + 0.01 * (k % 2), 0.9, **changes) for k, s in enumerate(SUBJECTS)]


def footnotes(frame, table, name):
    """What the letters at a row's name say."""
    (row,) = [row for label, row in zip(table.labels, table.rows, strict=True) if label.name == name]
    letters = [piece.text for piece in spans(row[0])[1:]]
    return [frame.footnotes[letter] for letter in ", ".join(letters).split(", ") if letter]


# ----------------------------------------------------------------------------------------------------- quoted rows


def test_the_true_second_best_is_marked_and_the_papers_mistake_told():
    quoted = block(build_frame(TABLE1, []), "quoted")
    assert cell(quoted, "OccNeRF", "ZJU-MoCap", "ssim").mark == "second"
    wrong = cell(quoted, "OccFusion", "ZJU-MoCap", "ssim")
    assert wrong.mark == ""
    (letter,) = wrong.footnotes
    assert "underlines OccFusion's 0.9548" in build_frame(TABLE1, []).footnotes[letter]


def test_as_printed_has_the_papers_own_marks():
    quoted = block(build_frame(TABLE1, [], as_printed=True), "quoted")
    assert [n.mark for row in quoted.rows if row[0] == "OccFusion" for n in row[2:]] == ["second"] * 6
    assert cell(quoted, "OccNeRF", "ZJU-MoCap", "ssim").mark == ""


def test_every_absent_cell_has_a_reason_and_every_letter_a_text():
    runs = [*on_all("ours", 20.0), fake_run("a", "failing", status="diverged", reason="diverged at step 3")]
    for table in (TABLE1, TABLE2):
        frame = build_frame(table, runs)
        cells = [number for one in frame.tables for number in numbers(one)]
        assert all(c.reason for c in cells if c.status == "absent")
        assert all(math.isnan(c.value) == (c.status == "absent") for c in cells)
        named = {piece.text for one in frame.tables for row in one.rows for piece in spans(row[0])[1:]}  # at names
        assert {letter for c in cells for letter in c.footnotes} | named == set(frame.footnotes)


def test_without_runs_the_frame_says_so():
    assert any("no finished run under zju_occ" in note for note in build_frame(TABLE1, []).notes)


# --------------------------------------------------------------------------------------------------- measured rows


def test_seeds_are_averaged_within_scenes_before_scenes_are():
    runs = [fake_run("a", psnr=10.0 + 4 * seed, who={"seed": seed}) for seed in range(3)] + [fake_run("b", psnr=20.0)]
    found = cell(block(build_frame(TABLE1, runs), "stand-in"), "ours", "ZJU-MoCap", "psnr")
    assert found.value == 17.0
    assert found.scenes == 2
    assert found.text == "17.00"
    assert found.low < 17.0 < found.high
    assert found.identity == PSNR.format("body")


def test_stand_ins_and_real_data_never_share_a_block():
    frame = build_frame(TABLE1, [fake_run("a"), fake_run("a", psnr=30.0, said={"standin": ""})])
    made, real = block(frame, "stand-in"), block(frame, "real data")
    assert cell(made, "ours", "ZJU-MoCap", "psnr").value == 20.0
    assert cell(real, "ours", "ZJU-MoCap", "psnr").value == 30.0
    assert "STAND-INS, not on real data" in made.title
    assert any("not the data set" in note for note in made.notes)
    assert {c.status for c in numbers(made)} <= {"stand-in", "absent"}
    assert {c.status for c in numbers(real)} <= {"measured", "absent"}
    assert [table.kind for table in frame.tables] == ["quoted", "quoted elsewhere", "real data", "stand-in"]


def test_data_sets_of_stand_ins_of_several_versions_share_a_block_and_one_of_two_does_not():
    first, second = {"standin": "stand-in v1 seed 0"}, {"standin": "stand-in v2 seed 0"}
    furniture = {"protocol": "ocmotion_visible@2", "dataset": "ocmotion"}
    runs = [fake_run("a", said=second), fake_run("a", psnr=30.0, said=first, who=furniture)]
    (table,) = (one for one in build_frame(TABLE1, runs).tables if one.kind == "stand-in")
    assert cell(table, "ours", "ZJU-MoCap", "psnr").value == 20.0
    assert cell(table, "ours", "OcMotion, held-out frames", "psnr").value == 30.0
    assert any("Made on stand-in v2 seed 0, stand-in v1 seed 0" in note for note in table.notes)
    frame = build_frame(TABLE1, [*runs, fake_run("a", psnr=10.0, said=first)])
    assert [one.kind for one in frame.tables].count("stand-in") == 2


def test_a_cell_over_fewer_scenes_than_others_says_so():
    runs = [*on_all("whole", 20.0), fake_run("a", "few", 30.0), fake_run("b", "few", 31.0)]
    frame = build_frame(TABLE1, runs)
    table = block(frame, "stand-in")
    (letter,) = cell(table, "few", "ZJU-MoCap", "psnr").footnotes
    assert frame.footnotes[letter] == "over 2 of 4 scenes, without c, d"
    assert cell(table, "whole", "ZJU-MoCap", "psnr").footnotes == ()


def test_a_row_says_what_the_plan_and_the_fits_left_out_of_it():
    left_out = (Omission("levels", [16], "too fine"),)
    runs = [fake_run("a", said={"left_out": left_out}), fake_run("b"), *on_all("theirs", 20.0)]
    runs = [with_events(run, LeftOut("lpips term", "no weights")) if run.method == "ours" else run for run in runs]
    frame = build_frame(TABLE1, runs)
    found = block(frame, "stand-in")
    assert footnotes(frame, found, "ours") == [
        "Left out by the plan: levels → [16] (a, 1 of 2 runs).",
        "Left out by the fit: lpips term: no weights (all runs).",
    ]
    assert footnotes(frame, found, "theirs") == []
    rows = {row["row"]: row["footnotes"] for row in csv.table_data(found, frame.footnotes)["rows"]}
    assert rows == {"ours": footnotes(frame, found, "ours"), "theirs": [], "truth": []}
    assert "Left out by the fit" in csv.write_cells(frame.name, frame.tables, frame.footnotes)


@pytest.mark.parametrize(
    "change",
    [
        {"who": {"profile": "paper"}},
        {"who": {"protocol_digest": "other"}},
        {"who": {"protocol": "zju_occ_occnerf@1"}},
    ],
)
def test_runs_that_cannot_be_compared_are_in_blocks_of_their_own(change):
    frame = build_frame(TABLE1, [fake_run("a"), fake_run("a", "theirs", psnr=30.0, **change)])
    measured = [table for table in frame.tables if table.kind == "stand-in"]
    assert len(measured) == 2
    assert [names(table) for table in measured] in (
        [["ours"], ["theirs"]],
        [["theirs"], ["ours"]],
    )


def test_runs_of_other_protocols_are_left_out():
    assert len(build_frame(TABLE2, [fake_run("a")]).tables) == 1
    assert len(build_frame(TABLE2, [fake_run("a", who={"protocol": "people_snapshot_occ@1"})]).tables) == 2


def test_marks_are_computed_over_scenes_and_never_between_blocks():
    runs = [*on_all("good", 22.0), *on_all("middle", 21.0), *on_all("bad", 20.0)]
    found = block(build_frame(TABLE1, runs), "stand-in")
    assert [cell(found, m, "ZJU-MoCap", "psnr").mark for m in ("good", "middle", "bad")] == ["best", "second", ""]
    # equal everywhere: nothing is better
    assert {cell(found, m, "ZJU-MoCap", "ssim").mark for m in ("good", "middle", "bad")} == {""}
    quoted = block(build_frame(TABLE1, runs), "quoted")
    assert quoted.rows == block(build_frame(TABLE1, []), "quoted").rows


def test_a_lead_that_the_scenes_do_not_confirm_is_not_marked_and_told():
    noisy = [fake_run(s, "noisy", 20.5 + 5 * k + (3 if k == 0 else -0.7)) for k, s in enumerate(SUBJECTS)]
    found = block(build_frame(TABLE1, [*on_all("steady", 20.0), *noisy]), "stand-in")
    assert {row[2].mark for row in found.rows} == {""}
    assert any("no best mark: noisy against steady" in note for note in found.notes)


def test_calibration_rows_bound_and_are_not_ranked():
    found = block(build_frame(TABLE1, [*on_all("ours", 22.0), *on_all("theirs", 21.0)]), "stand-in")
    assert names(found, bound=True) == ["truth"]
    truth = found.numbers(len(found.rows) - 1)
    assert [c.text for c in truth] == ["∞", "1.0000", "0.000"]
    assert {c.mark for c in truth} == {""}
    assert cell(found, "ours", "ZJU-MoCap", "psnr").mark == "best"


def test_an_absent_metric_keeps_its_reason():
    frame = build_frame(TABLE1, [fake_run("a")])
    found = cell(block(frame, "stand-in"), "ours", "ZJU-MoCap", "lpips")
    assert (found.text, found.status, found.reason) == ("—", "absent", "weights are not there")
    assert frame.footnotes[found.footnotes[0]] == "weights are not there"


def test_lpips_is_shown_a_thousandfold_and_only_shown():
    runs = [fake_run(s, lpips=0.03 + 0.001 * k) for k, s in enumerate(SUBJECTS)]
    found = cell(block(build_frame(TABLE1, runs), "stand-in"), "ours", "ZJU-MoCap", "lpips")
    assert found.text == "31.50"
    assert found.value == pytest.approx(31.5)
    assert found.identity == LPIPS.format("body")


def test_runs_that_are_not_done_are_told_with_the_cell():
    bad = fake_run("b", status="diverged", reason="diverged at step 3: loss is nan")
    frame = build_frame(TABLE1, [fake_run("a"), bad])
    found = cell(block(frame, "stand-in"), "ours", "ZJU-MoCap", "psnr")
    assert found.scenes == 1
    assert any("b, seed 0: diverged (diverged at step 3" in frame.footnotes[letter] for letter in found.footnotes)
    alone = build_frame(TABLE1, [bad])
    lone = cell(block(alone, "stand-in"), "ours", "ZJU-MoCap", "psnr")
    assert lone.status == "absent"
    assert "diverged at step 3" in lone.reason


def test_a_run_that_failed_before_it_said_anything_is_told_of_below_the_rows():
    early = fake_run("b", "early", status="failed", reason="no images", said={"changed": None})
    found = block(build_frame(TABLE1, [fake_run("a"), early]), "stand-in")
    assert [label.name for label in found.labels] == ["ours", "truth"]
    assert "Not done: early on b, seed 0: failed (no images)." in found.notes
    assert block(build_frame(TABLE1, [early]), "stand-in").rows == ()


def test_ocmotions_released_score_and_held_out_frames_are_columns_of_their_own():
    who = {"protocol": "ocmotion_visible@1"}
    run = fake_run("a", psnr=17.0, views={"train = test": (19.0, 0.95)}, who=who)
    found = block(build_frame(TABLE1, [run]), "stand-in")
    assert cell(found, "ours", "OcMotion", "psnr").value == 19.0
    assert cell(found, "ours", "OcMotion, held-out frames", "psnr").value == 17.0
    assert list(found.groups) == ["OcMotion", "OcMotion, held-out frames"]


def test_another_region_can_be_asked_for_and_is_told():
    frame = build_frame(TABLE1, [fake_run("a")], region="hidden")
    found = cell(block(frame, "stand-in"), "ours", "ZJU-MoCap", "psnr")
    assert found.status == "absent"
    assert "not computed in this region" in found.reason


def test_how_many_scenes_of_the_protocol_there_are_is_said():
    notes = block(build_frame(TABLE1, [fake_run("a"), fake_run("c")]), "stand-in").notes
    assert any("2 of 4 scenes (a, c); seeds 0" in note for note in notes)


# ------------------------------------------------------------------------------------------------------- components


def ablated(config, **about):
    who = {"protocol": "people_snapshot_occ@1", "config": config}
    frame = build_frame(TABLE2, [fake_run("a", who=who, said=about)])
    found = block(frame, "stand-in")
    return dict(zip(found.head[2:-3], found.rows[0][2:-3], strict=True))


def switches(levels=(64, 128), on=True, ti=True, sg=True, filler="diffusion"):
    return {"levels": list(levels), "inpaint": {"on": on, "ti": ti, "sg": sg, "filler": filler}}


def test_components_are_told_from_the_switches():
    assert ablated(switches(sg=False)) == {"MS Maps": "✓", "TI": "✓", "SG": "", "inpainting": "✓"}
    assert ablated(switches([128], on=False)) == {"MS Maps": "", "TI": "", "SG": "", "inpainting": ""}
    # a simple filler knows neither a word nor a part map
    assert ablated(switches(filler="mirror")) == {"MS Maps": "✓", "TI": "", "SG": "", "inpainting": "✓"}
    assert ablated(switches() | {"one_fit": True}) == {"MS Maps": "✓", "TI": "", "SG": "", "inpainting": ""}
    assert set(ablated({"steps": 3}).values()) == {"?"}


def test_what_the_plan_left_out_is_not_there():
    left_out = (Omission("one_fit", True, "nothing hidden"),)
    assert ablated(switches(), left_out=left_out) == {"MS Maps": "✓", "TI": "", "SG": "", "inpainting": ""}


@pytest.mark.parametrize("method", ["three-dgs-avatar", "3dgs_avatar", "3DGS-Avatar"])
def test_a_row_of_the_paper_knows_its_method_by_name_and_by_title(method):
    row = PaperRow("3DGS-Avatar", ())
    assert row.is_of(method)
    assert not row.is_of("gaussianavatar")
    assert not row.is_of("somebody-elses")
