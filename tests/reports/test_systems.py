"""All systems side by side: the diagram of error against seconds by region, and what the occlusion costs each."""

from __future__ import annotations

import csv
from dataclasses import replace

import pytest

from ihbench.document.document import Paragraph, Table, plain_text
from ihbench.metrics.statistics import mean_interval
from ihbench.reports.general.content import general_report
from ihbench.reports.general.figures import draw
from ihbench.reports.general.strip_cost import strip_cost_section
from tests.reports.fake_runs import mean
from tests.reports.made_up_runs import PSNR, made_up

SCENES = ("a", "b", "c")
SYSTEMS = {"fast": (10, 20.0), "slow": (90, 26.0), "between": (40, 23.0), "beaten": (60, 22.0)}  # seconds, dB


def systems(folder, **changes):
    return [
        made_up(folder, scene, method, fit=fit + k, psnr=psnr + k, curve=None, **changes)
        for method, (fit, psnr) in SYSTEMS.items()
        for k, scene in enumerate(SCENES)
    ]


def with_region(run, region, psnr):
    own = dict(run.rows[run.method]) | mean(PSNR.format(region), psnr)
    return replace(run, rows={run.method: own})


def drawn(runs, folder):
    pictures = [png for png, _ in draw(runs, folder) if png.name.startswith("systems")]
    return [list(csv.DictReader(png.with_suffix(".csv").open())) for png in pictures], pictures


def test_every_system_is_a_point_in_every_region_with_the_regions_pareto_set(tmp_path):
    """In one region the order is turned: the slow one is worst there."""
    runs = [with_region(run, "visible", 30.0 if run.method == "fast" else 12.0) for run in systems(tmp_path)]
    (rows,), (png,) = drawn(runs, tmp_path / "out")
    front = {
        region: {row["method"] for row in rows if row["identity"] == PSNR.format(region) and row["pareto"] == "True"}
        for region in ("body", "hidden", "visible")
    }
    assert front == {"body": {"fast", "slow", "between"}, "hidden": {"fast", "slow", "between"}, "visible": {"fast"}}
    assert len(rows) == 4 * 3
    picture = png.with_suffix(".svg").read_text()
    assert all(f">{name}</text>" in picture for name in SYSTEMS)


def test_variants_are_no_systems_and_one_system_is_no_comparison(tmp_path):
    runs = systems(tmp_path) + [
        made_up(tmp_path, scene, "fast", fit=1, psnr=40.0, changed={"steps": 9}, curve=None) for scene in SCENES
    ]
    (rows,), _ = drawn(runs, tmp_path / "out")
    assert {row["configuration"] for row in rows} == set(SYSTEMS)
    assert drawn([run for run in runs if run.method == "fast"], tmp_path / "none") == ([], [])


# ------------------------------------------------------------------------------------------------- cost of the strip


def both(folder, costs, **changes):
    """Runs under a protocol and under the same without occlusion; `costs`: method -> dB by scene."""
    out = []
    for method, by_scene in costs.items():
        for k, (scene, cost) in enumerate(zip(SCENES, by_scene, strict=True)):
            clear = 25.0 + 4 * k
            out.append(made_up(folder, scene, method, psnr=clear, protocol="p@1+occlusion=none", **changes))
            out.append(made_up(folder, scene, method, psnr=clear - cost, protocol="p@1", **changes))
    return out


def cost_rows(blocks):
    (table,) = [block for block in blocks if isinstance(block, Table)]
    head = [plain_text(cell) for cell in table.head]
    return head, {plain_text(row[0]): [plain_text(cell) for cell in row[1:]] for row in table.rows}


def test_the_cost_is_each_person_against_itself(tmp_path):
    costs = {"carved": (14.0, 15.0, 16.0), "fills": (2.0, 2.5, 3.0)}
    head, rows = cost_rows(strip_cost_section(both(tmp_path, costs)))
    assert (head[:2], head[3:5]) == (["method", "people"], ["with", "cost [95%]"])
    assert head[2].startswith("PSNR")
    for method, values in costs.items():
        interval = mean_interval(dict(zip(SCENES, values, strict=True)), 0.95)
        assert rows[method][0] == "3"
        assert rows[method][3] == f"{interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]"
    # people differ by dB, the paired costs do not: the interval is that of the differences
    assert float(rows["carved"][1]) - float(rows["carved"][2]) == pytest.approx(15.0)


def test_where_less_is_better_a_loss_is_positive_too(tmp_path):
    head, rows = cost_rows(strip_cost_section(both(tmp_path, {"m": (5.0, 5.0, 5.0)})))
    k = next(k for k, words in enumerate(head) if words.startswith("FLIP"))
    assert float(rows["m"][k + 1].split(" ")[0]) > 0


def test_only_people_and_rows_with_both_are_there(tmp_path):
    runs = both(tmp_path, {"m": (5.0, 7.0, 9.0), "half": (1.0, 1.0, 1.0)})
    runs = [run for run in runs if not (run.scene == "c" and run.method == "m" and "none" in run.identity.protocol)]
    runs = [run for run in runs if not (run.method == "half" and "none" not in run.identity.protocol)]
    _, rows = cost_rows(strip_cost_section(runs))
    assert list(rows) == ["m"]
    assert rows["m"][0] == "2"
    assert rows["m"][3].startswith("6.00 ")


def test_without_runs_of_both_there_is_no_table_and_profiles_are_kept_apart(tmp_path):
    assert strip_cost_section(systems(tmp_path)) == []
    runs = both(tmp_path, {"m": (5.0, 5.0, 5.0)})
    clear = [run for run in runs if "none" in run.identity.protocol]
    other = [made_up(tmp_path, scene, "m", psnr=9.0, protocol="p@1", profile="paper") for scene in SCENES]
    assert strip_cost_section([*clear, *other]) == []


def test_one_person_has_a_cost_without_an_interval(tmp_path):
    runs = [run for run in both(tmp_path, {"m": (5.0, 7.0, 9.0)}) if run.scene == "a"]
    _, rows = cost_rows(strip_cost_section(runs))
    assert rows["m"][3] == "5.00"


def test_the_report_has_the_table_and_names_the_occlusion(tmp_path):
    blocks = general_report(both(tmp_path, {"m": (5.0, 7.0, 9.0)}))
    words = [plain_text(block.words) for block in blocks if isinstance(block, Paragraph)]
    assert any(text.startswith("occlusion as p@1 has it; quick profile, stand-in v1 seed 0") for text in words)
    assert any("a positive one is always a loss" in text for text in words)
