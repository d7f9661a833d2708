"""Rank agreement with the paper's order, and where a system is better than the paper's own."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from ihbench.metrics.statistics import cluster_bootstrap
from ihbench.reports.paper.paper_numbers import paper_table
from ihbench.reports.paper.paper_table import build_frame
from ihbench.reports.paper.rank_agreement import RankAgreement, better_than, rank_agreement
from ihbench.scene.method_spec import MethodSpec
from tests.reports.fake_runs import PSNR, SUBJECTS, fake_run, means

TABLE1 = paper_table("table1")
PRINTED = {"gauhuman": 21.55, "gaussianavatar": 18.01, "occnerf": 22.40, "inpainthuman": 24.65}
PEOPLE = tuple(f"p{k}" for k in range(10))

NONE_BETTER = "ZJU-MoCap: no other system measured here is better than inpainthuman in any region by these metrics."


def steady(order, people=PEOPLE, noise=0.0, seed=0):
    """Scores whose means over people rise in this order of systems; people differ far more than systems do."""
    rng = np.random.default_rng(seed)
    return {
        name: {p: 10 + 5 * j + k + noise * rng.standard_normal() for j, p in enumerate(people)}
        for k, name in enumerate(order)
    }


def test_the_printed_order_is_full_agreement_and_its_reverse_the_contrary():
    order = sorted(PRINTED, key=PRINTED.__getitem__)
    for measured, sign in ((steady(order), 1), (steady(order[::-1]), -1)):
        agreement = rank_agreement(PRINTED, measured)
        assert isinstance(agreement, RankAgreement)
        for found in (agreement.spearman, agreement.kendall):
            assert (found.value, found.low, found.high) == pytest.approx((sign, sign, sign))


def test_the_coefficients_are_scipys_of_the_means_over_people():
    measured = steady(PRINTED, noise=1.0, seed=3)
    agreement = rank_agreement(PRINTED, measured)
    assert isinstance(agreement, RankAgreement)
    ours = [np.mean(list(measured[s].values())) for s in agreement.systems]
    theirs = [PRINTED[s] for s in agreement.systems]
    assert agreement.spearman.value == pytest.approx(stats.spearmanr(theirs, ours)[0])
    assert agreement.kendall.value == pytest.approx(stats.kendalltau(theirs, ours)[0])


def test_the_interval_is_that_of_resampled_people():
    """Restated for every replicate by pairs, without scipy and the shortcut over equal orders."""
    measured = steady(PRINTED, noise=2.0, seed=1)
    agreement = rank_agreement(PRINTED, measured)
    assert isinstance(agreement, RankAgreement)
    scores = np.array([[measured[s][p] for p in agreement.people] for s in agreement.systems])
    order = np.array([PRINTED[s] for s in agreement.systems])
    pairs = list(itertools.combinations(range(len(order)), 2))

    def concordance(m):
        return np.mean([np.sign(m[a] - m[b]) * np.sign(order[a] - order[b]) for a, b in pairs], axis=0)

    slow = cluster_bootstrap(scores, statistic=concordance)
    assert (agreement.kendall.low, agreement.kendall.high) == pytest.approx(tuple(slow))
    assert agreement.kendall.low < agreement.kendall.high


def test_only_people_that_all_systems_have_count_and_one_gives_no_interval():
    measured = steady(PRINTED)
    measured["occnerf"] = {"p4": measured["occnerf"]["p4"]}
    agreement = rank_agreement(PRINTED, measured)
    assert isinstance(agreement, RankAgreement)
    assert agreement.people == ("p4",)
    assert math.isnan(agreement.spearman.low)
    assert "one person gives no interval" in str(agreement)


def test_two_systems_and_no_common_person_have_no_order():
    few = dict(itertools.islice(steady(PRINTED).items(), 2))
    assert "2 systems are both printed and measured" in str(rank_agreement(PRINTED, few))
    apart = {name: {f"only {name}": 1.0} for name in PRINTED}
    assert "not measured on a common person" in str(rank_agreement(PRINTED, apart))
    absent = rank_agreement(PRINTED | {"occnerf": math.nan}, steady(PRINTED))
    assert isinstance(absent, RankAgreement)
    assert "occnerf" not in absent.systems


def test_equal_scores_agree_with_no_order():
    flat = {name: dict.fromkeys(PEOPLE, 3.0) for name in PRINTED}
    agreement = rank_agreement(PRINTED, flat)
    assert isinstance(agreement, RankAgreement)
    assert (agreement.spearman.value, agreement.kendall.value) == (0, 0)


def test_better_is_by_common_people_and_by_the_metrics_direction():
    scores = {"ours": {"a": 2.0, "b": 2.0}, "up": {"a": 3.0}, "down": {"a": 1.0, "b": 1.0, "c": 90.0}, "none": {}}
    assert better_than("ours", scores, True) == [("up", {"a": 1.0})]
    assert better_than("ours", scores, False) == [("down", {"a": -1.0, "b": -1.0})]


# ------------------------------------------------------------------------------------------------- in the table


def runs_of(psnr, people=SUBJECTS, hidden=None):
    """Method -> PSNR in body; `hidden` -> in that region."""
    out = []
    for method, value in psnr.items():
        for k, scene in enumerate(people):
            run = fake_run(scene, method, value + 3 * k, 0.9)
            own = dict(run.rows[method])
            for region, better in (hidden or {}).items():
                own |= means(better[method] + 3 * k, 0.5, region=region)
            out.append(type(run)(run.folder, run.record, {method: own}))
    return out


def notes_of(frame, kind="stand-in"):
    (table,) = [table for table in frame.tables if table.kind == kind]
    return table, [note for note in table.notes if "Rank agreement" in note or "better than" in note]


def test_the_tables_notes_have_the_agreement():
    frame = build_frame(TABLE1, runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0}))
    table, notes = notes_of(frame)
    (psnr,) = [note for note in notes if note.startswith("Rank agreement with the paper, ZJU-MoCap, PSNR")]
    assert "Spearman's rho +0.50" in psnr  # printed: gauhuman 21.55 < occnerf 22.40 < inpainthuman 24.65
    assert "Kendall's tau +0.33" in psnr
    assert "over 3 systems (gauhuman, occnerf, inpainthuman) and 4 people (a, b, c, d)" in psnr
    assert "too narrow with fewer than 8" in psnr
    assert not any("LPIPS" in note for note in notes)  # not measured
    assert [label.name for label in table.labels] == ["gauhuman", "occnerf", "inpainthuman"]  # the paper's order


def test_two_measured_systems_are_told_to_be_too_few():
    _, notes = notes_of(build_frame(TABLE1, runs_of({"inpainthuman": 30.0, "gauhuman": 21.0})))
    assert any("none to be had: 2 systems are both printed and measured" in note for note in notes)


def test_variants_and_systems_that_the_paper_has_not_do_not_count():
    runs = runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0, "mine": 40.0})
    runs += [fake_run(s, "gauhuman", 50.0, said={"changed": {"unknown": "ignore"}}) for s in SUBJECTS]
    _, notes = notes_of(build_frame(TABLE1, runs))
    assert any("over 3 systems (gauhuman, occnerf, inpainthuman)" in note for note in notes)
    (better,) = [note for note in notes if "better than inpainthuman" in note]
    assert "PSNR: mine by 10.00 dB [10.00, 10.00], 4 people" in better
    assert "gauhuman" not in better


def test_one_run_of_another_version_of_the_code_does_not_take_a_system_out():
    runs = runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0})
    runs += [
        fake_run("a", "inpainthuman", 50.0, who={"code": "2+0"}),
        fake_run("a", "gtu", said={"changed": {"x": 1}}),
    ]
    table, notes = notes_of(build_frame(TABLE1, runs))
    assert any("over 3 systems (gauhuman, occnerf, inpainthuman)" in note for note in notes)
    assert NONE_BETTER in notes
    where = "not in the rank agreement and the comparisons"
    assert [note for note in table.notes if where in note] == [
        f"inpainthuman (code 2+0): {where}: inpainthuman (code 1+0) has more scenes.",
        f"gtu: {where}: all its rows have other switches than the profile.",
    ]


def test_of_two_versions_of_the_code_with_as_many_scenes_the_newest_counts():
    runs = runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0})
    for run in runs_of({"gauhuman": 19.0}):
        outcome = replace(run.record.outcome, created="2026-01-01T00:00:00+00:00")
        who = replace(run.identity, code="2+0")
        runs.append(replace(run, record=replace(run.record, outcome=outcome, identity=who)))
    table, notes = notes_of(build_frame(TABLE1, runs))
    assert any("gauhuman (code 1+0)" in note and note.endswith("(code 2+0) has newer runs.") for note in table.notes)
    assert any(note.startswith("Rank agreement") and "rho +1.00" not in note for note in notes)


def test_where_a_system_is_better_than_the_papers_own_the_table_says_so():
    hidden = {"hidden": {"inpainthuman": 15.0, "gauhuman": 5.0, "occnerf": 16.0}}
    runs = runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0}, hidden=hidden)
    _, notes = notes_of(build_frame(TABLE1, runs))
    (told,) = [note for note in notes if "better than inpainthuman" in note]
    assert told.startswith("ZJU-MoCap, region hidden: better than inpainthuman: PSNR: occnerf by 1.00 dB")
    assert PSNR.format("hidden") in [str(i) for run in runs for i in run.own]


def test_and_where_none_is_it_says_that():
    runs = runs_of({"inpainthuman": 30.0, "occnerf": 20.0, "gauhuman": 21.0})
    _, notes = notes_of(build_frame(TABLE1, runs))
    assert NONE_BETTER in notes
    for psnr in ({"inpainthuman": 30.0}, {"occnerf": 20.0, "gauhuman": 21.0}):
        table, notes = notes_of(build_frame(TABLE1, runs_of(psnr)))
        assert not any("better than" in note for note in notes)
        alone = "ZJU-MoCap: InpaintHuman was not measured here as its profile has it: no system is compared with it."
        assert (alone in table.notes) == ("occnerf" in psnr)


def test_a_lead_that_people_do_not_confirm_is_told_as_such():
    runs = [fake_run(s, "inpainthuman", 20.0 + k, 0.9) for k, s in enumerate(SUBJECTS)]
    runs += [fake_run(s, "gauhuman", 20.0 + k + (9 if s == "a" else -1), 0.9) for k, s in enumerate(SUBJECTS)]
    _, notes = notes_of(build_frame(TABLE1, runs))
    (told,) = [note for note in notes if "better than inpainthuman" in note]
    assert "gauhuman by 1.50 dB" in told
    assert "4 people, not beyond chance" in told


def test_a_methods_footnote_stands_at_its_rows(monkeypatch):
    spec = MethodSpec(name="gauhuman", title="", summary="", method="a:b", profiles={}, footnote="details inferred")
    monkeypatch.setattr("ihbench.reports.paper.paper_table.usable_specs", lambda: [spec])
    frame = build_frame(TABLE1, runs_of({"inpainthuman": 30.0, "gauhuman": 21.0}))
    table, _ = notes_of(frame)
    (letter,) = [letter for letter, text in frame.footnotes.items() if text == "details inferred"]
    name = {row[0] if isinstance(row[0], str) else row[0][0]: row[0] for row in table.rows}
    assert name["gauhuman"][1].text == letter
    assert name["inpainthuman"] == "inpainthuman"


# -------------------------------------------------------------------------------------------- quoted from elsewhere


def test_rows_that_other_publications_print_have_their_sources():
    frame = build_frame(TABLE1, [])
    table, _ = notes_of(frame, "quoted elsewhere")
    rows = {label.name: row for label, row in zip(table.labels, table.rows, strict=True)}
    assert [cell.text for cell in rows["U-4DGS"][2:]] == ["24.62", "0.9606", "31.72", "20.11", "0.9030", "79.17"]
    for row in rows.values():
        assert frame.footnotes[row[0][1].text].startswith("Source: ")
        assert not any(cell.mark for cell in row[2:])
    # a row of the paper that is printed otherwise differs from it in every cell that is told
    printed = {row.name: row for row in TABLE1.rows}
    for row in TABLE1.elsewhere:
        if row.section == "printed otherwise":
            cells = zip(row.cells, printed[row.name].cells, strict=True)
            assert [a.text != b.text for a, b in cells if a.status != "absent"] == [True]
