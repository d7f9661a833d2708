"""The report's section on what was painted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ihbench.clock.events import Event
from ihbench.clock.ledger import LedgerState
from ihbench.document.markdown import write as markdown
from ihbench.record.results import RunResult
from ihbench.reports.general.inpainting import inpainting_section
from tests.reports.fake_runs import about, identity, record


def event(delta_e, views=3, texture=float("nan"), texture_floor=1.0):
    drift = {"delta_e": delta_e, "delta_e_floor": 2.0, "texture": texture, "texture_floor": texture_floor}
    flicker = {"deviation": 0.04, "deviation_floor": 0.02}
    data = {"views": views, "of": 10, "pixels": 100, "identity_drift": drift, "flicker": flicker}
    return Event("inpainted", data=data)


def run(*events):
    ledger = LedgerState({}, 0.0, 0.0, events)
    return RunResult(Path("x"), replace(record(identity("a", "m"), about()), ledger=ledger), {})


def test_means_over_runs_and_only_the_last_event_of_a_resumed_one():
    runs = [run(event(99.0), event(4.0)), run(event(6.0, views=5))]
    lines = markdown(inpainting_section({"ours": runs, "stage 1": [run()]})).splitlines()
    rows = [line for line in lines if line.startswith("| ") and "method" not in line]
    assert rows == ["| ours | 2 of 2 | 4 of 10 | 100 | 5.0 (2.0) | absent | 0.040 (0.020) |"]


def test_a_value_and_its_floor_are_over_the_same_runs_and_the_cell_says_over_how_many():
    runs = [run(event(4.0, texture=3.0, texture_floor=2.5)), run(event(6.0, texture_floor=0.5)), run(), run()]
    text = markdown(inpainting_section({"ours": runs}))
    assert "| ours | 2 of 4 | 3 of 10 | 100 | 5.0 (2.0) | 3.0 (2.5), 1 of 2 runs | 0.040 (0.020) |" in text
    assert "the others painted nothing" in text


def test_no_section_without_paintings():
    assert inpainting_section({"stage 1": [run()]}) == []
