"""Diagrams: ticks that can be read, labels that keep apart, files that are whole."""

from __future__ import annotations

import csv
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ihbench.document import diagram
from ihbench.document.csv import write_rows
from ihbench.document.diagram import Label, place_labels, round_ticks, tick_text
from ihbench.record import outputs


@given(st.floats(-12, 8), st.floats(0.05, 14))
@settings(deadline=None, derandomize=True, max_examples=300)
def test_every_range_has_two_to_seven_round_ticks_inside(exponent, decades):
    low, high = 10.0**exponent, 10.0 ** (exponent + decades)
    ticks = round_ticks(low, high)
    assert 1 <= len(ticks) <= 7
    assert ticks == sorted(set(ticks))
    assert all(low * 0.9 <= t <= high * 1.1 for t in ticks)
    assert len(ticks) >= 2 or decades < 0.1
    assert len({tick_text(t) for t in ticks}) == len(ticks)


def test_ticks_are_the_numbers_one_would_write():
    assert round_ticks(20, 400) == [20, 30, 50, 100, 200, 300]
    assert round_ticks(0.9e-9, 1.1e-3) == [1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3]
    assert [tick_text(v) for v in (0.05, 1.0, 20000.0, 1e-7, 3e-8)] == [
        "0.05",
        "1",
        "20000",
        "10$^{-7}$",
        "3·10$^{-8}$",
    ]


def test_labels_cover_neither_points_nor_lines_nor_each_other():
    drawn, (axes,) = diagram.figure()
    points = [(1.0 + k % 3, 1.0 + k // 3) for k in range(9)]
    axes.plot(*zip(*points, strict=True), ls="")
    diagram.logarithmic(axes, [1, 3], [1, 3])
    line = [(1.0, 1.0), (3.0, 3.0)]
    place_labels(axes, [Label(p, f"point {k}") for k, p in enumerate(points)], [line])
    drawn.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert 7 <= len(boxes) <= 9
    frame = axes.get_window_extent()
    spots = axes.transData.transform([*points, *[(1 + 0.1 * k, 1 + 0.1 * k) for k in range(21)]])
    for k, box in enumerate(boxes):
        assert frame.x0 <= box.x0 <= box.x1 <= frame.x1 + 1
        assert not any(box.overlaps(other) for other in boxes[:k])
        assert not any(box.x0 < x < box.x1 and box.y0 < y < box.y1 for x, y in spots)


def test_what_finds_no_room_is_not_written():
    _, (axes,) = diagram.figure(width=1.5, height=1.2)
    diagram.logarithmic(axes, [1, 2], [1, 2])
    place_labels(axes, [Label((1.5, 1.5), "a label that is far too long for it " * 3)])
    assert not axes.texts


def test_three_files_and_the_same_picture_is_the_same_file(tmp_path):
    def once(name):
        drawn, (axes,) = diagram.figure()
        axes.plot([1, 2], [1, 2])
        return outputs.write_files(tmp_path / name / "x", diagram.files(drawn, [{"a": 1.0}]))

    first, second = once("one"), once("two")
    for ending in (".png", ".svg", ".csv"):
        assert first.with_suffix(ending).read_bytes() == second.with_suffix(ending).read_bytes() != b""


def test_a_csv_keeps_every_bit_and_no_spreadsheet_takes_a_name_for_a_formula(tmp_path):
    rows = [{"name": "=cmd|' /C calc'!A0", "x": 0.1 + 0.2}, {"x": math.nan, "more": 'a,b\n"c"'}]
    (tmp_path / "t.csv").write_text(write_rows(rows))
    first, second = csv.DictReader((tmp_path / "t.csv").open(newline=""))
    assert first["name"].startswith("'=")
    assert float(first["x"]) == 0.1 + 0.2
    assert (second["name"], second["x"], second["more"]) == ("", "", 'a,b\n"c"')


def test_no_panel_needs_a_display_or_the_global_list_of_figures():
    import matplotlib.pyplot as plt

    diagram.figure(2, 2)
    assert plt.get_fignums() == []


@pytest.mark.parametrize("values", [[], [0.0], [-1.0], [math.nan], [5.0]])
def test_axes_without_a_positive_range_still_work(values):
    drawn, (axes,) = diagram.figure()
    diagram.logarithmic(axes, values, values)
    drawn.canvas.draw()
    assert axes.get_xlim()[0] < axes.get_xlim()[1]
