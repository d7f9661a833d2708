"""One damaged run folder never takes a report, a table, a plan or another run down: it is left out by name."""

from __future__ import annotations

from tests.fuzz import records


def test_no_damage_to_a_run_takes_anything_down(tmp_path):
    assert list(records.faults(tmp_path, limit=120)) == []
