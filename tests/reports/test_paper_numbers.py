"""The paper's numbers as data: complete, and as printed."""

from __future__ import annotations

import math

import pytest

from ihbench.methods.inpainthuman.studies.ablations import SUITES
from ihbench.reports.paper.paper_numbers import Digits, paper_table
from ihbench.scene.method_spec import method_spec


def row(table, name):
    (found,) = [row for row in table.rows if row.name == name]
    return found


def test_table1_is_the_papers():
    table = paper_table("table1")
    assert [column.group for column in table.columns] == ["ZJU-MoCap"] * 3 + ["OcMotion"] * 3
    assert len(table.rows) == 10
    assert [cell.text for cell in row(table, "OccNeRF").cells] == [
        "22.40",
        "0.9562",
        "43.01",
        "15.71",
        "0.8230",
        "82.90",
    ]
    assert [cell.text for cell in row(table, "HumanNeRF").cells][2:] == ["--", "9.79", "0.7203", "189.1"]
    # column sums, from the paper's LaTeX: one wrong digit anywhere shows
    sums = [sum(c.value for r in table.rows if not math.isnan((c := r.cells[k]).value)) for k in range(6)]
    assert sums == pytest.approx([194.71, 8.557, 369.15, 107.81, 5.863, 720.17])
    absent = [(r.name, k) for r in table.rows for k, c in enumerate(r.cells) if c.status == "absent"]
    assert len(absent) == 13


def test_table2_is_the_papers():
    table = paper_table("table2")
    assert [[cell.text for cell in row.cells] for row in table.rows] == [
        ["20.05", "0.9501", "61.47"],
        ["22.35", "0.9603", "55.92"],
        ["24.27", "0.9649", "38.53"],
        ["24.31", "0.9701", "37.42"],
    ]
    assert [row.components for row in table.rows] == [(k > 0, k > 1, k > 2) for k in range(4)]


def test_statuses_say_who_reports_what():
    table = paper_table("table1")
    assert {cell.status for cell in row(table, "InpaintHuman").cells} == {"reported"}
    assert {cell.status for cell in row(table, "GTU").cells} == {"quoted"}
    assert row(table, "GaussianAvatar").cells[1].status == "unreliable"


def test_numbers_that_are_written_elsewhere_too_are_the_same():
    own = [cell.value for cell in row(paper_table("table1"), "InpaintHuman").cells]
    reported = method_spec("inpainthuman").paper.reported
    assert [*reported["zju_mocap"].values(), *reported["ocmotion"].values()] == own
    rows = [[cell.value for cell in row.cells] for row in paper_table("table2").rows]
    variants = [variant.paper for variant in SUITES["table2"].variants if variant.paper]
    assert variants
    assert all([paper["psnr"], paper["ssim"], paper["lpips"]] in rows for paper in variants)


def test_columns_have_arrows_and_units():
    assert [column.title for column in paper_table("table2").columns] == [
        "PSNR ↑ (dB)",
        "SSIM ↑",
        "LPIPS* ↓ (× 1000)",
    ]


@pytest.mark.parametrize(
    ("value", "shown"), [(31.634, "31.63"), (189.06, "189.1"), (9.996, "9.996"), (99.996, "100.0"), (0.0, "0.000")]
)
def test_significant_digits_are_those_of_the_papers_columns(value, shown):
    assert f"{value:.{Digits(significant=4).decimals_of(value)}f}" == shown
