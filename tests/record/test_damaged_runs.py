"""One damaged run folder never takes a report, a table, a plan or another run down: it is left out by name."""

from __future__ import annotations

import pytest

from ihbench.errors import BadInput
from ihbench.record.results import read_result, read_results
from ihbench.record.schema import PredictionFiles
from ihbench.record.store import RunFolder
from tests.fuzz import records
from tests.reports.fake_runs import write_run


def test_no_damage_to_a_run_takes_anything_down(tmp_path):
    assert list(records.faults(tmp_path, limit=120)) == []


@pytest.mark.parametrize("files", [None, PredictionFiles(missing=("x.png",), surplus=(), notes=(), views=4)])
def test_a_run_that_lost_scores_of_test_views_is_left_out(tmp_path, files):
    """Four of a run, or of predictions of which one was missing; two of them of a further group."""
    folder = write_run(tmp_path, "a", "mine", 20.0, 0.9)
    whole = write_run(tmp_path, "b", "mine", 20.0, 0.9)
    (line,) = (folder / "scores.jsonl").read_text().splitlines()
    lines = [line.replace('"camera": 1', f'"camera": {k}') for k in (1, 2)]
    lines += [line.replace('"mine"', '"mine [group]"') for line in lines]
    run = RunFolder.open(folder)
    with run.lock():
        run.describe(**({"measure": {"test_views": 4}} if files is None else {"predictions": files}))
        run.save()
    (folder / "calibration.jsonl").unlink()
    (folder / "scores.jsonl").write_text("\n".join(lines))
    assert set(read_result(folder).rows) == {"mine", "mine [group]"}
    for kept in (lines[:2], lines[:3], lines[1:], [*lines, lines[-1].replace('"camera": 2', '"camera": 3')]):
        (folder / "scores.jsonl").write_text("\n".join(kept))
        with pytest.raises(BadInput, match=rf"not whole \({len(kept)} of 4 test views\)"):
            read_result(folder)
        assert [run.folder for run in read_results([folder, whole])[0]] == [whole]
