"""The table of stages: it adds up, what is in no stage has a row, and books that do not balance are named."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from ihbench.clock.events import Event
from ihbench.clock.ledger import Ledger, LedgerState, Stage
from ihbench.document.markdown import write as markdown
from ihbench.files.atomic import read_json
from ihbench.record.results import RunResult, read_result
from ihbench.reports.general.ledger_table import TOLERANCE, account, ledger_section
from tests.reports.made_up_runs import made_up


def with_ledger(run: RunResult, books: LedgerState | None) -> RunResult:
    return replace(run, record=replace(run.record, ledger=books))


def table(runs):
    """First cell of a row -> its numbers."""
    lines = [
        [c.strip() for c in line.split("|")[1:-1]]
        for line in markdown(ledger_section(runs)).splitlines()
        if "|" in line
    ]
    return {row[0]: row[1:] for row in lines[2:]}


def test_rows_add_up_to_the_wall_clock_with_what_is_in_no_stage(tmp_path):
    rows = table([made_up(tmp_path, fit=40.0, unnamed=0.5), made_up(tmp_path, seed=1, fit=60.0, unnamed=0.7)])
    assert rows["fit"][0] == "50.00"
    assert rows["· stage1"][0] == "49.00"
    assert rows["*in no stage*"][0] == "0.60"
    assert rows["**wall clock**"] == ["56.60", "100.0"]
    top = [float(numbers[0]) for name, numbers in rows.items() if not name.startswith(("·", "**"))]
    assert sum(top) == pytest.approx(56.60)


def test_every_scene_counts_once(tmp_path):
    """As in the other tables of seconds: two seeds of one scene are one scene."""
    runs = [
        made_up(tmp_path, s, seed=k, fit=f, stages={f"of {s}": 8.0})
        for s, k, f in (("a", 0, 10.0), ("a", 1, 30.0), ("b", 0, 60.0))
    ]
    rows = table(runs)
    assert rows["fit"][0] == "40.00"
    assert rows["of b"][0] == "4.00"


def test_more_than_two_percent_in_no_stage_is_named(tmp_path):
    fine, leaky = made_up(tmp_path, unnamed=0.9), made_up(tmp_path, seed=1, unnamed=1.5)
    assert account(fine).adds_up
    assert not account(leaky).adds_up
    text = markdown(ledger_section([fine, leaky]))
    assert "within 2% in 1 of 2 runs" in text
    assert "does not add up: ours on a, seed 1: 3.2% unnamed of 48 s" in text


def test_a_stage_that_is_less_than_its_parts_is_named(tmp_path):
    text = markdown(ledger_section([made_up(tmp_path, stages={"fit/stage1": 90.0})]))
    assert "fit is less than its parts" in text


def test_the_records_own_time_stamps_are_a_second_clock(tmp_path):
    agrees, slept = made_up(tmp_path), made_up(tmp_path, seed=1, stamped=4000)
    assert account(agrees).agrees
    text = markdown(ledger_section([agrees, slept]))
    assert "clocks disagree: ours on a, seed 1: ledger 46 s, time stamps 4000 s" in text


@pytest.mark.parametrize("how", ["redone", "shared", "entered"])
def test_there_is_no_second_clock_for_a_run_that_went_on_after_a_kill_or_borrowed_seconds(tmp_path, how):
    run = made_up(tmp_path, stamped=4000)
    books = run.record.ledger
    if how == "shared":
        books = replace(books, events=(Event("shared"),))
    else:
        again = {"redone": Stage(0.0)} if how == "redone" else {"load": Stage(1.0, entered=2)}
        books = replace(books, stages={**books.stages, **again})
    run = with_ledger(run, books)
    assert math.isnan(account(run).stamped)
    assert "disagree" not in markdown(ledger_section([run]))


def test_what_came_before_the_record_counts_on_both_sides(tmp_path):
    run = made_up(tmp_path, stages={"open": 30.0}, stamped=47)
    assert account(run).stamped == 77
    assert account(run).agrees


def test_a_run_without_a_ledger_has_no_row(tmp_path):
    assert ledger_section([with_ledger(made_up(tmp_path), None)]) == []


def test_many_configurations_get_several_tables(tmp_path):
    runs = [made_up(tmp_path, changed={"steps": k}) for k in range(9)]
    assert markdown(ledger_section(runs)).count("| stage |") == 3


def test_the_ledger_of_a_real_run_adds_up(finished):
    """Its times are real: only what the ledger's construction promises is asserted, not how long anything took."""
    found = account(read_result(finished.folder))
    assert found.overfull == []
    assert found.unnamed >= -1e-9
    assert found.stages["open"] >= 0
    assert {"import", "fit", "evaluate", "save", "score"} <= set(found.stages)
    assert read_json(finished.folder / "run.json")["machine"]["load_average_end"] is not None


def test_books_of_a_ledger_with_every_kind_of_interruption_add_up(tmp_path):
    now = [0.0]
    ledger = Ledger(clock=lambda: now[0], on_checkpoint=lambda *_: now.__setitem__(0, now[0] + 7))
    ledger.book("open", 5.0)
    with ledger.stage("fit"), ledger.stage("stage1"):
        for step in range(9):
            now[0] += 1.5
            ledger.offer(step, "avatar")
            ledger.save_state("s", {}, {})
    now[0] += 0.2
    run = made_up(tmp_path)
    found = account(with_ledger(run, ledger.state()))
    assert found.wall == pytest.approx(5 + now[0])
    assert found.unnamed == pytest.approx(0.2)
    assert found.adds_up == (TOLERANCE * found.wall >= 0.2)
